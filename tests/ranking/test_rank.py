"""What to label next, and which labels look wrong."""

from __future__ import annotations

import csv
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from amvnet import Scan, Segmenter
from amvnet.data.datasets.open import open_dataset
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.ranking.clusters import CELL, cluster
from amvnet.ranking.rank import find_clusters, find_doubts, rank
from amvnet.weights.file import save

from fixtures.worlds import files, fresh_weights, make_streets, run_cli, without

DOCS = Path(__file__).parents[2] / "docs"
WEIGHTS = fresh_weights()
CAR, PERSON, ROAD, WALL = 1, 6, 9, 13  # train ids


# ---- clusters


def by_flooding(xyz: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """The same clusters by a plain loop over cells."""
    cells = [(*np.floor(p / CELL).astype(int), k) for p, k in zip(xyz, kind, strict=True)]
    found: dict[tuple[int, ...], int] = {}
    for start in cells:
        if start in found:
            continue
        number, ahead = len(set(found.values())), [start]
        while ahead:
            one = ahead.pop()
            if one in found:
                continue
            found[one] = number
            ahead += [
                c
                for c in set(cells)
                if c[3] == one[3] and max(abs(a - b) for a, b in zip(c, one, strict=True)) <= 1
            ]
    return np.array([found[c] for c in cells])


def test_clusters_are_connected_points_of_one_kind() -> None:
    rng = np.random.default_rng(0)
    xyz, kind = rng.uniform(-2, 2, (150, 3)), rng.integers(0, 3, 150)
    ours, theirs = cluster(xyz, kind), by_flooding(xyz, kind)
    assert 5 < len(np.unique(ours)) < 150
    pairs = np.unique(np.stack([ours, theirs]), axis=1)
    assert len(pairs.T) == len(np.unique(ours)) == len(np.unique(theirs))
    assert set(np.unique(ours)) == set(range(len(np.unique(ours))))


def test_no_points_have_no_clusters() -> None:
    assert cluster(np.zeros((0, 3)), np.zeros(0, np.int64)).shape == (0,)


# ---- doubts


class Said(Segmenter):
    """A segmenter of which a test says what the two views say."""

    def __init__(self, f: np.ndarray, g: np.ndarray) -> None:
        super().__init__(WEIGHTS)
        self.said = [torch.from_numpy(one.astype(np.float32)) for one in (f, g)]

    def scores_by_method(
        self, scan: Scan, methods: Sequence[str] = ()
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        f, g = (one[torch.from_numpy(scan.valid)] for one in self.said)
        return {"rv": f, "bev": g}, self.model.assertion(
            f, g, torch.from_numpy(scan.points[scan.valid])
        )


def sure(ids: np.ndarray, share: float = 0.9) -> np.ndarray:
    """(N, 19) probabilities: so much for a class, the rest for all."""
    return share * np.eye(19)[ids - 1] + (1 - share) / 19


def things() -> tuple[np.ndarray, np.ndarray]:
    """Three things of 100 points far from each other, and a point that is lost: (301, 4) points, (301,) which thing."""
    rng = np.random.default_rng(0)
    thing = np.repeat([0, 1, 2, 3], [100, 100, 100, 1])
    points = rng.uniform(-0.5, 0.5, (301, 4)).astype(np.float32) + thing[:, None] * [10, 0, 0, 0]
    points[-1, 0] = np.nan
    points[:, 1] += 5
    return points.astype(np.float32), thing


def test_the_vehicle_that_carries_the_sensor_is_not_doubted() -> None:
    points, thing = things()
    points[thing == 0, :3] *= (1, 0.1, 1)  # to half a metre from the sensor
    f, g = (sure(np.full(301, kind)) for kind in (CAR, PERSON))
    _, of = find_clusters(find_doubts(Scan(points), Said(f, g), "disagreement"))
    assert np.array_equal(of >= 0, (thing == 1) | (thing == 2))


def test_a_disagreement_is_one_cluster_where_it_is() -> None:
    points, thing = things()
    f, g = (sure(np.where(thing == 1, kind, ROAD)) for kind in (CAR, PERSON))
    rows, of = find_clusters(find_doubts(Scan(points), Said(f, g), "disagreement"))
    assert len(rows) == 1
    assert np.array_equal(of >= 0, thing == 1)
    assert (rows["rv"], rows["bev"], rows["label"], rows["points"]) == (CAR, PERSON, 0, 100)
    assert np.allclose(rows["xyz"], points[rows["point"], :3])
    assert np.linalg.norm(rows["xyz"] - points[thing == 1, :3].mean(axis=0)) < 0.5


def test_a_label_is_doubted_only_where_both_views_contradict_it() -> None:
    points, thing = things()
    labels = np.where(thing == 0, WALL, np.where(thing == 1, ROAD, 0)).astype(
        np.uint8
    )  # wrong, half wrong, none
    f, g = sure(np.full(301, CAR)), sure(np.where(thing == 1, ROAD, CAR))
    doubts = find_doubts(Scan(points, labels), Said(f, g), "labels")
    rows, of = find_clusters(doubts)
    assert np.array_equal(of >= 0, thing == 0)
    assert (rows["rv"], rows["bev"], rows["label"]) == (CAR, CAR, WALL)
    assert np.allclose(doubts.doubt[thing == 0], 0.9, atol=1e-5)


def test_a_whole_thing_is_more_doubtful_than_the_edge_of_one_and_many_points_than_few() -> None:
    points, thing = things()
    labels = np.full(301, WALL, np.uint8)
    said = np.where((thing == 0) | ((thing == 1) & (points[:, 0] > 10.3)), CAR, WALL)
    said[np.flatnonzero(thing == 2)[:1]] = CAR
    rows, _ = find_clusters(
        find_doubts(Scan(points, labels), Said(sure(said), sure(said)), "labels")
    )
    order = np.argsort(-rows["score"])
    assert rows["points"][order][0] == 100
    assert rows["points"][order][-1] == 1
    assert rows["score"].max() > 2 * np.sort(rows["score"])[-2]


# ---- the verb


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set, weights, and rankings by both; nothing may change them."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    save(WEIGHTS, root / "w.safetensors")
    save(without(WEIGHTS, "polar_net"), root / "rv.safetensors")
    save(fresh_weights(NUSCENES), root / "nuscenes.safetensors")
    for by in ("disagreement", "labels"):
        out = ("--out", root / f"{by}.csv", "--by", by)
        drawn = ("--pictures", root / by) if by == "labels" else ()
        assert run_cli(
            "rank", root / "data", "--weights", root / "w.safetensors", *out, *drawn
        ) == (
            0,
            "",
        )
    return root


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("by", ["disagreement", "labels"])
def test_the_tables_are_in_order_and_say_what_the_scans_hold(world: Path, by: str) -> None:
    rows, scans = table(world / f"{by}.csv"), table(world / f"{by}-scans.csv")
    assert len(rows) > 20
    assert len(scans) == 6
    for found in (rows, scans):
        assert [int(row["rank"]) for row in found] == list(range(1, len(found) + 1))
        scores = [float(row["score"]) for row in found]
        assert scores == sorted(scores, reverse=True)
    dataset = open_dataset(str(world / "data"))
    records = {record.name: record for record in dataset.records(dataset.sequences("all"))}
    for row in rows[:20]:
        scan, point = dataset.read(records[row["scan"]]), int(row["point"])
        assert np.allclose([float(row[axis]) for axis in "xyz"], scan.points[point, :3], atol=0.006)
        assert row["label"] == ("", *SEMANTICKITTI.classes)[scan.labels[point]]
        assert row["label"] or by == "disagreement"
        assert (row["rv"] != row["bev"]) if by == "disagreement" else row["label"]
    for row in scans:
        assert int(row["clusters"]) == sum(other["scan"] == row["scan"] for other in rows)
    assert {f"labels/{place:02d}.png" for place in range(1, 13)} <= files(world)


def test_scans_without_labels_are_ranked_alike(world: Path, tmp_path: Path) -> None:
    shutil.copytree(world / "data", tmp_path / "data")
    for folder in (tmp_path / "data/sequences").iterdir():
        shutil.rmtree(folder / "labels")
    out = ("--weights", world / "w.safetensors", "--out", tmp_path / "next.csv")
    assert run_cli("rank", tmp_path / "data", *out) == (0, "")
    known, blind = table(world / "disagreement.csv"), table(tmp_path / "next.csv")
    assert [{**row, "label": ""} for row in known] == blind
    code, error = run_cli("rank", tmp_path / "data", *out, "--by", "labels")
    assert (code, error.count("\n")) == (2, 1)
    assert "labels" in error


def test_wrong_input_is_one_line_and_leaves_nothing(world: Path, tmp_path: Path) -> None:
    for weights, word in (
        ("rv", "both networks"),
        ("nuscenes", "classes"),
        ("none", "weights file"),
    ):
        arguments = ("--weights", world / f"{weights}.safetensors", "--out", tmp_path / "next.csv")
        code, error = run_cli("rank", world / "data", *arguments)
        assert (code, error.count("\n")) == (2, 1)
        assert word in error
    assert not files(tmp_path)


def test_a_scan_is_read_when_it_is_its_turn(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset, turns = open_dataset(str(world / "data")), []
    read = type(dataset).read
    monkeypatch.setattr(type(dataset), "read", lambda *args: turns.append("read") or read(*args))
    rank(
        dataset,
        dataset.records(["00", "01"]),
        Segmenter(WEIGHTS),
        "labels",
        lambda done, total: turns.append("turn"),
    )
    assert turns == ["turn", "read"] * 4 + ["turn"]


# ---- the page of the docs


def test_every_command_of_the_page_runs_and_finds_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex")
    monkeypatch.chdir(tmp_path)
    shutil.copy(DOCS / "mislabel.py", tmp_path)
    page = (DOCS / "ranking.md").read_text()
    commands = [
        line
        for block in re.findall(r"```bash\n(.*?)```", page, re.S)
        for line in block.splitlines()
    ]
    assert len(commands) == 5
    for command in commands:
        words = shlex.split(command.replace("--sequences 10 --scans 2", "--sequences 3 --scans 1"))
        if words[0] == "python":
            subprocess.run([sys.executable, *words[1:]], check=True)
        else:
            assert run_cli(*words[1:]) == (0, ""), command
    shares = [int(one) for one in re.findall(r"(\d+)%\n", capfd.readouterr().out)]
    assert shares[1] >= 40  # of seven or so; 5 of 100 by chance
