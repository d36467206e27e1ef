"""Predictions of other tools are scored by name; what is usually written instead of them is told in one line."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fixtures.worlds import GOLDEN, run_cli

SETS = {
    "semantickitti": ("sequences/08/predictions", "<u4"),
    "nuscenes": ("lidarseg/mini_val", "u1"),
}


@pytest.fixture(params=SETS)
def given(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path, str]:
    """The golden set, a copy of its predictions, and their number type."""
    name = request.param
    folder, dtype = SETS[name]
    source = GOLDEN / name / ("results" if name == "nuscenes" else "")
    shutil.copytree(source / folder, tmp_path / "p" / folder)
    return f"{name}:{GOLDEN / name}", tmp_path / "p", dtype


def first(folder: Path) -> Path:
    return min(path for path in folder.rglob("*") if path.suffix in (".label", ".bin"))


def scored(spec: str, folder: Path) -> float:
    out = folder.parent / "m.json"
    assert run_cli("evaluate", spec, "--predictions", folder, "--json", out) == (0, "")
    return json.loads(out.read_text())["methods"]["predictions"]["miou"]


def test_files_beside_the_predictions_change_nothing(given: tuple[str, Path, str]) -> None:
    spec, folder, _ = given
    before = scored(spec, folder)
    for name in (
        "scores.npz",
        "._000000.label",
        "000000.label.bak",
        "zzz.label",
        "zzz_lidarseg.bin",
        "submission.json",
    ):
        (first(folder).parent / name).write_bytes(b"not a prediction")
    assert scored(spec, folder) == before


def test_signed_ids_and_instances_are_the_same_labels(given: tuple[str, Path, str]) -> None:
    spec, folder, dtype = given
    before = scored(spec, folder)
    for path in [p for p in folder.rglob("*") if p.is_file()]:
        ids = np.fromfile(path, dtype)
        (ids | (7 << 16) if dtype == "<u4" else ids).astype(dtype.replace("u", "i")).tofile(path)
    assert scored(spec, folder) == before


def test_a_point_without_class_is_missed(given: tuple[str, Path, str]) -> None:
    spec, folder, dtype = given
    before = scored(spec, folder)
    np.zeros_like(np.fromfile(first(folder), dtype)).tofile(first(folder))
    assert scored(spec, folder) < before


WRONG: dict[str, tuple[Callable[[np.ndarray], np.ndarray | None], str]] = {
    "int64": (lambda ids: ids.astype("<i8"), "ids of 64 bits"),
    "uint16": (lambda ids: ids.astype("<u2"), "ids of 16 bits"),
    "a point too few": (lambda ids: ids[:-1], "one per point"),
    "two scans in one": (lambda ids: np.tile(ids, 3), "one per point"),
    "255 and -1 for no class": (
        lambda ids: np.full_like(ids, -1, dtype=ids.dtype.str.replace("u", "i")),
        "raw ids",
    ),
    "fine categories": (
        lambda ids: np.resize(np.array([23, 24, 31], ids.dtype), len(ids)),
        "found 23, 24",
    ),
    "missing": (lambda ids: None, "no file"),
    "empty": (lambda ids: ids[:0], "found 0"),
}
WRONG_KITTI: dict[str, tuple[Callable[[np.ndarray], np.ndarray | None], str]] = {
    "float32": (lambda ids: (ids & 0xFFFF).astype("<f4"), "float32"),
    "big-endian": (lambda ids: (ids & 0xFFFF).astype(">u4"), "big-endian"),
    "uint8": (lambda ids: ids.astype("u1"), "ids of 8 bits"),
    "train ids": (lambda ids: np.resize(np.arange(20, dtype="<u4"), len(ids)), "train ids"),
}


MISTAKES = [("semantickitti", mistake) for mistake in WRONG | WRONG_KITTI] + [
    ("nuscenes", mistake) for mistake in WRONG
]


@pytest.mark.parametrize(("given", "mistake"), MISTAKES, indirect=["given"])
def test_what_is_no_prediction_is_one_line(
    mistake: str, given: tuple[str, Path, str], tmp_path: Path
) -> None:
    spec, folder, dtype = given
    path = first(folder)
    change, words = (WRONG | WRONG_KITTI)[mistake]
    made = change(np.fromfile(path, dtype))
    path.unlink()
    if made is not None:
        made.tofile(path)
    code, error = run_cli("evaluate", spec, "--predictions", folder, "--json", tmp_path / "m.json")
    assert (code, error.count("\n")) == (2, 1), error
    assert all(word in error for word in (str(path), "expected", "found", "; ", words)), error
    assert not (tmp_path / "m.json").exists()
