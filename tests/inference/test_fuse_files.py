"""Fusing any two models' scores from files, and training a head for them."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from amvnet import fuse
from amvnet.inference.segmenter import Segmenter
from amvnet.weights.file import load, save

from fixtures.worlds import files, fresh_weights, make_streets, run_cli, street, write_recipe

DOCS = Path(__file__).parents[2] / "docs"
PLACE = "sequences/08/predictions/000000"
OWN = ("--key-a", "rv", "--key-b", "bev")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set, weights, and what they predict by both methods, with scores; nothing may change them."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    save(fresh_weights(), root / "w.safetensors")
    write_recipe(root / "recipe.yaml")
    for method in ("amvnet", "ensemble"):
        out = ("--out", root / method, "--method", method, "--scores")
        assert run_cli("predict", root / "data", "--weights", root / "w.safetensors", *out)[0] == 0
    return root


def fused(
    world: Path,
    out: Path,
    *more: Any,
    data: str = "data",
    a: Path | None = None,
    b: Path | None = None,
) -> str:
    """Run `amvnet fuse` on the world's scores, or on others; returns its complaint."""
    scores = ("--scores-a", a or world / "amvnet", "--scores-b", b or world / "amvnet")
    code, error = run_cli("fuse", world / data, *scores, "--out", out, *more)
    assert (code, error.count("\n")) == ((2, 1) if error else (0, 0)), error
    return error


def labels(folder: Path) -> np.ndarray:
    found = [np.fromfile(path, np.uint32) for path in sorted(folder.rglob("*.label"))]
    assert found
    return np.concatenate(found)


def arrays(world: Path, key: str) -> np.ndarray:
    with np.load(world / "amvnet" / f"{PLACE}.npz") as file:
        return file[key]


def write_scores(folder: Path, values: Any, **more: Any) -> Path:
    """Scores of the scan 08/000000 as `.npy`, or with names as an `.npz`."""
    path = folder / f"{PLACE}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    if more:
        np.savez(path.with_suffix(".npz"), **more)
    else:
        np.save(path, values)
    return folder


# ---- the fusion


@pytest.mark.parametrize("method", ["amvnet", "ensemble"])
def test_own_scores_give_own_labels(world: Path, tmp_path: Path, method: str) -> None:
    head = ("--head", world / "w.safetensors") if method == "amvnet" else ()
    assert fused(world, tmp_path, *OWN, *head) == ""
    assert (labels(tmp_path) == labels(world / method)).mean() >= 0.999
    assert files(tmp_path) == {name for name in files(world / method) if name.endswith(".label")}


def test_the_head_and_tau_count(world: Path, tmp_path: Path) -> None:
    for name, more in {"none": ("--tau", -1), "all": ("--tau", 2)}.items():
        fused(world, tmp_path / name, *OWN, "--head", world / "w.safetensors", *more)
    assert (labels(tmp_path / "none") == labels(world / "ensemble")).mean() >= 0.999
    assert (labels(tmp_path / "all") != labels(tmp_path / "none")).mean() > 0.1


def test_lone_scans_are_fused_and_points_that_are_lost_have_no_class(
    world: Path, tmp_path: Path
) -> None:
    points = street(9, 300)[0]
    points[7] = np.nan
    points.tofile(tmp_path / "a.bin")
    result = Segmenter(fresh_weights())(points)
    for name, values in (("rv", result.rv), ("bev", result.bev)):
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "a.npy", values.astype(np.float64))
    arguments = (
        "--scores-a",
        tmp_path / "rv",
        "--scores-b",
        tmp_path / "bev",
        "--out",
        tmp_path / "out",
    )
    assert run_cli("fuse", tmp_path / "a.bin", *arguments, "--head", world / "w.safetensors") == (
        0,
        "",
    )
    found = labels(tmp_path / "out")
    assert found[7] == 0
    assert np.array_equal(found, fresh_weights().taxonomy.to_raw(result.labels))


