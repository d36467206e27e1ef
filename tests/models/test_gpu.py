"""What a GPU does otherwise, on tensors of the CPU where there is none: neighbours by blocks, streams, precision."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn

from amvnet import Scan, Segmenter, simulate
from amvnet.data.scan_files import read_scan
from amvnet.inference.pipeline import AHEAD, Task, stream
from amvnet.models import neighbours_gpu as block_search
from amvnet.models.amvnet import merge
from amvnet.models.neighbours import nearest_others
from amvnet.models.neighbours_gpu import nearest_others_by_blocks, split_into_blocks
from amvnet.models.precision import InPrecision
from amvnet.models.streams import SideBySide
from amvnet.models.views.points import PointBatch
from amvnet.weights.file import save

from fixtures.networks import whole_model
from fixtures.worlds import commands_of, fails, files, fresh_weights, make_streets, run_cli, street

N = 15
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")),
]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """A simulated scan of an HDL-64E."""
    folder = tmp_path_factory.mktemp("streets")
    simulate(folder, scans=1, seed=3)
    return read_scan(folder / "sequences/00/velodyne/000000.bin")


def clouds() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    random = rng.normal(0, (20, 20, 2), (5000, 3))
    clusters = rng.normal(0, 100, (20, 3))[rng.integers(0, 20, 5000)] + rng.normal(
        0, 0.01, (5000, 3)
    )
    line = np.zeros((4000, 3))
    line[:, 1] = rng.random(4000) * 50
    sphere = random / np.linalg.norm(random, axis=1, keepdims=True)
    return {
        "random": random,
        "clusters": clusters,
        "on a line": line,
        "each thrice": np.repeat(random[:1500], 3, axis=0),
        "each eighty times": np.repeat(random[:40], 80, axis=0),
        "in one place": np.ones((3000, 3)),
        "on a lattice": np.stack(np.meshgrid(*[np.arange(16.0)] * 3), axis=-1).reshape(-1, 3),
        "10 km apart": np.concatenate(
            [random[:2000], random[2000:4000] + np.array([9900, -9900, 0]), [[-9999, 9999, 9999]]]
        ),
        "nearly in one place": 9000
        + rng.normal(0, 0.004, (3000, 3)),  # where float32 knows a millimetre
        "hardly apart": rng.normal(0, 1e-22, (3000, 3)),  # whose squares are 0 in float32
        # Nearly as far from the centre, each of them: float32 does not know which are the nearest.
        "on a sphere": np.concatenate([np.zeros((10, 3)), sphere[:300], random[:2000] * 10]),
        "few": random[:40],
    }


def check_nearest(xyz: Tensor, own: Tensor, n: int = N) -> None:
    """The distances are those of the n nearest others by a k-d tree in double precision, and the points different."""
    found = nearest_others_by_blocks(xyz, own, n).cpu().numpy()
    points, mine = xyz.double().cpu().numpy(), own.cpu().numpy()
    distance = np.linalg.norm(points[found] - points[mine][:, None], axis=2)
    others = min(n, len(points) - 1)
    # Of the nearest, itself among them, one has the distance 0: itself, or who stands where it does.
    expected = cKDTree(points).query(points[mine], k=others + 1)[0][:, 1:]
    np.testing.assert_allclose(distance[:, :others], expected, rtol=1e-12, atol=0)
    assert not (found[:, :others] == mine[:, None]).any()
    assert all(len(set(row)) == others for row in found[:, :others].tolist())
    assert (found[:, others:] == found[:, [others - 1]]).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", clouds())
def test_neighbours_by_blocks_are_the_nearest_others(name: str, device: str) -> None:
    xyz = torch.from_numpy(clouds()[name].astype(np.float32)).to(device)
    check_nearest(
        xyz, torch.randperm(len(xyz), generator=torch.Generator().manual_seed(0)).to(device)[:1000]
    )


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("points", [2, 3, 15, 16, 17, 1023, 1024, 1025, 1100, 2048, 2049])
def test_neighbours_by_blocks_of_any_number_of_points(points: int, device: str) -> None:
    xyz = torch.randn(points, 3, generator=torch.Generator().manual_seed(points)).to(device)
    check_nearest(xyz, torch.arange(0, points, max(1, points // 50), device=device))


@pytest.mark.parametrize("n", [1, 40, 500, 2000])
def test_any_number_of_neighbours_by_blocks(n: int) -> None:
    check_nearest(
        torch.randn(1500, 3, generator=torch.Generator().manual_seed(0)),
        torch.arange(0, 1500, 50),
        n,
    )


def test_neighbours_by_blocks_keep_to_the_rules_for_few_points() -> None:
    line = torch.tensor([[0.0, 0, 0], [5, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert nearest_others_by_blocks(line, torch.tensor([0, 1]), 6).tolist() == [
        [2, 3, 1, 1, 1, 1],
        [3, 2, 0, 0, 0, 0],
    ]
    assert nearest_others_by_blocks(torch.ones(1, 3), torch.tensor([0]), 3).tolist() == [[0, 0, 0]]
    assert nearest_others_by_blocks(
        torch.randn(5, 3), torch.zeros(0, dtype=torch.long), 3
    ).shape == (0, 3)


def test_neighbours_by_blocks_equal_the_trees_on_a_scan_and_few_points_are_compared(
    scan: Scan, monkeypatch: pytest.MonkeyPatch
) -> None:
    xyz = torch.from_numpy(scan.points[:, :3].copy())
    own = torch.randperm(len(xyz), generator=torch.Generator().manual_seed(0))[:4000]
    asked: list[int] = []
    search = block_search._among_all
    monkeypatch.setattr(
        block_search,
        "_among_all",
        lambda xyz, own, n: (asked.append(len(own)), search(xyz, own, n))[1],
    )
    found = nearest_others_by_blocks(xyz, own, N)
    equal = np.sort(found.numpy(), axis=1) == np.sort(
        nearest_others(xyz.numpy(), own.numpy(), N), axis=1
    )
    assert equal.all(axis=1).mean() > 0.999  # pykdtree rounds distances to float32
    blocks = split_into_blocks(xyz)
    compared = (
        len(blocks.index)
        + block_search.NEAREST * blocks.index.shape[1]
        + sum(asked) / len(own) * len(xyz)
    )
    assert compared < 0.03 * len(xyz)


def test_parts_of_little_memory_change_no_neighbour(monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = torch.randn(3000, 3)
    whole = nearest_others_by_blocks(xyz, torch.arange(500), N)
    monkeypatch.setattr(block_search, "MEMORY", 1 << 20)
    assert torch.equal(nearest_others_by_blocks(xyz, torch.arange(500), N), whole)


def test_blocks_hold_every_point_once_within_their_boxes() -> None:
    xyz = torch.randn(3001, 3)
    blocks = split_into_blocks(xyz)
    kept = blocks.index < len(xyz)
    assert torch.equal(blocks.index[kept].sort().values, torch.arange(3001))
    assert blocks.index.shape[1] <= block_search.BLOCK
    points = blocks.points.transpose(1, 2)  # (M, B, 3)
    assert torch.equal(points[kept], xyz[blocks.index[kept]])
    assert points[~kept].isinf().all()
    inside = (points >= blocks.low[:, None]) & (points <= blocks.high[:, None])
    assert inside.all(dim=2)[kept].all()


class Streams:
    """Stands in for CUDA's streams: keeps what is done, in order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[str] = []
        self.current = "main"
        monkeypatch.setattr(torch.cuda, "Stream", lambda device: Streams.One(self, "side"))
        monkeypatch.setattr(
            torch.cuda, "current_stream", lambda device: Streams.One(self, self.current)
        )
        monkeypatch.setattr(torch.cuda, "stream", self.on)
        monkeypatch.setattr(
            Tensor, "record_stream", lambda _, stream: self.done.append(f"kept for {stream.name}")
        )

    class One:
        def __init__(self, streams: Streams, name: str) -> None:
            self.streams, self.name = streams, name

        def wait_stream(self, other: Streams.One) -> None:
            self.streams.done.append(f"{self.name} waits for {other.name}")

    @contextlib.contextmanager
    def on(self, stream: Streams.One) -> Iterator[None]:
        self.current, before = stream.name, self.current
        yield
        self.current = before


