"""Fixtures of all tests of trainings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from amvnet.training import run as training_run
from amvnet.training.curves import Curves


@pytest.fixture(autouse=True)
def without_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no curves, a fifth of a small training; fixtures of wider scopes draw theirs before."""

    def draw_nothing(stages: Mapping[str, Curves], path: Path) -> Path:
        return path

    monkeypatch.setattr(training_run, "draw_curves", draw_nothing)
