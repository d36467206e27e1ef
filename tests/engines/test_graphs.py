"""CUDA graphs of the networks, with a stand-in for CUDA, and what can be captured at all."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensorMode
from torch.func import functional_call
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from amvnet.engines import torch as torch_engine
from amvnet.engines.torch import (
    MAX_SHAPES,
    WARM_UP_RUNS,
    Captured,
    GraphCheck,
    InPrecision,
    TorchEngine,
)
from amvnet.models import layers
from amvnet.models.amvnet import Scores, one_after_the_other
from amvnet.models.layers import freeze
from amvnet.models.polar_net import PolarNet
from amvnet.models.views.points import PointBatch
from amvnet.scan import Scan

from fixtures.examples import first_of
from fixtures.networks import POLAR_NET, K, build_range
from fixtures.tiny import fresh_weights, street

WEIGHTS = fresh_weights()


class Unet(nn.Module):
    """The part of PolarNet that is captured."""

    def __init__(self) -> None:
        super().__init__()
        self.net = PolarNet(POLAR_NET, 3, K)

    def forward(self, x: Tensor) -> Tensor:
        return self.net.unet(x)


def range_net() -> nn.Module:
    return build_range(gru=True)


Build = Callable[[], nn.Module]
NETWORKS: list[tuple[Build, tuple[int, ...]]] = [(range_net, (6, 8, 32)), (Unet, (5, 8, 16))]
each_network = pytest.mark.parametrize(("build", "shape"), NETWORKS, ids=["RV", "BEV"])


# ---- what can be captured


class Placement(TorchDispatchMode):
    """Notes the operations in which a tensor of the processor's memory takes part."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0
        self.on_host: list[str] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        self.operations += 1
        for value in tree_leaves((args, kwargs, result)):
            if isinstance(value, Tensor) and value.device.type == "cpu":
                self.on_host.append(str(func))
        return result


class SlicesWithoutCuda(TorchFunctionMode):
    """Slices fake tensors of a GPU where torch was built without CUDA, which indexing asks for."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        if func is not Tensor.__getitem__ or args[0].device.type == "cpu":
            return func(*args, **(kwargs or {}))
        x, index = args
        index = index if isinstance(index, tuple) else (index,)
        first = x.ndim - len(index) + 1 if index[0] is Ellipsis else 0
        for axis, part in enumerate(index[1:] if index[0] is Ellipsis else index, start=first):
            if part is None:
                x = x.unsqueeze(axis)
                continue
            start, stop, step = part.indices(x.shape[axis])
            x = torch.ops.aten.slice.Tensor(x, axis, start, stop, step)
        return x


@each_network
@pytest.mark.filterwarnings("ignore:PyTorch was compiled without cuDNN")  # a build for CPUs
@pytest.mark.filterwarnings("ignore:Accessing the data pointer of FakeTensor")  # torch < 2.9
def test_networks_copy_nothing_and_have_fixed_shapes(build: Build, shape: tuple[int, ...]) -> None:
    net = build().eval()
    freeze(net)
    # A shape that depends on data raises an error.
    with FakeTensorMode(), SlicesWithoutCuda(), torch.inference_mode():
        state = {}
        for name, tensor in [*net.named_parameters(), *net.named_buffers()]:
            state[name] = torch.empty(tensor.shape, dtype=tensor.dtype, device="cuda")
        x = torch.empty(2, *shape, device="cuda")
        functional_call(net, state, (x,))  # makes what depends on the weights alone
        with Placement() as placement:
            functional_call(net, state, (x,))

    assert placement.operations > 20
    assert placement.on_host == []


@each_network
def test_kernels_that_depend_on_the_weights_alone_are_made_once(
    build: Build, shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    net = build().eval()
    freeze(net)
    x = torch.randn(1, *shape)
    with_gradients = net(x)  # makes them each time

    made = 0
    taps = layers._taps

    def counted(scale: int, like: Tensor) -> Tensor:
        nonlocal made
        made += 1
        return taps(scale, like)

    monkeypatch.setattr(layers, "_taps", counted)
    with torch.inference_mode():
        first = net(x)
        made_first = made
        second = net(x)
    torch.testing.assert_close(first, with_gradients)
    assert torch.equal(second, first)
    assert made == made_first > 0


def test_a_network_that_is_not_frozen_follows_its_weights() -> None:
    net = build_range(gru=False).eval()
    x = torch.randn(1, 6, 8, 32)
    with torch.no_grad():
        before = net(x)
        for parameter in net.parameters():
            parameter.mul_(1.5)
        after = net(x)
    with torch.enable_grad():
        expected = net(x)
    torch.testing.assert_close(after, expected)
    assert not torch.allclose(after, before)


# ---- capturing, with a stand-in for CUDA


class Recording(TorchDispatchMode):
    """A stand-in for a CUDA graph: repeats the recorded operations on the same tensors."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        self.calls.append((func, args, kwargs or {}, result))
        return result

    def replay(self) -> None:
        for func, args, kwargs, result in self.calls:
            again = func(*args, **kwargs)
            for old, new in zip(tree_leaves(result), tree_leaves(again), strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class StandInStream:
    def __init__(self, device: object = None) -> None:
        pass

    def wait_stream(self, other: StandInStream) -> None:
        pass


@pytest.fixture
def cuda(monkeypatch: pytest.MonkeyPatch) -> list[Recording]:
    """Put stand-ins into `torch.cuda`; return the graphs that are captured."""
    captured: list[Recording] = []

    @contextlib.contextmanager
    def capture(graph: Recording, **options: object) -> Iterator[None]:
        captured.append(graph)
        with graph:
            yield

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Recording)
    monkeypatch.setattr(torch.cuda, "graph", capture)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: (0, 1))
    monkeypatch.setattr(torch.cuda, "Stream", StandInStream)
    monkeypatch.setattr(torch.cuda, "current_stream", StandInStream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: contextlib.nullcontext())
    return captured