def test_side_by_side_waits_before_and_after(monkeypatch: pytest.MonkeyPatch) -> None:
    streams = Streams(monkeypatch)
    model, batch = whole_model(), PointBatch.of([Scan(street(0)[0])])
    before = model(batch)
    for name in ("score_range_view", "score_polar_view"):
        score = getattr(model, name)
        monkeypatch.setattr(
            model,
            name,
            lambda b, s=score, n=name: (streams.done.append(f"{n} on {streams.current}"), s(b))[1],
        )
    model.run = SideBySide("cuda")
    after = model(batch)
    assert streams.done == [
        "side waits for main",
        "score_range_view on side",
        "score_polar_view on main",
        "main waits for side",
        "kept for main",
    ]
    assert torch.equal(after.merged, before.merged)


def test_the_merge_of_a_gpu_is_that_of_a_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    f, g = torch.rand(2, 30, 4)
    uncertain = torch.arange(30) % 3 == 1
    h = torch.rand(10, 4)
    expected = [merge(f, g, uncertain, h), merge(f, g, torch.zeros(30, dtype=torch.bool), h[:0])]
    monkeypatch.setattr(Tensor, "is_cpu", False)
    found = [merge(f, g, uncertain, h), merge(f, g, torch.zeros(30, dtype=torch.bool), h[:0])]
    assert all(map(torch.equal, found, expected))


