"""Which labels look wrong."""

from __future__ import annotations

import csv
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import amvnet
from amvnet import Scan
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI
from amvnet.evaluation import label_errors
from amvnet.evaluation.label_errors import PointDoubts, cluster, find_clusters, measure_doubts, rank
from amvnet.weights.file import save

from fixtures.commands import files, not_none, refused, run_cli
from fixtures.engines import giving, scripted
from fixtures.tiny import fresh_weights, make_streets, without

DOCS = Path(__file__).parents[2] / "docs"
WEIGHTS = fresh_weights()
# Train ids of SemanticKITTI.
CAR = 1
PERSON = 6
ROAD = 9
WALL = 13


# ---- clusters


def clusters_by_flooding(xyz: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Return the same clusters by a plain loop over cells."""
    cells = np.column_stack([np.floor(xyz / label_errors.CELL).astype(int), kind])
    cluster_ids = np.full(len(cells), -1)
    for start in range(len(cells)):
        if cluster_ids[start] >= 0:
            continue

        number = cluster_ids.max() + 1
        waiting = [start]
        while waiting:
            point = waiting.pop()
            cluster_ids[point] = number
            touching = np.abs(cells[:, :3] - cells[point, :3]).max(axis=1) <= 1
            same_kind = cells[:, 3] == cells[point, 3]
            waiting += np.flatnonzero(touching & same_kind & (cluster_ids < 0)).tolist()
    return cluster_ids


def test_clusters_are_connected_points_of_one_kind() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-2, 2, (150, 3))
    kind = rng.integers(0, 3, 150)

    ours = cluster(xyz, kind)
    expected = clusters_by_flooding(xyz, kind)

    count = len(np.unique(ours))
    assert 5 < count < 150
    assert set(ours) == set(range(count))

    # Each of our clusters is exactly one of the expected ones.
    assert np.unique(np.stack([ours, expected]), axis=1).shape[1] == count
    assert len(np.unique(expected)) == count


def test_no_points_have_no_clusters() -> None:
    assert cluster(np.zeros((0, 3)), np.zeros(0, np.int64)).shape == (0,)


# ---- doubts


def confident(ids: np.ndarray, share: float = 0.9) -> np.ndarray:
    """Return (N, 19) probabilities: `share` for one class, the rest spread over all."""
    return share * np.eye(19)[ids - 1] + (1 - share) / 19


def doubts_of(
    points: np.ndarray, rv: np.ndarray, bev: np.ndarray, labels: np.ndarray
) -> PointDoubts:
    """Return the doubts about the labels of a scan for which the two views predict these ids."""
    return doubts_by_scores(points, confident(rv), confident(bev), labels)


def doubts_by_scores(
    points: np.ndarray, f: np.ndarray, g: np.ndarray, ids: np.ndarray
) -> PointDoubts:
    """Return the doubts about labels for which the two views have probabilities (N, K)."""
    points = points.copy()
    points[:, 3] = 0.5
    scan = Scan(points, ids)
    return measure_doubts(scan, scripted(WEIGHTS, giving(f[scan.valid], g[scan.valid])))


def three_things() -> tuple[np.ndarray, np.ndarray]:
    """Return three things of 100 points each, far from each other, and one point without a place.

    Returns:
        (301, 4) points, and the (301,) number of the thing that each is part of.
    """
    rng = np.random.default_rng(0)
    thing = np.repeat([0, 1, 2, 3], [100, 100, 100, 1])
    points = rng.uniform(-0.5, 0.5, (301, 4)).astype(np.float32) + thing[:, None] * [10, 0, 0, 0]
    points[-1, 0] = np.nan
    points[:, 1] += 5
    return points.astype(np.float32), thing


def test_the_vehicle_that_carries_the_sensor_is_not_doubted() -> None:
    points, thing = three_things()
    points[thing == 0, :3] *= (1, 0.1, 1)  # to half a metre from the sensor
    labels = np.full(301, PERSON, np.uint8)
    doubts = doubts_of(points, np.full(301, CAR), np.full(301, CAR), labels)
    assert np.array_equal(doubts.doubt > 0, (thing == 1) | (thing == 2))
    assert find_clusters(doubts)["points"].tolist() == [100, 100]


def test_a_doubt_is_the_agreed_class_in_the_less_certain_view_over_the_label_in_either() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (500, 4)).astype(np.float32)
    labels = rng.integers(0, 20, 500).astype(np.uint8)
    f = rng.dirichlet(np.full(19, 0.1), 500)
    g = 0.7 * f + 0.3 * rng.dirichlet(np.full(19, 0.1), 500)

    doubts = doubts_by_scores(points, f, g, labels)

    for index, label in enumerate(labels):
        agreed = np.argmax(f[index] * g[index])
        expected = 0.0
        if label > 0 and np.hypot(*points[index, :2]) >= label_errors.VEHICLE_RADIUS:
            of_label = max(f[index, label - 1], g[index, label - 1])
            expected = max(min(f[index, agreed], g[index, agreed]) - of_label, 0)
        assert doubts.doubt[index] == pytest.approx(expected, abs=1e-5)
    assert 100 < np.count_nonzero(doubts.doubt) < 450


def test_a_wrong_label_is_one_cluster_at_its_place() -> None:
    points, thing = three_things()
    labels = np.full(301, ROAD, np.uint8)
    ids = np.where(thing == 1, CAR, ROAD)
    rows = find_clusters(doubts_of(points, ids, ids, labels))

    assert len(rows) == 1
    assert thing[rows["point"]] == 1
    assert (rows["rv"], rows["bev"], rows["label"], rows["points"]) == (CAR, CAR, ROAD, 100)
    assert np.allclose(rows["xyz"], points[rows["point"], :3])
    assert np.linalg.norm(rows["xyz"] - points[thing == 1, :3].mean(axis=0)) < 0.5


def test_a_label_is_doubted_only_if_both_views_contradict_it() -> None:
    points, thing = three_things()
    labels = np.zeros(301, np.uint8)
    labels[thing == 0] = WALL  # both views contradict it
    labels[thing == 1] = ROAD  # one view does
    rv = np.full(301, CAR)
    bev = np.where(thing == 1, ROAD, CAR)

    doubts = doubts_of(points, rv, bev, labels)
    rows = find_clusters(doubts)

    assert np.array_equal(doubts.doubt > 0, thing == 0)
    assert (rows["rv"], rows["bev"], rows["label"]) == (CAR, CAR, WALL)
    assert np.allclose(doubts.doubt[thing == 0], 0.9, atol=1e-5)


def test_a_whole_thing_is_more_doubtful_than_the_edge_of_one_and_many_points_than_few() -> None:
    points, thing = three_things()
    labels = np.full(301, WALL, np.uint8)
    ids = np.full(301, WALL)
    ids[thing == 0] = CAR
    ids[(thing == 1) & (points[:, 0] > 10.3)] = CAR
    ids[np.flatnonzero(thing == 2)[:1]] = CAR
    rows = find_clusters(doubts_of(points, ids, ids, labels))

    rows = rows[np.argsort(-rows["score"])]
    assert (rows["points"][0], rows["points"][-1]) == (100, 1)
    assert rows["score"][0] > 2 * rows["score"][1]


# ---- the command


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a dataset, weights, and a ranking; nothing may change them."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    save(WEIGHTS, root / "w.safetensors")
    save(without(WEIGHTS, "polar_net"), root / "rv.safetensors")
    save(fresh_weights(NUSCENES), root / "nuscenes.safetensors")

    outputs = ("--out", root / "labels.csv")
    assert run_cli("rank", root / "data", "--weights", root / "w.safetensors", *outputs) == (0, "")
    return root


def read_table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_table_is_in_order(world: Path) -> None:
    table = read_table(world / "labels.csv")
    assert len(table) > 20
    assert [int(row["rank"]) for row in table] == list(range(1, len(table) + 1))
    scores = [float(row["score"]) for row in table]
    assert scores == sorted(scores, reverse=True)


def test_the_table_says_what_the_scans_hold(world: Path) -> None:
    clusters = read_table(world / "labels.csv")
    dataset = open_dataset(str(world / "data"))
    records = {record.name: record for record in dataset.records(dataset.sequences("all"))}
    names = ("", *SEMANTICKITTI.classes)
    for row in clusters[:20]:
        scan = dataset.read(records[row["scan"]])
        point = int(row["point"])
        xyz = (float(row["x"]), float(row["y"]), float(row["z"]))
        assert np.allclose(xyz, scan.points[point, :3], atol=0.006)
        assert row["label"] == names[not_none(scan.labels)[point]] != ""


def test_scans_without_labels_are_refused(world: Path, tmp_path: Path) -> None:
    shutil.copytree(world / "data", tmp_path / "data")
    for folder in (tmp_path / "data/sequences").iterdir():
        shutil.rmtree(folder / "labels")
    options = ("--weights", world / "w.safetensors", "--out", tmp_path / "next.csv")

    refused(("rank", tmp_path / "data", *options), "labels")


@pytest.mark.parametrize(
    ("weights", "word"), [("rv", "polar_net"), ("nuscenes", "classes"), ("none", "weights file")]
)
def test_wrong_input_leaves_one_line(world: Path, tmp_path: Path, weights: str, word: str) -> None:
    options = ("--weights", world / f"{weights}.safetensors", "--out", tmp_path / "next.csv")
    refused(("rank", world / "data", *options), word)
    assert not files(tmp_path)


def test_each_scan_is_read_only_in_its_turn(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = open_dataset(str(world / "data"))
    events: list[str | int] = []
    read = type(dataset).read

    def recorded_read(dataset: Dataset, record: ScanFile) -> Scan:
        events.append("read")
        return read(dataset, record)

    def progress(done: int, total: int) -> None:
        events.append(done)

    monkeypatch.setattr(type(dataset), "read", recorded_read)
    rank(dataset, dataset.records(["00", "01"]), amvnet.load(WEIGHTS), progress)

    assert events.count("read") == 4
    assert [event for event in events if event != "read"] == [0, 1, 2, 3, 4]


# ---- the page of the documentation


@pytest.mark.full
def test_every_command_of_the_page_runs_and_finds_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("embreex")
    monkeypatch.chdir(tmp_path)
    shutil.copy(DOCS / "mislabel.py", tmp_path)
    page = (DOCS / "ranking.md").read_text()
    commands: list[str] = []
    for block in re.findall(r"```bash\n(.*?)```", page, re.S):
        commands += block.splitlines()

    assert len(commands) == 4

    for command in commands:
        words = shlex.split(command.replace("--sequences 10 --scans 2", "--sequences 3 --scans 1"))
        if words[0] == "python":
            subprocess.run([sys.executable, *words[1:]], check=True)
        else:
            assert run_cli(*words[1:]) == (0, ""), command

    shares = re.findall(r"(\d+)%\n", capfd.readouterr().out)
    assert int(shares[1]) >= 40  # of seven or so; 5 of 100 by chance
