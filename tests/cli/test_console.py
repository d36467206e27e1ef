"""Progress without a terminal: lines with a pace, at sensible intervals."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import pairwise

import pytest

from amvnet.cli import console


@pytest.fixture
def lines_at(monkeypatch: pytest.MonkeyPatch) -> Callable[[float, int], list[tuple[float, str]]]:
    """Return what says which lines appear, and when, at a pace of seconds per item."""

    def run(seconds: float, total: int) -> list[tuple[float, str]]:
        now = [0.0]
        lines: list[tuple[float, str]] = []
        monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
        monkeypatch.setattr(console, "say", lambda line: lines.append((now[0], line)))
        progress = console.ProgressLines("segmenting")
        for done in range(total + 1):
            now[0] = seconds * done
            progress(done, total)
        return lines

    return run


@pytest.mark.parametrize("seconds", [0.001, 0.1, 1, 20, 500])
@pytest.mark.parametrize("total", [1, 7, 300])
def test_lines_are_neither_crowded_nor_far_apart(
    lines_at: Callable[[float, int], list[tuple[float, str]]], seconds: float, total: int
) -> None:
    times = [0.0, *(time for time, _ in lines_at(seconds, total))]
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert all(gap >= console.LEAST_SECONDS for gap in gaps)
    assert all(gap <= console.MOST_SECONDS + seconds for gap in gaps)


def test_a_line_has_the_pace_and_the_time_left(
    lines_at: Callable[[float, int], list[tuple[float, str]]],
) -> None:
    texts = [text for _, text in lines_at(10, 100)]
    assert texts[0] == "segmenting: 6 of 100, 10 s each, 0:15:40 left"
    assert all(re.fullmatch(r"segmenting: \d+ of 100, .*, \d+:\d\d:\d\d left", t) for t in texts)
    assert "2 a second" in lines_at(0.5, 100)[0][1]
