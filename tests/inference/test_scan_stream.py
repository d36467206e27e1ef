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

from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import open_dataset
from amvnet.errors import InputError
from amvnet.evaluation.analysis import analyze
from amvnet.evaluation.scoring import evaluate, label_by_weights
from amvnet.inference.scan_stream import AHEAD, stream_scans
from amvnet.inference.segmenter import Segmenter
from amvnet.ranking.label_errors import rank
from amvnet.viewing.frames import LabelSource, choose_frames
from amvnet.weights.file import save

from fixtures.worlds import fresh_weights, make_streets, refusal, run_cli

WAIT = 30  # seconds until a thread gives up waiting for another


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("streets")
    make_streets(root)
    save(fresh_weights(), root / "w.safetensors")
    return root


@pytest.mark.parametrize("at_once", [1, 3])
def test_results_come_in_order(at_once: int) -> None:
    results = stream_scans(range(20), lambda n: n + 1, lambda n, scan: (n, scan), at_once)
    assert list(results) == [(n, n + 1) for n in range(20)]


def test_scans_are_computed_at_the_same_time() -> None:
    barrier = threading.Barrier(2)
    results = stream_scans(range(4), str, lambda n, scan: barrier.wait(WAIT), at_once=2)
    assert sorted(results) == [0, 0, 1, 1]


def test_few_scans_are_in_memory() -> None:
    loaded: list[int] = []

    results = stream_scans(range(100), lambda n: loaded.append(n), lambda n, scan: n, at_once=2)
    for done in results:
        assert len(loaded) <= done + 1 + AHEAD + 2 * 2


def test_an_error_comes_in_its_turn() -> None:
    def load(n: int) -> int:
        if n == 3:
            raise InputError("broken")
        return n

    results = stream_scans(range(6), load, lambda n, scan: n, at_once=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match="broken"):
        next(results)


def test_torch_has_its_threads_back_after_the_stream() -> None:
    threads = torch.get_num_threads()
    list(stream_scans(range(3), str, lambda n, scan: n, at_once=2))
    assert torch.get_num_threads() == threads


def _evaluated(dataset: Dataset, segmenter: Segmenter) -> Any:
    records = dataset.records(["08"])
    return evaluate(dataset, records, label_by_weights(dataset, segmenter)).report("x")


def _analyzed(dataset: Dataset, segmenter: Segmenter) -> Any:
    analysis = analyze(dataset, dataset.records(["08"]), segmenter)
    return [analysis.points.tolist(), analysis.ensemble.tolist(), analysis.head.tolist()]


def _ranked(dataset: Dataset, segmenter: Segmenter) -> Any:
    ranking = rank(dataset, dataset.records(["08"]), segmenter)
    return [ranking.clusters.tolist(), ranking.scans.tolist(), ranking.scores.tolist()]


def _viewed(dataset: Dataset, segmenter: Segmenter) -> Any:
    frames = choose_frames([dataset.spec], 10, LabelSource(segmenter))
    return [[frame.name, frame.labels["amvnet"].tolist()] for frame in frames.each()]


@pytest.mark.parametrize("command", [_evaluated, _analyzed, _ranked, _viewed])
def test_any_number_of_scans_at_a_time_gives_the_same_result(
    command: Callable[[Dataset, Segmenter], Any], data: Path
) -> None:
    results = []
    for at_once in (1, 3):
        segmenter = Segmenter(data / "w.safetensors")
        segmenter.at_once = at_once
        results.append(command(open_dataset(str(data)), segmenter))
    np.testing.assert_equal(*results)


@pytest.mark.parametrize("verb", ["evaluate", "analyze", "rank", "view"])
def test_every_command_takes_the_options_of_predict(verb: str, data: Path, tmp_path: Path) -> None:
    words = [verb, str(data), "--weights", str(data / "w.safetensors")]
    words += {
        "evaluate": [],
        "analyze": ["--out", str(tmp_path)],
        "rank": ["--out", str(tmp_path / "rank.csv")],
        "view": ["--html", str(tmp_path / "page.html")],
    }[verb]
    words += ["--engine", "torch", "--precision", "bfloat16"]
    assert run_cli(*words, "--at-once", "2") == (0, "")
    assert "--at-once" in refusal(shlex.join([*words, "--at-once", "0"]))