class Counted(nn.Module):
    """Counts how often a network is computed operation by operation."""

    def __init__(self, net: nn.Module) -> None:
        super().__init__()
        self.net = net
        self.count = 0

    def forward(self, x: Tensor) -> Tensor:
        self.count += 1
        return self.net(x)


@each_network
def test_a_network_is_captured_once_for_each_shape_and_replayed(
    build: Build, shape: tuple[int, ...], cuda: list[Recording]
) -> None:
    net = build().eval()
    counted = Counted(net)
    network = Captured(counted, GraphCheck())
    with torch.inference_mode():
        inputs = [torch.randn(count, *shape) for count in (1, 2, 1, 2, 1)]
        outputs = [network(x) for x in inputs]
        expected = [net(x) for x in inputs]

    # Later replays leave earlier outputs as they were.
    for output, right in zip(outputs, expected, strict=True):
        assert torch.equal(output, right)
    assert len(cuda) == 2
    assert counted.count == 2 * (WARM_UP_RUNS + 1)


def test_gradients_and_further_shapes_are_not_captured(cuda: list[Recording]) -> None:
    net = nn.Linear(3, 2)
    network = Captured(net, GraphCheck())
    network(torch.randn(4, 3)).sum().backward()
    assert net.weight.grad is not None
    assert not cuda

    with torch.inference_mode():
        for rows in range(1, MAX_SHAPES + 4):
            x = torch.randn(rows, 3)
            assert torch.equal(network(x), net(x))
    assert len(cuda) == MAX_SHAPES


def test_another_precision_of_products_is_captured_apart(cuda: list[Recording]) -> None:
    """What a graph computes is settled when it is captured."""
    network = Captured(nn.Linear(3, 2), GraphCheck())
    before = torch.get_float32_matmul_precision()
    try:
        with torch.inference_mode():
            for precision in ("highest", "high", "highest"):
                torch.set_float32_matmul_precision(precision)
                network(torch.randn(4, 3))
    finally:
        torch.set_float32_matmul_precision(before)
    assert len(cuda) == 2


# ---- the check at the start


@pytest.fixture
def engine_on_gpu(
    cuda: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., TorchEngine]:
    """Return a function that makes an engine as for a GPU, which computes on the CPU."""

    def make(graphs: bool = True) -> TorchEngine:
        with monkeypatch.context() as patch:
            patch.setattr(torch_engine, "is_gpu", lambda device: True)
            patch.setattr(torch_engine, "TwoStreams", lambda device: one_after_the_other)
            return TorchEngine(WEIGHTS, graphs=graphs)

    return make


