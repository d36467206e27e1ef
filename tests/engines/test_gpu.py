"""What differs on a GPU: neighbours by blocks, streams, precision. Without one, tested on a CPU."""

from __future__ import annotations

import contextlib
import runpy
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

import amvnet
from amvnet import Scan, Segmenter, load, simulate
from amvnet import read as read_scan
from amvnet.engines.compute import Precision, choose_device, choose_precision
from amvnet.engines.torch import InPrecision, TwoStreams
from amvnet.inference.journal import Entry, Journal
from amvnet.inference.pipeline import OutputOptions, Pipeline
from amvnet.inference.predict import segment_by
from amvnet.inference.scan_stream import READ_AHEAD
from amvnet.models import neighbours_gpu as block_search
from amvnet.models.amvnet import LateFusion
from amvnet.models.assertion import Disagreement
from amvnet.models.neighbours import nearest_others
from amvnet.models.neighbours_gpu import nearest_others_by_blocks, split_into_blocks
from amvnet.models.views.points import PointBatch
from amvnet.sensors.lidars import Sensor
from amvnet.sensors.reading import AS_FOUND
from amvnet.weights.file import Weights, save

from fixtures.commands import fails, files, refused, run_cli
from fixtures.counted_scans import Counter, counted_scans
from fixtures.engines import ScriptedEngine, sure_of
from fixtures.networks import whole_model
from fixtures.pages import DocsPage
from fixtures.sensors import LASERS, place
from fixtures.tiny import fresh_weights, make_simulation_quick, make_streets, street

N = 15
no_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
DEVICES = ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, no_gpu])]


@pytest.fixture(scope="module")
def simulated_scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Simulate a scan of an HDL-64E with nothing large beside the sensor."""
    folder = simulate(tmp_path_factory.mktemp("streets"), scans=1, seed=4)
    return read_scan(folder / "sequences/00/velodyne/000000.bin")


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    random = rng.normal(0, (20, 20, 2), (5000, 3))
    centres = rng.normal(0, 100, (20, 3))[rng.integers(0, 20, 5000)]
    clusters = rng.normal(0, 0.01, (5000, 3))
    line = np.zeros((4000, 3))
    line[:, 1] = rng.random(4000) * 50
    sphere = random / np.linalg.norm(random, axis=1, keepdims=True)
    far = random[2000:4000] + np.array([9900, -9900, 0])

    return {
        "random": random,
        "clusters": centres + clusters,
        "on a line": line,
        "each thrice": np.repeat(random[:1500], 3, axis=0),
        "each eighty times": np.repeat(random[:40], 80, axis=0),
        "in one place": np.ones((3000, 3)),
        "on a lattice": np.stack(np.meshgrid(*[np.arange(16.0)] * 3), axis=-1).reshape(-1, 3),
        "10 km apart": np.concatenate([random[:2000], far, [[-9999, 9999, 9999]]]),
        # At 9 km float32 resolves a millimetre.
        "nearly in one place": 9000 + rng.normal(0, 0.004, (3000, 3)),
        # The squares of these distances are 0 in float32.
        "hardly apart": rng.normal(0, 1e-22, (3000, 3)),
        # Nearly equally far from the centre: float32 cannot tell which are the nearest.
        "on a sphere": np.concatenate([np.zeros((10, 3)), sphere[:300], random[:2000] * 10]),
        "few": random[:40],
    }


def check_nearest(xyz: Tensor, own: Tensor, n: int = N) -> None:
    """Compare the distances by blocks, all of different points, with an exact k-d tree's."""
    nearest = nearest_others_by_blocks(xyz, own, n).cpu().numpy()
    index = own.cpu().numpy()
    points = xyz.double().cpu().numpy()
    others = min(n, len(points) - 1)

    # The tree's first result has the distance 0: it is the point itself, or one in its place.
    distance = np.linalg.norm(points[nearest] - points[index][:, None], axis=2)
    expected = np.asarray(cKDTree(points).query(points[index], k=others + 1)[0])
    np.testing.assert_allclose(distance[:, :others], expected[:, 1:], rtol=1e-12, atol=0)

    assert not (nearest[:, :others] == index[:, None]).any()
    assert (np.diff(np.sort(nearest[:, :others], axis=1), axis=1) > 0).all()
    assert (nearest[:, others:] == nearest[:, [others - 1]]).all()


