"""Two models' scores are fused from files, and a head is trained for them."""

from __future__ import annotations

import contextlib
import io
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet import fuse
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.inference.scores import ScoreFolder, ScorePair
from amvnet.weights.file import load, save

from fixtures.commands import files, refusal, refused, run_cli
from fixtures.pages import Changes, DocsPage, run
from fixtures.tiny import fresh_weights, make_simulation_quick, street, without

DOCS = Path(__file__).parents[2] / "docs"
SCAN = "sequences/08/predictions/000000"
NEXT_SCAN = "sequences/08/predictions/000001"
KEYS = {"a": "rv", "b": "bev"}


@pytest.fixture(scope="module")
def labels(world: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders of predictions by two methods, to be only read."""
    ensemble = tmp_path_factory.mktemp("ensemble")
    options = ("--weights", world / "w.safetensors", "--method", "ensemble", "--out", ensemble)
    assert run_cli("predict", world / "data", *options) == (0, "")
    return {"amvnet": world / "predictions", "ensemble": ensemble}


def run_fuse(
    world: Path, out: Path, *options: Any, a: Path | None = None, b: Path | None = None
) -> str:
    """Run `amvnet fuse` on the world's scores, or on others; return the error message."""
    scores = ("--scores-a", a or world / "predictions", "--scores-b", b or world / "predictions")
    options = (*scores, "--out", out, *options)
    code, error = run_cli("fuse", world / "data", *options)
    expected = (2, 1) if error else (0, 0)
    assert (code, error.count("\n")) == expected, error
    return error


def read_labels(folder: Path) -> np.ndarray:
    labels = [np.fromfile(path, np.uint32) for path in sorted(folder.rglob("*.label"))]
    assert labels
    return np.concatenate(labels)


def read_probabilities(world: Path, key: str, scan: str = SCAN) -> np.ndarray:
    with np.load(world / "predictions" / f"{scan}.npz") as file:
        return file[key]


def write_scores(folder: Path, scores: Any, scan: str = SCAN) -> Path:
    """Write the scores of a scan, an array as `.npy` or named ones as `.npz`; return the folder."""
    path = folder / f"{scan}.npy"
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(scores, dict):
        np.savez(path.with_suffix(".npz"), **scores)
    else:
        np.save(path, scores)
    return folder


# ---- the fusion


@pytest.mark.parametrize("method", ["amvnet", "ensemble"])
def test_the_scores_of_predict_give_its_labels(
    world: Path, labels: dict[str, Path], tmp_path: Path, method: str
) -> None:
    head = ("--head", world / "w.safetensors") if method == "amvnet" else ()
    assert run_fuse(world, tmp_path, *head) == ""

    assert (read_labels(tmp_path) == read_labels(labels[method])).mean() >= 0.999

    assert files(tmp_path) == {name for name in files(labels[method]) if name.endswith(".label")}


def test_the_head_and_tau_count(world: Path, labels: dict[str, Path], tmp_path: Path) -> None:
    options = ("--head", world / "w.safetensors", "--tau")
    run_fuse(world, tmp_path / "none", *options, 0)
    run_fuse(world, tmp_path / "all", *options, 1)

    without_head = read_labels(tmp_path / "none")
    assert (without_head == read_labels(labels["ensemble"])).mean() >= 0.999
    assert (read_labels(tmp_path / "all") != without_head).mean() > 0.1


def test_single_scans_are_fused_and_lost_points_have_no_class(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = street(9, 300)[0]
    points[7] = np.nan
    points.tofile(tmp_path / "a.bin")
    weights = fresh_weights()
    result = amvnet.load(weights)(points)

    for name, probabilities in (("rv", result.rv), ("bev", result.bev)):
        assert probabilities is not None
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "a.npy", probabilities.astype(np.float64))

    out = tmp_path / "out"
    scores = ("--scores-a", tmp_path / "rv", "--scores-b", tmp_path / "bev")
    options = (*scores, "--head", world / "w.safetensors", "--out", out)
    assert run_cli("fuse", tmp_path / "a.bin", *options) == (0, "")
    assert "no opinion" not in capsys.readouterr().out  # lost points do not count

    labels = read_labels(out)
    assert labels[7] == 0
    assert np.array_equal(labels, weights.taxonomy.to_raw(result.labels))


@pytest.mark.parametrize("sides", ["a", "b", "both"])
def test_logits_are_the_same_as_their_softmax(
    world: Path, labels: dict[str, Path], tmp_path: Path, sides: str
) -> None:
    for side, key in KEYS.items():
        for scan in (SCAN, NEXT_SCAN):
            scores = read_probabilities(world, key, scan).astype(np.float64).clip(1e-6)
            if sides in (side, "both"):
                scores = np.log(scores) + 3
            write_scores(tmp_path / side, scores, scan)

    options = ("--sequences", "08", "--logits", sides)
    out = tmp_path / "out"
    assert run_fuse(world, out, *options, a=tmp_path / "a", b=tmp_path / "b") == ""
    assert (read_labels(out) == read_labels(labels["ensemble"] / "sequences/08")).mean() >= 0.999


def test_rows_of_zeros_are_no_opinion(world: Path, tmp_path: Path) -> None:
    uniform = {}
    for side, key in KEYS.items():
        for scan in (SCAN, NEXT_SCAN):
            scores = read_probabilities(world, key, scan).astype(np.float32)
            if side == "b":
                scores[::4] = 0
                uniform[scan] = np.where(scores.any(axis=1, keepdims=True), scores, 1 / 19)
            write_scores(tmp_path / side, scores, scan)
            write_scores(tmp_path / f"uniform {side}", uniform.get(scan, scores), scan)

    options = ("--sequences", "08")
    stdout = io.StringIO()
    with contextlib.redirect_stdout(stdout):
        run_fuse(world, tmp_path / "zeros", *options, a=tmp_path / "a", b=tmp_path / "b")
    assert f"{tmp_path / 'b'} (b): no opinion on 25.0% of the points" in stdout.getvalue()
    assert f"{tmp_path / 'a'} (a): no opinion" not in stdout.getvalue()
    folders = {"a": tmp_path / "uniform a", "b": tmp_path / "uniform b"}
    run_fuse(world, tmp_path / "uniform", *options, **folders)
    labels = read_labels(tmp_path / "zeros")
    assert np.array_equal(labels, read_labels(tmp_path / "uniform"))

    # Without a head, the model that has an opinion decides.
    alone = SEMANTICKITTI.to_raw(read_probabilities(world, "rv").argmax(axis=1)[::4] + 1)
    assert np.array_equal(labels[: len(read_probabilities(world, "rv"))][::4], alone)


def test_arrays_with_rows_of_zeros_are_fused_alike() -> None:
    points = street(1, 50)[0]
    f, g = np.random.default_rng(0).dirichlet(np.ones(19), (2, 50)).astype(np.float32)
    g[:10] = 0
    assert np.array_equal(fuse(points, f, g)[:10], f[:10].argmax(axis=1) + 1)
    with pytest.raises(ValueError, match="zeros in every row"):
        fuse(points, f, np.zeros_like(g))


def test_probabilities_are_no_logits(world: Path, tmp_path: Path) -> None:
    for side, key in KEYS.items():
        for scan in (SCAN, NEXT_SCAN):
            scores = read_probabilities(world, key, scan)
            scores[::3] = 0
            write_scores(tmp_path / side, scores, scan)
    folders = {"a": tmp_path / "a", "b": tmp_path / "b"}
    out = tmp_path / "out"
    error = run_fuse(world, out, "--sequences", "08", "--logits", "both", **folders)
    assert "rows add up to 1; leave out --logits" in error
    assert not files(out)


def test_arrays_that_are_no_probabilities_are_refused() -> None:
    points = street(1, 50)[0]
    with pytest.raises(ValueError, match="apply softmax"):
        fuse(points, np.full((50, 19), 2.0), np.full((50, 19), 1 / 19))


@dataclass(frozen=True)
class BrokenScores:
    """Scores with something wrong.

    Attributes:
        scores: of the first scan: an array, or named arrays; None if there is no file.
        words: of the message.
        cut: bytes missing at the end of the file.
    """

    scores: Any
    words: tuple[str, ...]
    cut: int = 0


def broken_scores(good: np.ndarray) -> dict[str, BrokenScores]:
    """Break the (500, 19) probabilities of a scan in every way."""
    with_nan = good.copy()
    with_nan[3, 2] = np.nan
    negative = np.zeros_like(good)
    negative[:, 0] = 2
    negative[:, 1] = -1
    logits = np.log(good + 1e-3)
    integers = (good * 255).astype(np.uint8)
    column_more = np.pad(good, ((0, 0), (1, 0)))

    return {
        "logits": BrokenScores(logits, ("softmax", "--logits b")),
        "NaN": BrokenScores(with_nan, ("finite",)),
        "negative": BrokenScores(negative, ("softmax",)),
        "one point less": BrokenScores(good[1:], ("(500, 19)", "(499, 19)")),
        "a column more": BrokenScores(column_more, ("(500, 20)", "drop the column")),
        "transposed": BrokenScores(good.T, ("(19, 500)", "transpose them")),
        "other classes": BrokenScores(good[:, :5], ("(500, 5)", "the classes of the scores")),
        "a single number": BrokenScores(np.float32(1), ("()",)),
        "integers": BrokenScores(integers, ("uint8",)),
        "objects": BrokenScores(np.full((500, 19), None), ("broken",)),
        "two arrays": BrokenScores(
            {"one": good, "two": good}, ("one, two", "save the scores of one model")
        ),
        "truncated": BrokenScores({"one": good}, ("broken",), cut=200),
        "no file": BrokenScores(None, ("000000.npz", "predict --scores")),
    }


def test_broken_scores_are_one_line_that_says_what_to_do(world: Path, tmp_path: Path) -> None:
    data = tmp_path / "data/sequences/08/velodyne"
    data.mkdir(parents=True)
    shutil.copy(world / "data/sequences/08/velodyne/000000.bin", data)
    good = read_probabilities(world, "rv").astype(np.float32)

    for kind, broken in broken_scores(good).items():
        folder = tmp_path / kind
        folder.mkdir()
        if broken.scores is not None:
            write_scores(folder, broken.scores)
        if broken.cut:
            path = folder / f"{SCAN}.npz"
            path.write_bytes(path.read_bytes()[: -broken.cut])

        scores = ("--scores-a", world / "predictions", "--scores-b", folder)
        out = tmp_path / "out"
        error = refusal("fuse", tmp_path / "data", *scores, "--out", out)
        for word in broken.words:
            assert word in error, kind
        assert not files(out), kind


def test_wrong_options_of_fuse_are_one_line(world: Path, tmp_path: Path) -> None:
    taxonomy = ("--taxonomy", "nuscenes")

    assert "expected a folder" in run_fuse(world, tmp_path, a=tmp_path / "none")
    assert "leave it out" in run_fuse(world, tmp_path, "--head", world / "w.safetensors", *taxonomy)
    assert "nuscenes" in run_fuse(world, tmp_path, *taxonomy)
    assert not files(tmp_path)


@pytest.mark.full
def test_wrong_scores_of_a_training_are_one_line(world: Path, tmp_path: Path) -> None:
    arguments = ("train", world / "recipe.yaml", "--data", world / "data", "--out", tmp_path)
    both = score_options(world)
    cases = {"--stage head": both, "--scores-b": [*both[:2], "--stage", "head"]}
    for word, options in cases.items():
        refused((*arguments, *options), word)
    assert not files(tmp_path)


# ---- training a head for them


def train_head_arguments(world: Path, out: Path) -> list[Any]:
    recipe = world / "recipe.yaml"
    return ["train", recipe, "--data", world / "data", "--stage", "head", "--out", out]


def score_options(world: Path) -> list[Any]:
    scores = world / "predictions"
    return ["--scores-a", scores, "--scores-b", scores]


@pytest.fixture(scope="module")
def head(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train the head alone, on the networks' scores from files."""
    out = tmp_path_factory.mktemp("trained") / "head"
    assert run_cli(*train_head_arguments(world, out), *score_options(world)) == (0, "")
    return out


@pytest.mark.full
def test_a_head_for_files_is_that_of_networks(world: Path, head: Path, tmp_path: Path) -> None:
    # Without the world's head, which would be trained further
    networks = save(without(fresh_weights(), "point_head"), tmp_path / "networks.safetensors")
    assert run_cli(*train_head_arguments(world, tmp_path / "run"), "--init", networks) == (0, "")

    from_networks = load(tmp_path / "run")
    from_files = load(head)
    assert from_networks.part("point_head").keys() == from_files.part("point_head").keys()
    # A score that float16 puts on the other side of tau changes which points are drawn: the two
    # are alike, not equal.
    expected = from_networks.metrics["point_head"]["val/uncertain"]
    assert from_files.metrics["point_head"]["val/uncertain"] == pytest.approx(expected, abs=0.005)


@pytest.mark.full
def test_fuse_takes_the_weights_of_the_head_alone(world: Path, head: Path, tmp_path: Path) -> None:
    weights = load(head)
    assert weights.parts == ("point_head",)
    assert weights.model.assertion == fresh_weights().model.assertion

    assert run_fuse(world, tmp_path, "--head", head) == ""

    points = np.fromfile(world / "data/sequences/08/velodyne/000000.bin", np.float32).reshape(-1, 4)
    f = read_probabilities(world, "rv")
    ids = fuse(points, f, read_probabilities(world, "bev"), head=head)
    labels = np.fromfile(tmp_path / f"{SCAN}.label", np.uint32)
    assert np.array_equal(weights.taxonomy.to_raw(ids), labels)

    _, error = run_cli("predict", world / "data", "--weights", head, "--out", tmp_path / "x")
    assert "range_net" in error


@pytest.mark.full
def test_the_run_resumes_with_its_own_scores_only(world: Path, head: Path) -> None:
    arguments = [*train_head_arguments(world, head), "--resume"]
    assert run_cli(*arguments, *score_options(world)) == (0, "")

    refused((*arguments, *score_options(world), "--logits", "a"), "scores")


@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_a_digest_of_scores_sees_any_changed_point_of_an_archive_and_the_last_of_an_array(
    ending: str, tmp_path: Path
) -> None:
    record = ScanFile("a", Recording("00"), tmp_path / "a.bin", prediction="a.label")
    scores = np.full((2000, 19), 1 / 19, np.float32)

    def digest() -> str:
        path = tmp_path / f"a.{ending}"
        np.save(path, scores) if ending == "npy" else np.savez(path, rv=scores)
        folder = ScoreFolder("a", tmp_path)
        return ScorePair(folder, folder).digests([record])["a"]

    digests = {digest()}
    for point in (-1,) if ending == "npy" else (0, 1000, -1):
        scores[point] = np.eye(19)[3]
        digests.add(digest())
        scores[point] = 1 / 19
    assert digest() in digests
    assert len(digests) == (2 if ending == "npy" else 4)


# ---- the page of the docs


@pytest.mark.full
def test_every_command_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_simulation_quick(monkeypatch)
    monkeypatch.chdir(tmp_path)
    shutil.copy(DOCS / "tiny_model.py", tmp_path)
    commands = DocsPage("docs/fusing.md").commands
    assert len(commands) >= 8
    head = {"--training.head.epochs": 1, "--training.head.points": 3000}
    run(commands, Changes(values={"train": head}))
    assert (read_labels(Path("again")) == read_labels(Path("both"))).mean() >= 0.999
