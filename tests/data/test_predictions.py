"""Predictions of other tools are scored by file name; the usual mistakes are named in one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fixtures.commands import refusal, run_cli
from fixtures.tiny import GOLDEN


@dataclass
class Predictions:
    """A golden dataset and a folder with a copy of its predictions, which are of type `dtype`."""

    spec: str
    folder: Path
    dtype: str

    @property
    def paths(self) -> list[Path]:
        return sorted([*self.folder.rglob("*.label"), *self.folder.rglob("*.bin")])

    def score(self) -> float:
        report = self.folder.parent / "report.json"
        arguments = (self.spec, "--predictions", self.folder, "--json", report, "--overwrite")
        assert run_cli("evaluate", *arguments) == (0, "")
        return json.loads(report.read_text())["methods"]["predictions"]["miou"]


@pytest.fixture(params=["semantickitti", "nuscenes"])
def predictions(request: pytest.FixtureRequest, tmp_path: Path) -> Predictions:
    folder = tmp_path / "predictions"
    if request.param == "semantickitti":
        data = GOLDEN / "semantickitti"
        shutil.copytree(data / "sequences/08/predictions", folder / "sequences/08/predictions")
        return Predictions(f"semantickitti:{data}", folder, "<u4")

    data = GOLDEN / "nuscenes"
    shutil.copytree(data / "results/lidarseg/mini_val", folder / "lidarseg/mini_val")
    return Predictions(f"nuscenes:{data}", folder, "u1")


def test_other_files_in_the_folder_change_nothing(predictions: Predictions) -> None:
    score = predictions.score()
    folder = predictions.paths[0].parent
    for name in (
        "scores.npz",
        "._000000.label",
        "000000.label.bak",
        "zzz.label",
        "zzz_lidarseg.bin",
        "submission.json",
    ):
        (folder / name).write_bytes(b"not a prediction")

    assert predictions.score() == score


def test_signed_ids_and_instances_are_the_same_labels(predictions: Predictions) -> None:
    score = predictions.score()
    for path in predictions.paths:
        ids = np.fromfile(path, predictions.dtype)
        if predictions.dtype == "<u4":
            ids |= 7 << 16
        ids.astype(predictions.dtype.replace("u", "i")).tofile(path)

    assert predictions.score() == score


def test_a_point_without_class_is_missed(predictions: Predictions) -> None:
    score = predictions.score()
    path = predictions.paths[0]
    np.zeros_like(np.fromfile(path, predictions.dtype)).tofile(path)
    assert predictions.score() < score


def fill(ids: np.ndarray, *values: int) -> np.ndarray:
    return np.resize(np.array(values, ids.dtype), len(ids))


def minus_one(ids: np.ndarray) -> np.ndarray:
    """Return -1 for every point, which is 255 in one byte."""
    return np.full_like(ids, -1, dtype=ids.dtype.str.replace("u", "i"))


def classes(ids: np.ndarray) -> np.ndarray:
    return ids & 0xFFFF


# How to change the ids of a good prediction (None: remove the file), and words of the message.
Mistake = tuple[Callable[[np.ndarray], np.ndarray | None], str]
MISTAKES: dict[str, Mistake] = {
    "int64": (lambda ids: ids.astype("<i8"), "ids of 64 bits"),
    "uint16": (lambda ids: ids.astype("<u2"), "ids of 16 bits"),
    "a point too few": (lambda ids: ids[:-1], "one per point"),
    "two scans too many": (lambda ids: np.tile(ids, 3), "one per point"),
    "255 and -1 for no class": (minus_one, "raw ids"),
    "fine categories": (lambda ids: fill(ids, 23, 24, 31), "found 23, 24"),
    "missing": (lambda ids: None, "no file"),
    "empty": (lambda ids: ids[:0], "found 0"),
}
SEMANTICKITTI_MISTAKES: dict[str, Mistake] = {
    "float32": (lambda ids: classes(ids).astype("<f4"), "float32"),
    "big-endian": (lambda ids: classes(ids).astype(">u4"), "big-endian"),
    "uint8": (lambda ids: ids.astype("u1"), "ids of 8 bits"),
    "train ids": (lambda ids: fill(ids, *range(20)), "train ids"),
}


def check_mistake(predictions: Predictions, mistake: Mistake) -> None:
    """Check that a mistake in the first prediction is named in one line."""
    change, words = mistake
    path = predictions.paths[0]
    ids = change(np.fromfile(path, predictions.dtype))
    if ids is None:
        path.unlink()
    else:
        ids.tofile(path)

    report = predictions.folder.parent / "report.json"
    arguments = (predictions.spec, "--predictions", predictions.folder, "--json", report)
    error = refusal("evaluate", *arguments)
    for word in (str(path), "expected", "found", "; ", words):
        assert word in error
    assert not report.exists()


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named_in_one_line(name: str, predictions: Predictions) -> None:
    check_mistake(predictions, MISTAKES[name])


@pytest.mark.parametrize("name", SEMANTICKITTI_MISTAKES)
@pytest.mark.parametrize("predictions", ["semantickitti"], indirect=True)
def test_a_mistake_in_four_byte_ids_is_one_line(name: str, predictions: Predictions) -> None:
    check_mistake(predictions, SEMANTICKITTI_MISTAKES[name])