def batch_of(*seeds: int) -> PointBatch:
    return PointBatch.of([Scan(street(seed, 300)[0]) for seed in seeds])


def check_scores(engine: TorchEngine, batch: PointBatch) -> None:
    torch.testing.assert_close(engine.score(batch).merged, TorchEngine(WEIGHTS).score(batch).merged)


def test_an_engine_on_a_gpu_captures_both_networks_unless_told_not_to(
    cuda: list[Recording], engine_on_gpu: Callable[..., TorchEngine]
) -> None:
    check_scores(engine_on_gpu(graphs=False), batch_of(0))
    assert not cuda

    engine = engine_on_gpu()
    assert isinstance(engine.model.range_net, InPrecision)
    assert isinstance(engine.model.polar_net, InPrecision)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for seed in range(3):
            check_scores(engine, batch_of(seed))
    assert len(cuda) == 2


def test_the_first_batch_of_each_size_is_also_scored_without_graphs(
    cuda: list[Recording], engine_on_gpu: Callable[..., TorchEngine]
) -> None:
    engine = engine_on_gpu()
    runs: list[bool] = []

    def watch(step: str) -> contextlib.nullcontext[None]:
        runs.append(step == "RV")
        return contextlib.nullcontext()

    engine.model.watch = watch
    for seeds, expected in (((0,), 2), ((1,), 1), ((0, 1), 2), ((1, 2), 1), ((3,), 1)):
        runs.clear()
        engine.score(batch_of(*seeds))
        assert sum(runs) == expected, seeds
    assert len(cuda) == 4  # two networks, two sizes


def wrong_output(graph: Recording) -> None:
    """Replay a graph, and change what it has computed."""
    Recording.replay(graph)
    _, _, _, result = graph.calls[-1]
    result.copy_(result.flip(1))


def nothing(graph: Recording) -> None:
    """Leave the outputs as the capture had them: the input is not taken."""


def not_a_number(graph: Recording) -> None:
    _, _, _, result = graph.calls[-1]
    result.fill_(torch.nan)


@pytest.mark.parametrize("replay", first_of([wrong_output, nothing, not_a_number]))
def test_graphs_that_give_other_scores_are_turned_off_with_one_warning(
    replay: Callable[[Recording], None],
    cuda: list[Recording],
    engine_on_gpu: Callable[..., TorchEngine],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Broken(Recording):
        def replay(self) -> None:
            replay(self)

    monkeypatch.setattr(torch.cuda, "CUDAGraph", Broken)
    engine = engine_on_gpu()
    with pytest.warns(RuntimeWarning, match="differ .* graphs=False") as caught:
        check_scores(engine, batch_of(0))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_scores(engine, batch_of(1))
        check_scores(engine, batch_of(0, 1))
    assert len(cuda) == 2


def test_networks_that_cannot_be_captured_run_without_graphs_with_one_warning(
    engine_on_gpu: Callable[..., TorchEngine], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(graph: Recording, **options: object) -> object:
        raise RuntimeError("operation not permitted when stream is capturing\nmore")

    engine = engine_on_gpu()
    monkeypatch.setattr(torch.cuda, "graph", fail)
    with pytest.warns(RuntimeWarning, match=r"\(operation not .* capturing\)") as caught:
        check_scores(engine, batch_of(0))
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_scores(engine, batch_of(0, 1))


def test_scores_that_differ_by_rounding_do_not_turn_graphs_off() -> None:
    f = torch.rand(5000, K, generator=torch.Generator().manual_seed(0)).softmax(dim=1)
    scores = Scores(f, f[:, 0] > 2, f, f)
    rounded = f.bfloat16().float()
    for few, is_passed in ((0, True), (4, True), (6, False)):
        other = rounded.clone()
        other[:few] = 1 - other[:few]
        answers = iter([replace(scores, rv=other), scores])
        check = GraphCheck()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check.score(lambda batch, answers=answers: next(answers), batch_of(0))  # type: ignore[misc]
        assert check.is_passed == is_passed
