"""A picture appears whole, with the colours of the classes that are in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from amvnet.data.taxonomy import NUSCENES
from amvnet.errors import InputError
from amvnet.evaluation.top_view import UNCERTAIN, WRONG, draw_scan

PATCH = 400  # points of one class in one block, dense enough to fill pixels


def blocks(classes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Points in one dense block per class, and their ids."""
    rng = np.random.default_rng(0)
    points = rng.random((PATCH * len(classes), 4)) * 8
    points[:, 0] += np.repeat(np.arange(len(classes)) * 10.0 - 40, PATCH)
    return points.astype(np.float32), np.repeat(classes, PATCH).astype(np.uint8)


def has(image: np.ndarray, color: tuple[float, ...]) -> bool:
    return bool((np.abs(image[..., :3] - np.asarray(color)).max(axis=-1) < 2 / 255).sum() > 50)


def test_picture_has_the_colours_of_its_classes(tmp_path: Path) -> None:
    points, truth = blocks([4, 11, 16])
    wrong = np.where(np.arange(len(truth)) < PATCH, 3, truth)
    path = draw_scan(
        tmp_path / "a" / "b.png",
        points,
        NUSCENES,
        {"RV": wrong, "AMVNet": truth},
        truth,
        truth == 4,
        "title",
    )
    image = imread(path)
    for class_id in (3, 4, 11, 16):
        assert has(image, tuple(part / 255 for part in NUSCENES.colors[class_id]))
    assert not has(image, tuple(part / 255 for part in NUSCENES.colors[7]))
    assert has(image, WRONG)
    assert has(image, UNCERTAIN)
    assert [p.name for p in path.parent.iterdir()] == ["b.png"]


@pytest.mark.parametrize("with_truth", [False, True])
@pytest.mark.parametrize("with_uncertain", [False, True])
def test_every_part_is_optional(tmp_path: Path, with_truth: bool, with_uncertain: bool) -> None:
    points, ids = blocks([1, 0])
    points[0] = np.nan
    uncertain = ids > 0 if with_uncertain else None
    assert draw_scan(
        tmp_path / "a.png", points, NUSCENES, {"p": ids}, ids if with_truth else None, uncertain
    ).is_file()


def test_truth_alone_is_enough(tmp_path: Path) -> None:
    points, ids = blocks([2])
    assert draw_scan(tmp_path / "a.png", points, NUSCENES, {}, truth=ids).is_file()


def test_what_does_not_fit_is_named(tmp_path: Path) -> None:
    points, ids = blocks([2])
    with pytest.raises(InputError, match=r"a\.png.*neither"):
        draw_scan(tmp_path / "a.png", points, NUSCENES, {})
    with pytest.raises(InputError, match="'rv'"):
        draw_scan(tmp_path / "a.png", points, NUSCENES, {"rv": ids[1:]})
    assert not any(tmp_path.iterdir())
