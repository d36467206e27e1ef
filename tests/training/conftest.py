"""Fixtures of all tests of trainings."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from amvnet.training import run as training_run
from amvnet.training.curves import Curves


@pytest.fixture(autouse=True)
def without_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no curves, which takes a fifth of a small training.

    Fixtures of a wider scope are made before this one, and draw theirs.
    """

    def draw_nothing(stages: Mapping[str, Curves], path: Path) -> Path:
        return path

    monkeypatch.setattr(training_run, "draw_curves", draw_nothing)