def test_bfloat16_gives_the_labels_of_float32_on_nearly_all_points(scan: Scan) -> None:
    exact, lower = (
        Segmenter("sim-hdl64e")(scan),
        Segmenter("sim-hdl64e", precision="bfloat16")(scan),
    )
    for name in ("scores", "rv", "bev"):
        assert getattr(lower, name).dtype == np.float32
        assert not np.array_equal(getattr(lower, name), getattr(exact, name))
    assert (lower.labels == exact.labels).mean() > 0.98
    assert (lower.uncertain == exact.uncertain).mean() > 0.97


class Seen(nn.Module):
    """Says in which precision it multiplied, and whether TF32 was allowed."""

    def forward(self, x: Tensor) -> Tensor:
        self.kind, self.tf32 = (x @ x).dtype, torch.backends.cudnn.allow_tf32
        return x @ x


@pytest.mark.parametrize(
    ("precision", "kind"), [("float32", torch.float32), ("bfloat16", torch.bfloat16)]
)
def test_a_network_multiplies_in_its_precision_and_scores_in_float32(
    precision: str, kind: torch.dtype
) -> None:
    net = Seen()
    assert InPrecision(net, "cpu", precision)(torch.ones(2, 2)).dtype == torch.float32
    assert net.kind == kind
    assert not torch.is_autocast_enabled("cpu")


@pytest.mark.parametrize(("asked", "allowed"), [("highest", False), ("high", True)])
def test_tf32_is_used_only_where_it_was_asked_for(asked: str, allowed: bool) -> None:
    net, before, convolutions = (
        Seen(),
        torch.get_float32_matmul_precision(),
        torch.backends.cudnn.allow_tf32,
    )
    torch.set_float32_matmul_precision(asked)
    try:
        InPrecision(net, "cpu", "float32")(torch.ones(2, 2))
    finally:
        torch.set_float32_matmul_precision(before)
    assert net.tf32 == allowed
    assert torch.backends.cudnn.allow_tf32 == convolutions


