"""Every command reads ahead and computes on several scans at a time, with the same results."""

from __future__ import annotations

import shlex
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import amvnet
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.errors import InputError
from amvnet.evaluation.analysis import analyze
from amvnet.evaluation.label_errors import rank
from amvnet.evaluation.scoring import evaluate, label_by_weights
from amvnet.inference.listing import find_inputs
from amvnet.inference.scan_stream import stream_scans
from amvnet.inference.segmenter import Segmenter
from amvnet.runtime.memory import available_memory
from amvnet.viewing.shown_scans import show_scans

from fixtures.commands import fails, refused, run_cli
from fixtures.marks import with_full
from fixtures.processes import PATIENCE
from fixtures.tiny import fresh_weights


@pytest.mark.parametrize("at_once", [1, 3])
def test_results_come_in_order(at_once: int) -> None:
    results = stream_scans(range(20), lambda n: n + 1, lambda n, scan: (n, scan), at_once)
    assert list(results) == [(n, n + 1) for n in range(20)]


def test_an_error_comes_in_its_turn() -> None:
    def load(n: int) -> int:
        if n == 3:
            raise InputError("broken")
        return n

    results = stream_scans(range(6), load, lambda n, scan: n, at_once=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    fails(lambda: next(results), "broken")


@pytest.mark.parametrize(
    ("threads", "at_once", "scans", "each"),
    [(2, 5, 10, 1), (8, 8, 16, 1), (8, 3, 9, 2), (8, 8, 2, 4), (8, 8, 1, 8), (1, 4, 8, 1)],
)
def test_scans_at_once_share_the_threads(threads: int, at_once: int, scans: int, each: int) -> None:
    """With many scans each has one thread; also if there are more workers than cores."""
    before = torch.get_num_threads()
    together = min(at_once, scans)
    barrier = threading.Barrier(together)

    def compute(n: int, scan: str) -> int:
        if n < together:
            barrier.wait(PATIENCE)  # breaks unless so many are computed at the same time
        return torch.get_num_threads()

    torch.set_num_threads(threads)
    try:
        shares = list(stream_scans(range(scans), str, compute, at_once))
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert set(shares) == {each}


GIBIBYTE = 2**30


@pytest.mark.parametrize(
    ("threads", "gibibytes", "expected"), [(64, 512, 64), (64, 10.5, 10), (2, 64, 2), (16, 0.2, 1)]
)
def test_a_scan_for_each_core_is_computed_if_the_memory_suffices(
    threads: int, gibibytes: float, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    available = int(gibibytes * GIBIBYTE)
    monkeypatch.setattr("amvnet.engines.base.available_memory", lambda: available)
    assert amvnet.load(fresh_weights()).at_once == expected


def test_the_available_memory_is_that_of_the_machine_or_of_the_control_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amvnet.runtime.memory.MEMINFO", tmp_path / "meminfo")
    monkeypatch.setattr("amvnet.runtime.memory.CONTROL_GROUP", tmp_path)
    assert available_memory() > 0  # neither file is there

    (tmp_path / "meminfo").write_text("MemTotal: 9000000 kB\nMemAvailable:    4194304 kB\n")
    assert available_memory() == 4 * GIBIBYTE
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "memory.current").write_text("123\n")
    assert available_memory() == 4 * GIBIBYTE
    (tmp_path / "memory.max").write_text(f"{3 * GIBIBYTE}\n")
    (tmp_path / "memory.current").write_text(f"{GIBIBYTE}\n")
    assert available_memory() == 2 * GIBIBYTE


def test_torch_has_its_threads_back_after_the_stream() -> None:
    threads = torch.get_num_threads()
    list(stream_scans(range(3), str, lambda n, scan: n, at_once=2))
    assert torch.get_num_threads() == threads


def _evaluated(dataset: Dataset, segmenter: Segmenter) -> Any:
    return evaluate(dataset, dataset.records(["08"]), label_by_weights(segmenter)).report("x")


def _analyzed(dataset: Dataset, segmenter: Segmenter) -> Any:
    analysis = analyze(dataset, dataset.records(["08"]), segmenter)
    return [analysis.points.tolist(), analysis.ensemble.tolist(), analysis.head.tolist()]


def _ranked(dataset: Dataset, segmenter: Segmenter) -> Any:
    return rank(dataset, dataset.records(["08"]), segmenter).tolist()


def _viewed(dataset: Dataset, segmenter: Segmenter) -> Any:
    scans, _ = find_inputs([dataset.spec]).scans()
    return [[each.name, each.labels["amvnet"].tolist()] for each in show_scans(scans, segmenter)]


@pytest.mark.parametrize(
    "command", with_full([_evaluated, _analyzed, _ranked, _viewed], [_analyzed])
)
def test_any_number_of_scans_at_a_time_gives_the_same_result(
    command: Callable[[Dataset, Segmenter], Any], world: Path
) -> None:
    results = []
    for at_once in (1, 3):
        segmenter = amvnet.load(world / "w.safetensors")
        segmenter.at_once = at_once
        results.append(command(open_dataset(str(world / "data")), segmenter))
    np.testing.assert_equal(*results)


@pytest.mark.parametrize("command", with_full(["evaluate", "analyze", "rank", "view"], ["analyze"]))
def test_every_command_has_predicts_options(command: str, world: Path, tmp_path: Path) -> None:
    words = [command, str(world / "data"), "--weights", str(world / "w.safetensors")]
    words += {
        "evaluate": [],
        "analyze": ["--out", str(tmp_path)],
        "rank": ["--out", str(tmp_path / "rank.csv")],
        "view": ["--html", str(tmp_path / "page.html")],
    }[command]
    words += ["--engine", "torch", "--precision", "bfloat16"]
    refused(shlex.join([*words, "--at-once", "0"]), "--at-once")
    assert run_cli(*words, "--at-once", "2") == (0, "")
