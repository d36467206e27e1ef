"""CUDA graphs of the networks, with a stand-in for CUDA, and what can be captured at all."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensorMode
from torch.func import functional_call
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from amvnet.inference import segmenter as segmenter_module
from amvnet.inference.segmenter import Segmenter
from amvnet.models import upsampled_conv
from amvnet.models.amvnet import AMVNet
from amvnet.models.graphs import MOST_SHAPES, WARM_UP, Captured
from amvnet.models.layers import freeze
from amvnet.models.polar_net import PolarNet
from amvnet.models.precision import InPrecision

from fixtures.networks import POLAR_NET, K, build_range
from fixtures.worlds import fresh_weights


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
        slices = index[1:] if index[0] is Ellipsis else index
        for axis, part in enumerate(slices, start=first):
            if part is None:
                x = x.unsqueeze(axis)
                continue
            start, stop, step = part.indices(x.shape[axis])
            x = torch.ops.aten.slice.Tensor(x, axis, start, stop, step)
        return x


@each_network
def test_a_network_copies_nothing_from_the_host_and_no_shape_depends_on_data(
    build: Build, shape: tuple[int, ...]
) -> None:
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
    taps = upsampled_conv._taps

    def counted(scale: int, like: Tensor) -> Tensor:
        nonlocal made
        made += 1
        return taps(scale, like)

    monkeypatch.setattr(upsampled_conv, "_taps", counted)
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
    network = Captured(counted)
    with torch.inference_mode():
        inputs = [torch.randn(count, *shape) for count in (1, 2, 1, 2, 1)]
        outputs = [network(x) for x in inputs]
        expected = [net(x) for x in inputs]

    # Later replays leave earlier outputs as they were.
    for output, right in zip(outputs, expected, strict=True):
        assert torch.equal(output, right)
    assert len(cuda) == 2
    assert counted.count == 2 * (WARM_UP + 1)


def test_a_network_that_cannot_be_captured_is_computed_as_it_is_with_one_warning(
    cuda: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(graph: Recording, **options: object) -> object:
        raise RuntimeError("operation not permitted when stream is capturing\nmore")

    monkeypatch.setattr(torch.cuda, "graph", fail)
    net = nn.Linear(3, 2)
    network = Captured(net)
    x = torch.randn(4, 3)
    with torch.inference_mode():
        with pytest.warns(RuntimeWarning, match=r"\(operation not permitted .* capturing\)"):
            first = network(x)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            second = network(x)
            other_shape = network(x[:2])
        assert torch.equal(first, net(x))
        assert torch.equal(second, net(x))
        assert torch.equal(other_shape, net(x[:2]))


def test_gradients_and_further_shapes_are_not_captured(cuda: list[Recording]) -> None:
    net = nn.Linear(3, 2)
    network = Captured(net)
    network(torch.randn(4, 3)).sum().backward()
    assert net.weight.grad is not None
    assert not cuda

    with torch.inference_mode():
        for rows in range(1, MOST_SHAPES + 4):
            x = torch.randn(rows, 3)
            assert torch.equal(network(x), net(x))
    assert len(cuda) == MOST_SHAPES


def test_another_precision_of_products_is_captured_apart(cuda: list[Recording]) -> None:
    """What a graph computes is settled when it is captured."""
    network = Captured(nn.Linear(3, 2))
    before = torch.get_float32_matmul_precision()
    try:
        with torch.inference_mode():
            for precision in ("highest", "high", "highest"):
                torch.set_float32_matmul_precision(precision)
                network(torch.randn(4, 3))
    finally:
        torch.set_float32_matmul_precision(before)
    assert len(cuda) == 2


def set_up(graphs_wanted: bool, monkeypatch: pytest.MonkeyPatch) -> AMVNet:
    """Return a model with its networks set up as for a GPU."""
    model = Segmenter(fresh_weights()).model
    monkeypatch.setattr(segmenter_module, "TwoStreams", lambda device: None)
    segmenter_module._set_up_networks(model, "cuda", "bfloat16", graphs_wanted)
    return model


def test_a_segmenter_on_a_gpu_captures_both_networks_unless_told_not_to(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model = set_up(True, monkeypatch)
    assert isinstance(model.range_net, InPrecision)
    assert isinstance(model.polar_net, InPrecision)
    assert isinstance(model.range_net.net, Captured)
    assert isinstance(model.polar_net.net.run_unet, Captured)

    model = set_up(False, monkeypatch)
    assert isinstance(model.range_net, InPrecision)
    assert isinstance(model.polar_net, InPrecision)
    assert not isinstance(model.range_net.net, Captured)
    assert model.polar_net.net.run_unet is None