@pytest.mark.parametrize("precision", ["float16", "float64", ""])
def test_a_precision_that_a_cpu_has_not_is_refused(precision: str) -> None:
    fails(lambda: Segmenter(fresh_weights(), precision=precision), "expected", precision)  # type: ignore[arg-type]


def test_a_batch_knows_its_scans_without_looking_at_the_points() -> None:
    scans = [Scan(street(place, 100 + place)[0]) for place in range(3)]
    scans[1].points[7] = np.nan
    batch = PointBatch.of(scans)
    expected = [slice(0, 100), slice(100, 200), slice(200, 302)]
    assert batch.slices() == batch.to("cpu").slices() == expected
    assert PointBatch(batch.points, batch.scan, 3).slices() == expected


def near(a: object, b: object) -> None:
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)


def test_several_scans_at_a_time_are_segmented_as_each_alone() -> None:
    segmenter = Segmenter(fresh_weights())
    scans = [Scan(street(place, 300 + 50 * place)[0], name=str(place)) for place in range(3)]
    scans[1].points[[0, 9]] = np.nan
    for together, alone in zip(segmenter.many(scans), map(segmenter, scans), strict=True):
        assert (together.labels == alone.labels).mean() > 0.995
        assert np.array_equal(together.labels == 0, alone.labels == 0)
        near(together.rv, alone.rv)
        near(together.bev, alone.bev)
        assert np.array_equal(
            together.labels[together.labels > 0], together.scores.argmax(1)[together.labels > 0] + 1
        )


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights, seven lone scans of which two are broken, one has no finite point, and a data set."""
    root = tmp_path_factory.mktemp("world")
    save(fresh_weights(), root / "w.safetensors")
    (root / "scans").mkdir()
    for place in range(7):
        street(place, 400 + 10 * place)[0].tofile(root / f"scans/{place:06d}.bin")
    (root / "scans/000002.bin").write_bytes(b"123")
    np.full((5, 4), np.nan, np.float32).tofile(root / "scans/000004.bin")
    make_streets(root / "data")
    return root


@pytest.mark.parametrize(
    ("inputs", "code", "written"), [(("data", "scans"), 3, 11), (("data",), 0, 6)]
)
def test_predicting_three_at_a_time_writes_what_one_at_a_time_does(
    world: Path, tmp_path: Path, inputs: tuple[str, ...], code: int, written: int
) -> None:
    errors = []
    for batch in (1, 3):
        names = [world / name for name in inputs]
        arguments = (*names, "--weights", world / "w.safetensors", "--scores", "--batch", batch)
        found, error = run_cli("predict", *arguments, "--out", tmp_path / str(batch))
        assert found == code
        errors.append(sorted(error.splitlines()))
    assert errors[0] == errors[1]
    names = files(tmp_path / "1")
    assert names == files(tmp_path / "3")
    labels = [name for name in names if name.endswith(".label")]
    assert len(labels) == written
    for name in labels:
        one, three = (np.fromfile(tmp_path / batch / name, np.uint32) for batch in "13")
        assert (one == three).mean() > 0.99
    for name in names - set(labels):
        one, three = (np.load(tmp_path / batch / name) for batch in "13")
        np.testing.assert_allclose(one["rv"], three["rv"], atol=2e-3)  # float16
        np.testing.assert_allclose(one["bev"], three["bev"], atol=2e-3)


def test_an_interrupted_run_goes_on_with_another_batch_but_not_with_another_precision(
    world: Path, tmp_path: Path
) -> None:
    arguments = ("predict", world / "data", "--weights", world / "w.safetensors", "--out", tmp_path)
    assert run_cli(*arguments) == (0, "")
    whole = {name: (tmp_path / name).read_bytes() for name in files(tmp_path)}
    from amvnet.inference.journal import Journal
    from amvnet.inference.predict import ScanAdapter

    weights = Segmenter(world / "w.safetensors").weights
    settings = {
        "weights": {part: weights.digest(part) for part in weights.parts},
        "method": "amvnet",
        "sensor": repr(ScanAdapter(weights).given),
        "scores": False,
        "uncertain": False,
        "format": "label",
    }
    Journal(tmp_path, settings)
    code, error = run_cli(*arguments, "--resume", "--precision", "bfloat16")
    assert (code, error.count("\n")) == (2, 1)
    assert "precision" in error
    assert run_cli(*arguments, "--resume", "--batch", 2) == (0, "")
    assert files(tmp_path) == set(whole)


@pytest.mark.parametrize("batch", [0, -1])
def test_a_batch_of_no_scans_is_refused(world: Path, tmp_path: Path, batch: int) -> None:
    code, error = run_cli(
        "predict",
        world / "data",
        "--weights",
        world / "w.safetensors",
        "--out",
        tmp_path,
        "--batch",
        batch,
    )
    assert (code, error.count("\n")) == (2, 1)
    assert not files(tmp_path)


def test_batches_of_scans_go_through_the_networks_together_and_few_are_in_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    held, most, sizes = set(), [], []
    segmenter = Segmenter(fresh_weights())
    many = Segmenter.many
    monkeypatch.setattr(
        Segmenter, "many", lambda self, scans: (sizes.append(len(scans)), many(self, scans))[1]
    )

    def task(place: int) -> Task:
        def read() -> Scan:
            held.add(place)
            most.append(len(held))
            return Scan(street(place)[0])

        return Task(str(place), read, segmenter, lambda _: (held.remove(place), Path())[1], Path())

    done = [
        one.name
        for one, fault in stream([task(place) for place in range(23)], False, False, 4)
        if not fault
    ]
    assert done == [str(place) for place in range(23)]
    assert sizes == [4, 4, 4, 4, 4, 3]
    assert max(most) <= 2 * 4 + AHEAD + 2
    assert not held


@pytest.mark.parametrize("verb", ["predict", "evaluate", "bench"])
def test_every_verb_that_segments_takes_a_precision(world: Path, tmp_path: Path, verb: str) -> None:
    inputs = {
        "predict": (world / "data", "--out", tmp_path),
        "evaluate": (world / "data",),
        "bench": ("--runs", 1, "--scan", world / "scans/000000.bin"),
    }
    assert run_cli(
        verb, *inputs[verb], "--weights", world / "w.safetensors", "--precision", "bfloat16"
    ) == (0, "")


def test_the_commands_of_the_page_run(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a CPU; the benchmark, which is for other places, in its smallest size."""
    monkeypatch.chdir(world)
    stand_ins = {
        "cuda": "cpu",
        "semantickitti:/data/kitti/dataset": "data",
        "runs/kitti": "w.safetensors",
        "predictions": str(tmp_path),
    }
    *ours, _, _, smallest = commands_of("docs/gpu.md")
    assert [words[:2] for words in ours] == [["amvnet", "predict"], ["amvnet", "evaluate"]]
    for words in ours:
        assert run_cli(*[stand_ins.get(word, word) for word in words[1:]]) == (0, "")
    script = Path(__file__).parents[2] / smallest[1]
    less = ["--batch", "1,2", "--part", "1", "--scan", "scans/000000.bin"]
    done = subprocess.run(
        [sys.executable, script, *smallest[2:], *less], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert [line.split()[0] for line in done.stdout.splitlines()].count("training") == 2


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@pytest.mark.parametrize("precision", ["float32", "bfloat16", "float16"])
def test_a_gpu_gives_the_labels_of_a_cpu(scan: Scan, precision: str) -> None:
    expected = Segmenter("sim-hdl64e")(scan)
    for found in Segmenter("sim-hdl64e", "cuda", precision=precision).many([scan, scan]):  # type: ignore[arg-type]
        assert (found.labels == expected.labels).mean() > (
            0.999 if precision == "float32" else 0.98
        )
