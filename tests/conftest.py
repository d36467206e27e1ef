"""Fixtures that several test files share."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from amvnet.cli.commands import evaluate
from amvnet.engines import compute
from amvnet.engines.export import onnx as onnx_export
from amvnet.scan import Scan

from fixtures.exports import converting_once
from fixtures.submissions import MAKERS, Case
from fixtures.world import make_world, state_of

LASERS = 16

# How long an example takes decides nothing.
settings.register_profile(
    "any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("any machine")


def _random_scan(count: int, seed: int = 0) -> Scan:
    """Return points all around the sensor, some outside any field of view, labels and rings."""
    rng = np.random.default_rng(seed)
    xyz = rng.normal(0, (20, 20, 3), (count, 3))
    points = np.column_stack([xyz, rng.random(count)]).astype(np.float32)
    return Scan(points, rng.integers(0, 20, count).astype(np.uint8), rng.integers(0, LASERS, count))


@pytest.fixture(scope="session", autouse=True)
def on_cpu() -> Iterator[None]:
    """Let `auto` be the CPU even if there is a GPU, because a GPU rounds sums differently."""
    choose = compute.choose_device

    def choose_cpu(name: str, engine: str = "torch") -> str:
        return choose("cpu" if name == "auto" else name, engine)

    with pytest.MonkeyPatch.context() as patch:
        for module in (compute, evaluate):
            patch.setattr(module, "choose_device", choose_cpu)
        yield


@pytest.fixture(autouse=True)
def signal_handlers_are_kept() -> Iterator[None]:
    """Check that a test leaves the handlers of the signals that end a process as they were.

    Processes that later tests fork inherit them: a pool of processes, for example, waits forever
    for a worker whose handler of SIGTERM only raises an exception.
    """
    ending = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(number) for number in ending]
    yield
    assert [signal.getsignal(number) for number in ending] == before


@pytest.fixture
def hears_sigint() -> Iterator[None]:
    """Let this process and its children hear SIGINT, which those of a shell's background ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the folder of `make_world`, which no test may change."""
    root = make_world(tmp_path_factory.mktemp("world"))
    before = state_of(root)
    yield root
    assert state_of(root) == before


@pytest.fixture
def random_scan() -> Callable[..., Scan]:
    return _random_scan


@pytest.fixture(scope="module")
def graphs_converted_once(
    tmp_path_factory: pytest.TempPathFactory, worker_id: str
) -> Iterator[None]:
    """Convert a graph to ONNX once in all processes that run tests, and copy the file later."""
    folder = tmp_path_factory.getbasetemp()
    if worker_id != "master":
        folder = folder.parent  # all processes share it
    with pytest.MonkeyPatch.context() as patch:
        convert = converting_once(onnx_export._convert, folder / "graphs")
        patch.setattr(onnx_export, "_convert", convert)
        yield


@pytest.fixture(scope="session")
def cases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Case]:
    """Return submissions to both benchmarks, which no test may change."""
    return {name: make(tmp_path_factory.mktemp(name)) for name, make in MAKERS.items()}


@pytest.fixture(params=MAKERS)
def case(request: pytest.FixtureRequest, cases: dict[str, Case]) -> Case:
    return cases[request.param]