def permutation(count: int) -> Tensor:
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", clouds())
def test_neighbours_by_blocks_are_the_nearest_others(name: str, device: str) -> None:
    xyz = torch.from_numpy(clouds()[name].astype(np.float32)).to(device)
    check_nearest(xyz, permutation(len(xyz)).to(device)[:1000])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("points", [2, 3, 15, 16, 17, 1023, 1024, 1025, 1100, 2048, 2049])
def test_neighbours_by_blocks_of_any_number_of_points(points: int, device: str) -> None:
    xyz = torch.randn(points, 3, generator=torch.Generator().manual_seed(points)).to(device)
    check_nearest(xyz, torch.arange(0, points, max(1, points // 50), device=device))


@pytest.mark.parametrize("n", [1, 40, 500, 2000])
def test_any_number_of_neighbours_by_blocks(n: int) -> None:
    xyz = torch.randn(1500, 3, generator=torch.Generator().manual_seed(0))
    check_nearest(xyz, torch.arange(0, 1500, 50), n)


def test_neighbours_by_blocks_keep_to_the_rules_for_few_points() -> None:
    line = torch.tensor([[0.0, 0, 0], [5, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert nearest_others_by_blocks(line, torch.tensor([0, 1]), 6).tolist() == [
        [2, 3, 1, 1, 1, 1],
        [3, 2, 0, 0, 0, 0],
    ]
    assert nearest_others_by_blocks(torch.ones(1, 3), torch.tensor([0]), 3).tolist() == [[0, 0, 0]]

    nobody = torch.zeros(0, dtype=torch.long)
    assert nearest_others_by_blocks(torch.randn(5, 3), nobody, 3).shape == (0, 3)


def test_neighbours_by_blocks_equal_the_trees_on_a_scan_and_few_points_are_compared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    points, _ = place(LASERS["os1-64"], 1.7, steps=1500)
    xyz = torch.from_numpy(points[:, :3].copy())
    own = permutation(len(xyz))[:4000]
    searched_among_all: list[int] = []
    nearest_of_all = block_search._nearest_of_all

    def counted(xyz: Tensor, own: Tensor, n: int) -> Tensor:
        searched_among_all.append(len(own))
        return nearest_of_all(xyz, own, n)

    monkeypatch.setattr(block_search, "_nearest_of_all", counted)
    by_blocks = np.sort(nearest_others_by_blocks(xyz, own, N).numpy(), axis=1)
    by_tree = np.sort(nearest_others(xyz.numpy(), own.numpy(), N), axis=1)

    # pykdtree rounds distances to float32.
    assert (by_blocks == by_tree).all(axis=1).mean() > 0.999

    # Distances for each point: to all boxes, to points in blocks, and for some to all points
    blocks = split_into_blocks(xyz)
    in_blocks = block_search.SEARCHED_BLOCKS * blocks.index.shape[1]
    in_all = sum(searched_among_all) / len(own) * len(xyz)
    assert len(blocks.index) + in_blocks + in_all < 0.03 * len(xyz)


@pytest.mark.parametrize("device", DEVICES)
def test_neighbours_of_points_in_one_place_are_found_in_few_blocks(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(block_search, "_nearest_of_all", None)
    check_nearest(torch.ones(20_000, 3, device=device), torch.arange(0, 20_000, 40, device=device))


def test_parts_of_little_memory_change_no_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = torch.randn(3000, 3)
    whole = nearest_others_by_blocks(xyz, torch.arange(500), N)
    monkeypatch.setattr(block_search, "STEP_MEMORY", 1 << 20)
    assert torch.equal(nearest_others_by_blocks(xyz, torch.arange(500), N), whole)


def test_blocks_hold_every_point_once_within_their_boxes() -> None:
    xyz = torch.randn(3001, 3)
    blocks = split_into_blocks(xyz)
    used = blocks.index < len(xyz)
    assert torch.equal(blocks.index[used].sort().values, torch.arange(3001))
    assert blocks.index.shape[1] <= block_search.BLOCK_SIZE

    points = blocks.points.transpose(1, 2)  # (M, B, 3)
    assert torch.equal(points[used], xyz[blocks.index[used]])
    assert points[~used].isinf().all()
    inside = (points >= blocks.low[:, None]) & (points <= blocks.high[:, None])
    assert inside.all(dim=2)[used].all()


@dataclass
class StandInStream:
    """A stand-in for a CUDA stream, which adds its waits to a log."""

    name: str
    log: list[str]

    def wait_stream(self, other: StandInStream) -> None:
        self.log.append(f"{self.name} waits for {other.name}")


class StandInCuda:
    """A stand-in for CUDA's streams; the log says what is done, in order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.log: list[str] = []
        self.current = StandInStream("main", self.log)
        monkeypatch.setattr(torch.cuda, "Stream", lambda device: StandInStream("side", self.log))
        monkeypatch.setattr(torch.cuda, "current_stream", lambda device: self.current)
        monkeypatch.setattr(torch.cuda, "stream", self.switch_to)
        monkeypatch.setattr(Tensor, "record_stream", self.record_stream)

    @contextlib.contextmanager
    def switch_to(self, stream: StandInStream) -> Iterator[None]:
        before = self.current
        self.current = stream
        yield
        self.current = before

    def record_stream(self, stream: StandInStream) -> None:
        self.log.append(f"kept for {stream.name}")

    @contextlib.contextmanager
    def log_step(self, name: str) -> Iterator[None]:
        """Log a step of AMVNet with the stream that it runs on."""
        self.log.append(f"{name} on {self.current.name}")
        yield


def test_two_streams_wait_before_and_after_the_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    cuda = StandInCuda(monkeypatch)
    model = whole_model()
    batch = PointBatch.of([Scan(street(0)[0])])
    before = model(batch)

    model.arrange = TwoStreams("cuda")
    model.watch = cuda.log_step
    after = model(batch)
    assert cuda.log == [
        "project on main",
        "side waits for main",
        "RV on side",
        "BEV on main",
        "main waits for side",
        "kept for main",
        "compare on main",
        "neighbours on main",
        "head on main",
        "merge on main",
    ]
    assert torch.equal(after.merged, before.merged)


def test_the_merge_of_a_gpu_is_that_of_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    f, g = torch.rand(2, 30, 4)
    h = torch.rand(10, 4)
    uncertain = torch.arange(30) % 3 == 1
    nothing = torch.zeros(30, dtype=torch.bool)
    merge = LateFusion(Disagreement(), None).merge
    some_refined = merge(f, g, uncertain, h)
    none_refined = merge(f, g, nothing, h[:0])

    monkeypatch.setattr(Tensor, "is_cpu", False)
    assert torch.equal(merge(f, g, uncertain, h), some_refined)
    assert torch.equal(merge(f, g, nothing, h[:0]), none_refined)


def check_bfloat16(weights: str | Weights, scan: Scan) -> None:
    exact = amvnet.load(weights)(scan)
    lower = amvnet.load(weights, precision="bfloat16")(scan)
    for name in ("scores", "rv", "bev"):
        assert getattr(lower, name).dtype == np.float32
        assert not np.array_equal(getattr(lower, name), getattr(exact, name))
    assert (lower.labels == exact.labels).mean() > 0.98
    assert (lower.uncertain == exact.uncertain).mean() > 0.97


def test_bfloat16_gives_the_labels_of_float32_on_nearly_all_points() -> None:
    check_bfloat16(fresh_weights(), Scan(street(0, 4000)[0]))


@pytest.mark.full
def test_bfloat16_gives_the_labels_of_float32_on_a_simulated_scan(simulated_scan: Scan) -> None:
    check_bfloat16("sim-hdl64e", simulated_scan)


class PrecisionProbe(nn.Module):
    """Records in which precision it multiplied, and whether TF32 was allowed."""

    def forward(self, x: Tensor) -> Tensor:
        self.dtype = (x @ x).dtype
        self.tf32 = torch.backends.cudnn.allow_tf32
        return x @ x


@pytest.mark.parametrize(
    ("precision", "dtype"), [("float32", torch.float32), ("bfloat16", torch.bfloat16)]
)
def test_a_network_multiplies_in_its_precision_and_scores_in_float32(
    precision: Precision, dtype: torch.dtype
) -> None:
    net = PrecisionProbe()
    assert InPrecision(net, "cpu", precision)(torch.ones(2, 2)).dtype == torch.float32
    assert net.dtype == dtype
    assert not torch.is_autocast_enabled("cpu")


@pytest.mark.parametrize(("setting", "allowed"), [("highest", False), ("high", True)])
def test_tf32_is_used_only_if_it_was_asked_for(setting: str, allowed: bool) -> None:
    net = PrecisionProbe()
    before = torch.get_float32_matmul_precision()
    tf32_before = torch.backends.cudnn.allow_tf32

    torch.set_float32_matmul_precision(setting)
    try:
        # The settings are those for a GPU, also if the tensors are not on one.
        InPrecision(net, "cuda", "float32")(torch.ones(2, 2))
    finally:
        torch.set_float32_matmul_precision(before)

    assert net.tf32 == allowed
    assert torch.backends.cudnn.allow_tf32 == tf32_before


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_network_on_a_cpu_leaves_the_settings_of_gpus_alone(precision: Precision) -> None:
    """They belong to the process, and several threads would set them back in the wrong order."""
    net = PrecisionProbe()
    InPrecision(net, "cpu", precision)(torch.ones(2, 2))
    assert net.tf32 == torch.backends.cudnn.allow_tf32


@pytest.mark.parametrize(
    ("has_gpu", "has_bfloat16", "device", "precision"),
    [
        (False, False, "cpu", "float32"),
        (True, True, "cuda", "bfloat16"),
        (True, False, "cuda", "float32"),
    ],
)
def test_a_gpu_is_used_if_there_is_one_in_bfloat16_if_it_has_it(
    has_gpu: bool, has_bfloat16: bool, device: str, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: has_gpu)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda **_: has_bfloat16)
    assert choose_device("auto") == device
    assert choose_precision("auto", device) == precision

    # What is named is used, and ONNX Runtime is used on a CPU only.
    assert choose_device("cuda:1") == "cuda:1"
    assert choose_precision("float32", "cuda") == "float32"
    assert choose_device("auto", "onnx") == "cpu"


def test_on_a_cpu_auto_is_float32_on_the_cpu_and_the_commands_say_so(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    segmenter = load(str(world / "w.safetensors"))
    assert (segmenter.device, segmenter.engine.precision) == ("cpu", "float32")

    arguments = ("predict", world / "data", "--weights", world / "w.safetensors")
    assert run_cli(*arguments, "--out", tmp_path) == (0, "")
    assert capsys.readouterr().out.count("computing on cpu in float32\n") == 1


@pytest.mark.parametrize("precision", ["float16", "float64", ""])
def test_a_precision_that_a_cpu_lacks_is_refused(precision: Any) -> None:
    weights = fresh_weights()
    fails(lambda: amvnet.load(weights, "cpu", precision=precision), "expected", precision)


class Launches(TorchDispatchMode):
    """Counts the operators that compute or copy, each of which a GPU has to be told to run."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        is_view = any(
            value.alias_info and not value.alias_info.is_write for value in func._schema.returns
        )
        self.count += not is_view and "empty" not in str(func)
        return func(*args, **(kwargs or {}))


def test_a_gpu_is_told_few_times_what_to_do_around_the_networks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = whole_model().eval()
    points = np.random.default_rng(0).normal(0, (20, 20, 1, 0.1), (100_000, 4)).astype(np.float32)
    batch = PointBatch.of([Scan(points)])

    # The code that a GPU runs, on tensors that are none of the CPU's
    monkeypatch.setattr(Tensor, "is_cpu", False)
    monkeypatch.setattr(Tensor, "is_cuda", True)
    with torch.no_grad():
        with Launches() as project:
            image, grid = model.project(batch)
        f, g = model.score(image, grid)
        uncertain = torch.arange(len(points)) % 40 == 0
        with Launches() as fuse:
            h = model.refine(batch, f, g, uncertain)
            model.merge(f, g, model.compare(batch, f, g) & uncertain, h)
    assert project.count <= 55
    assert project.count + fuse.count <= 155


def street_scans(*counts: int) -> list[Scan]:
    return [Scan(street(seed, count)[0], name=str(seed)) for seed, count in enumerate(counts)]


def test_a_batch_knows_its_scans_without_looking_at_the_points() -> None:
    scans = street_scans(100, 101, 102)
    scans[1].points[7] = np.nan
    batch = PointBatch.of(scans)

    expected = [slice(0, 100), slice(100, 200), slice(200, 302)]
    assert (batch.slices, batch.to("cpu").slices) == (expected, expected)
    assert PointBatch(batch.points, batch.scan, 3).slices == expected


def test_several_scans_at_a_time_are_segmented_as_each_alone() -> None:
    segmenter = amvnet.load(fresh_weights())
    scans = street_scans(300, 350, 400)
    scans[1].points[[0, 9]] = np.nan

    for scan, together in zip(scans, segmenter.many(scans), strict=True):
        alone = segmenter(scan)
        assert (together.labels == alone.labels).mean() > 0.995
        for name in ("rv", "bev"):
            np.testing.assert_allclose(
                getattr(together, name), getattr(alone, name), rtol=1e-4, atol=1e-5
            )

        labelled = together.labels > 0
        assert np.array_equal(labelled, alone.labels > 0)
        best = together.scores.argmax(axis=1) + 1
        assert np.array_equal(together.labels[labelled], best[labelled])


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write weights, a dataset, and seven lone scans, one broken and one without a finite point."""
    root = tmp_path_factory.mktemp("world")
    save(fresh_weights(), root / "w.safetensors")
    make_streets(root / "data")

    (root / "scans").mkdir()
    for seed in range(7):
        street(seed, 400 + 10 * seed)[0].tofile(root / f"scans/{seed:06d}.bin")
    (root / "scans/000002.bin").write_bytes(b"123")
    np.full((5, 4), np.nan, np.float32).tofile(root / "scans/000004.bin")
    return root


@pytest.mark.parametrize(
    ("inputs", "code", "written"),
    [(("data", "scans"), 3, 11), pytest.param(("data",), 0, 6, marks=pytest.mark.full)],
)
def test_predicting_three_at_a_time_writes_what_one_at_a_time_does(
    world: Path, tmp_path: Path, inputs: tuple[str, ...], code: int, written: int
) -> None:
    errors = []
    for batch in (1, 3):
        paths = [world / name for name in inputs]
        options = ("--weights", world / "w.safetensors", "--scores", "--batch", batch)
        exit_code, error = run_cli("predict", *paths, *options, "--out", tmp_path / str(batch))
        assert exit_code == code
        errors.append(sorted(error.splitlines()))
    assert errors[0] == errors[1]

    names = files(tmp_path / "1")
    assert names == files(tmp_path / "3")
    assert sum(name.endswith(".label") for name in names) == written
    for name in names:
        first = tmp_path / "1" / name
        second = tmp_path / "3" / name
        if name.endswith(".label"):
            equal = np.fromfile(first, np.uint32) == np.fromfile(second, np.uint32)
            assert equal.mean() > 0.99
            continue

        for view in ("rv", "bev"):
            scores = np.load(first)[view]
            np.testing.assert_allclose(scores, np.load(second)[view], atol=2e-3)  # float16


def test_an_interrupted_run_goes_on_with_another_batch_but_not_with_other_labels(
    world: Path, tmp_path: Path
) -> None:
    arguments = ("predict", world / "data", "--weights", world / "w.safetensors", "--out", tmp_path)
    assert run_cli(*arguments) == (0, "")
    names = files(tmp_path)

    segmenter = amvnet.load(world / "w.safetensors")
    weights = segmenter.weights
    settings = {
        "weights": {part: weights.digest(part) for part in weights.parts},
        "method": "amvnet",
        "precision": "float32",
        "tau": segmenter.engine.tau,
        "sensor": repr(Sensor()),
        "layout": repr(AS_FOUND.layout),
        "scores": False,
        "uncertain": False,
        "format": "label",
    }
    with Journal(tmp_path, settings):
        pass

    for option, value in (("precision", "bfloat16"), ("tau", 0.1)):
        refused((*arguments, "--resume", f"--{option}", value), option)
    assert run_cli(*arguments, "--resume", "--batch", 2) == (0, "")
    assert files(tmp_path) == names


def test_batches_of_scans_go_through_the_networks_together_and_few_are_in_memory(
    tmp_path: Path,
) -> None:
    weights = fresh_weights()
    engine = ScriptedEngine(weights, sure_of(weights.taxonomy.size))
    counter = Counter()
    scans = counted_scans(23, counter)
    pipeline = Pipeline(
        scans, segment_by(Segmenter(weights, engine)), OutputOptions(tmp_path), batch=4
    )
    results = list(pipeline.stream(scans, pipeline.write_or_explain))
    done = [result.scan for result in results if isinstance(result, Entry)]
    assert done == [f"{seed}.npz" for seed in range(23)]
    assert [batch.count for batch in engine.batches] == [4, 4, 4, 4, 4, 3]
    assert counter.most <= 2 * 4 + READ_AHEAD + 2
    assert not counter.in_memory


STAND_INS = {
    "cuda": "cpu",
    "semantickitti:/data/kitti/dataset": "data",
    "runs/kitti": "w.safetensors",
}


def test_the_commands_of_the_page_run(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(world)
    stand_ins = {**STAND_INS, "predictions": str(tmp_path)}
    predict, evaluate, *_ = DocsPage("docs/gpu.md").commands
    assert predict[:2] == ["amvnet", "predict"]
    assert evaluate[:2] == ["amvnet", "evaluate"]
    for words in (predict, evaluate):
        assert run_cli(*[stand_ins.get(word, word) for word in words[1:]]) == (0, "")


@pytest.mark.full
def test_the_benchmark_of_the_page_runs(
    world: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Run it on a CPU, in its smallest size."""
    monkeypatch.chdir(world)
    *_, benchmark = DocsPage("docs/gpu.md").commands
    make_simulation_quick(monkeypatch)
    script = Path(__file__).parents[2] / benchmark[1]
    monkeypatch.setattr(sys, "argv", [*benchmark[1:], "--scan", "scans/000000.bin"])
    runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    for title in ("points to labels", "stages", "predict from disk", "training and validation of"):
        assert title in printed
    assert printed.count("|---") > 10


@pytest.mark.gpu
@no_gpu
@pytest.mark.parametrize("precision", ["float32", "bfloat16", "float16"])
def test_a_gpu_gives_the_labels_of_a_cpu(simulated_scan: Scan, precision: str) -> None:
    expected = amvnet.load("sim-hdl64e")(simulated_scan)
    segmenter = amvnet.load("sim-hdl64e", "cuda", precision=precision)  # type: ignore[arg-type]
    least = 0.999 if precision == "float32" else 0.98

    for segmentation in segmenter.many([simulated_scan, simulated_scan]):
        assert (segmentation.labels == expected.labels).mean() > least


@pytest.mark.gpu
@no_gpu
def test_graphs_on_a_gpu_are_captured_and_give_the_scores_without_them(
    simulated_scan: Scan,
) -> None:
    """A warning says that the check has turned the graphs off: here it is an error."""
    other = Scan(simulated_scan.points[::2])
    expected_segmenter = amvnet.load("sim-hdl64e", "cuda", graphs=False)
    segmenter = amvnet.load("sim-hdl64e", "cuda")
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for scans in ([simulated_scan], [other], [simulated_scan, other], [other]):
            expected = expected_segmenter.many(scans)
            for actual, right in zip(segmenter.many(scans), expected, strict=True):
                assert (actual.labels == right.labels).mean() > 0.99