@pytest.mark.parametrize("sides", ["a", "b", "both"])
def test_logits_are_the_same_as_their_softmax(world: Path, tmp_path: Path, sides: str) -> None:
    folders = {}
    for side, key in (("a", "rv"), ("b", "bev")):
        values = arrays(world, key).astype(np.float64).clip(1e-6)
        given = np.log(values) + 3 if sides in (side, "both") else values
        folders[side] = write_scores(tmp_path / side, given)
    more = ("--sequences", "08", "--logits", sides)
    shutil.copytree(tmp_path / "a/sequences", tmp_path / "one/sequences")
    for side, key in (("a", "rv"), ("b", "bev")):  # the second scan of the sequence
        with np.load(world / "amvnet" / PLACE.replace("000000", "000001.npz")) as file:
            values = file[key].astype(np.float64).clip(1e-6)
        path = folders[side] / PLACE.replace("000000", "000001.npy")
        np.save(path, np.log(values) if sides in (side, "both") else values)
    assert fused(world, tmp_path / "out", *more, a=folders["a"], b=folders["b"]) == ""
    own = labels(world / "ensemble/sequences/08")
    assert (labels(tmp_path / "out") == own).mean() >= 0.999


def test_arrays_that_are_no_probabilities_are_refused() -> None:
    points = street(1, 50)[0]
    with pytest.raises(ValueError, match="apply softmax"):
        fuse(points, np.full((50, 19), 2.0), np.full((50, 19), 1 / 19))


def broken(world: Path, folder: Path) -> dict[str, tuple[Path, tuple[str, ...]]]:
    """Folders of scores with something wrong in the first scan, and words of the message."""
    good = arrays(world, "rv").astype(np.float32)
    with_nan = good.copy()
    with_nan[3, 2] = np.nan
    found = {
        "logits": (write_scores(folder / "1", np.log(good + 1e-3)), ("softmax", "--logits b")),
        "NaN": (write_scores(folder / "2", with_nan), ("finite",)),
        "one point less": (write_scores(folder / "3", good[1:]), ("(500, 19)", "(499, 19)")),
        "a column more": (
            write_scores(folder / "4", np.pad(good, ((0, 0), (1, 0)))),
            ("(500, 20)", "drop the column"),
        ),
        "integers": (write_scores(folder / "5", (good * 255).astype(np.uint8)), ("uint8",)),
        "objects": (write_scores(folder / "6", np.full((500, 19), None)), ("broken",)),
        "two arrays": (
            write_scores(folder / "7", None, one=good, two=good),
            ("one, two", "--key-b"),
        ),
        "a single number": (write_scores(folder / "8", np.float32(1)), ("()",)),
        "nothing": (folder, ("000000.npz", "predict --scores")),
        "negative": (
            write_scores(folder / "9", np.tile(np.eye(19)[0] * 2 - np.eye(19)[1], (500, 1))),
            ("softmax",),
        ),
    }
    short = write_scores(folder / "10", None, one=good) / f"{PLACE}.npz"
    short.write_bytes(short.read_bytes()[:-200])
    return found | {"truncated": (folder / "10", ("broken",))}


def test_broken_scores_are_one_line_that_says_what_to_do(world: Path, tmp_path: Path) -> None:
    data = tmp_path / "one/sequences/08/velodyne"
    data.mkdir(parents=True)
    shutil.copy(world / "data/sequences/08/velodyne/000000.bin", data)
    for kind, (folder, words) in broken(world, tmp_path / "scores").items():
        scores = ("--scores-a", world / "amvnet", "--key-a", "rv", "--scores-b", folder)
        code, error = run_cli("fuse", tmp_path / "one", *scores, "--out", tmp_path / "out")
        assert (code, error.count("\n")) == (2, 1), kind
        assert all(word in error for word in words), (kind, error)
        assert not files(tmp_path / "out"), kind


def test_wrong_options_are_one_line(world: Path, tmp_path: Path) -> None:
    assert "--key-a" in fused(world, tmp_path, "--key-a", "nose", "--key-b", "bev")
    assert "expected a folder" in fused(world, tmp_path, *OWN, a=tmp_path / "none")
    assert "leave it out" in fused(
        world, tmp_path, *OWN, "--head", world / "w.safetensors", "--taxonomy", "nuscenes"
    )
    assert "nuscenes" in fused(world, tmp_path, *OWN, "--taxonomy", "nuscenes")
    train = ("train", world / "recipe.yaml", "--data", world / "data", "--out", tmp_path / "run")
    scores = ("--scores-a", world / "amvnet", "--scores-b", world / "amvnet")
    for more, word in (
        ((*scores, *OWN), "--stage head"),
        ((*scores[:2], "--stage", "head"), "--scores-b"),
    ):
        code, error = run_cli(*train, *more)
        assert code == 2
        assert word in error
    assert not files(tmp_path)


