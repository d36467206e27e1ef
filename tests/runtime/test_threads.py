"""What the threads of a process do on a busy machine, and after a fork."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import amvnet
from amvnet.models import point_head, polar_net
from amvnet.runtime.threads import WAITING, run_parts

from fixtures.processes import PATIENCE
from fixtures.tiny import fresh_weights, street

# Segments with two threads, and again in a forked pool.
FORKING = """
import multiprocessing, sys
import numpy as np, torch
import amvnet

torch.set_num_threads(2)
points = np.random.default_rng(0).normal(0, 10, (2000, 4)).astype(np.float32)
points[:, 3] = 0.3
segmenter = amvnet.load(sys.argv[1])
labels = segmenter(points).labels

def same(_):
    return bool((segmenter(points).labels == labels).all())

if __name__ == "__main__":
    with multiprocessing.get_context("fork").Pool(2) as pool:
        assert pool.map(same, range(4)) == [True] * 4
"""

# Prints what the command line leaves in the environment before torch is imported.
PRINTING = """
import os, sys
import amvnet.cli.main as cli

cli.run = lambda command, arguments: print(
    "torch" in sys.modules, *(os.environ.get(name) for name in sys.argv[1:])
)
cli.main(["info"])
"""


def run_python(code: str, *arguments: str, environment: Mapping[str, str] | None = None) -> str:
    """Run code in a process whose environment says nothing else about waiting threads."""
    inherited = {key: value for key, value in os.environ.items() if key not in WAITING}
    process = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env={**inherited, **(environment or {})},
    )
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


@pytest.mark.full
@pytest.mark.skipif(
    "fork" not in multiprocessing.get_all_start_methods(), reason="this system cannot fork"
)
def test_a_forked_pool_segments_as_its_parent(world: Path) -> None:
    run_python(FORKING, str(world / "w.safetensors"))


def test_the_command_line_lets_threads_sleep_before_it_imports_torch() -> None:
    assert run_python(PRINTING, *WAITING) == "False passive None 0"


@pytest.mark.parametrize(("name", "value"), [("OMP_WAIT_POLICY", "active"), ("KMP_BLOCKTIME", "7")])
def test_what_the_user_has_set_stays(name: str, value: str) -> None:
    expected = [value if variable == name else "None" for variable in WAITING]
    assert run_python(PRINTING, *WAITING, environment={name: value}).split() == ["False", *expected]


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(("policy", "threads"), [("passive", 2), ("active", 1)])
def test_parts_have_threads_of_their_own_if_threads_sleep(
    policy: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", policy)
    both_run = threading.Barrier(threads, timeout=PATIENCE)

    def run(part: int) -> tuple[int, int, int, Tensor]:
        both_run.wait()
        product = torch.ones(1, 2) @ torch.ones(2, 1)
        return part, threading.get_ident(), torch.get_num_threads(), product

    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        results = run_parts(run, range(4))
    assert [part for part, *_ in results] == [0, 1, 2, 3]
    assert len({thread for _, thread, *_ in results}) == threads
    assert {count for *_, count, _ in results} == {2 // threads}
    assert all(product.is_inference() for *_, product in results)
    assert {product.dtype for *_, product in results} == {torch.bfloat16}
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_fewer_parts_than_threads_share_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "passive")
    torch.set_num_threads(4)

    with torch.no_grad():
        counts = run_parts(lambda part: torch.get_num_threads(), range(2))
    assert counts == [2, 2]
    assert torch.get_num_threads() == 4


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(("policy", "at_once"), [("passive", 2), ("active", 1)])
def test_the_networks_run_side_by_side_if_threads_sleep(
    policy: str, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", policy)
    # Tiny networks could follow each other in one thread.
    all_run = threading.Barrier(at_once, timeout=PATIENCE)
    threads = {}

    def note(name: str) -> AbstractContextManager[None]:
        if name in ("RV", "BEV"):
            all_run.wait()
            threads[name] = threading.get_ident()
        return nullcontext()

    segmenter = amvnet.load(fresh_weights())
    segmenter.model.watch = note
    segmenter(street(0)[0])
    assert len(set(threads.values())) == at_once


@pytest.mark.usefixtures("two_threads")
def test_a_part_that_fails_ends_the_computation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_WAIT_POLICY", "passive")

    def run(part: int) -> float:
        return 1 / part

    with torch.no_grad(), pytest.raises(ZeroDivisionError):
        run_parts(run, [2, 1, 0, 3])
    assert torch.get_num_threads() == 2


@pytest.mark.usefixtures("two_threads")
def test_a_scan_is_segmented_alike_however_threads_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """With many small parts; the number of threads may change the last bits."""
    monkeypatch.setattr(point_head, "PART_ON_CPU", 16)
    monkeypatch.setattr(polar_net, "PART_ON_CPU", 16)
    points, _ = street(0)
    segmenter = amvnet.load(fresh_weights())

    results = []
    for policy in ("active", "passive"):
        monkeypatch.setenv("OMP_WAIT_POLICY", policy)
        results.append(segmenter(points))
    assert results[0].uncertain.sum() > 100
    np.testing.assert_allclose(results[0].scores, results[1].scores, atol=1e-5)