# ---- training a head for them


@pytest.fixture(scope="module")
def run(world: Path) -> Path:
    """A run of the head alone, for the networks' scores from files."""
    out = world / "head"
    assert run_cli(*training(world, out)) == (0, "")
    return out


def training(world: Path, out: Path) -> list[Any]:
    scores = ("--scores-a", world / "amvnet", "--scores-b", world / "amvnet", *OWN)
    return [
        "train",
        world / "recipe.yaml",
        "--data",
        world / "data",
        "--stage",
        "head",
        "--out",
        out,
        *scores,
    ]


def test_a_head_for_files_is_the_head_for_the_networks_that_wrote_them(
    world: Path, run: Path, tmp_path: Path
) -> None:
    # The networks alone: a head to begin with would be trained further.
    weights = fresh_weights()
    networks = {k: v for k, v in weights.tensors.items() if not k.startswith("point_head")}
    save(type(weights)(weights.model, weights.taxonomy, "", networks), tmp_path / "w.safetensors")
    command = [*training(world, tmp_path / "run")[:-8], "--init", tmp_path / "w.safetensors"]
    assert run_cli(*command) == (0, "")
    own, from_files = load(tmp_path / "run").part("point_head"), load(run).part("point_head")
    # A score that float16 puts on the other side of tau changes which points are drawn: alike, not equal.
    assert own.keys() == from_files.keys()
    reached = [
        load(path).metrics["point_head"]["val/uncertain"] for path in (tmp_path / "run", run)
    ]
    assert reached[0] == pytest.approx(reached[1], abs=0.005)


def test_the_weights_hold_the_head_alone_and_fuse_takes_them(
    world: Path, run: Path, tmp_path: Path
) -> None:
    weights = load(run)
    assert weights.parts == ("point_head",)
    assert weights.model.assertion == fresh_weights().model.assertion
    assert fused(world, tmp_path, *OWN, "--head", run) == ""
    points = np.fromfile(world / "data/sequences/08/velodyne/000000.bin", np.float32).reshape(-1, 4)
    ids = fuse(points, arrays(world, "rv"), arrays(world, "bev"), head=run)
    own = np.fromfile(tmp_path / f"{PLACE}.label", np.uint32)
    assert np.array_equal(weights.taxonomy.to_raw(ids), own)
    assert (
        "range_net"
        in run_cli("predict", world / "data", "--weights", run, "--out", tmp_path / "x")[1]
    )


def test_the_run_says_its_scores_and_resumes_with_them_alone(
    world: Path, run: Path, tmp_path: Path
) -> None:
    said = yaml.safe_load((run / "run.yaml").read_text())["head"]
    repeat = shlex.split(said["repeat"])[1:]
    assert run_cli(*repeat) == (0, "")
    again, once = load(repeat[-1 - repeat[::-1].index("--out") + 1]), load(run)
    assert all(again.digest(part) == once.digest(part) for part in once.parts)
    assert run_cli(*training(world, run), "--resume") == (0, "")
    swapped = [{"rv": "bev", "bev": "rv"}.get(str(word), word) for word in training(world, run)]
    code, error = run_cli(*swapped, "--resume")
    assert code == 2
    assert "scores" in error


# ---- the page of the docs


def test_every_command_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("embreex")
    monkeypatch.chdir(tmp_path)
    shutil.copy(DOCS / "tiny_model.py", tmp_path)
    page = (DOCS / "fusing.md").read_text()
    commands = [
        line
        for block in re.findall(r"```bash\n(.*?)```", page, re.S)
        for line in block.splitlines()
    ]
    assert len(commands) >= 8
    for command in commands:
        words = shlex.split(command.replace("--scans 4", "--scans 1"))
        if words[0] == "python":
            subprocess.run([sys.executable, *words[1:]], check=True)
            continue
        less = (
            ("--training.head.epochs", 1, "--training.head.points", 3000)
            if words[1] == "train"
            else ()
        )
        assert words[0] == "amvnet"
        assert run_cli(*words[1:], *less) == (0, ""), command
    assert (labels(Path("again")) == labels(Path("both"))).mean() >= 0.999
