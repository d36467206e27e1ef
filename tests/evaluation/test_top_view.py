"""A picture appears whole, with the colours of the classes that are in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from numpy.typing import ArrayLike

from amvnet.data.taxonomy import NUSCENES, UNCERTAIN_COLOR, WRONG_COLOR
from amvnet.evaluation.top_view import TopView, draw_scan

from fixtures.marks import with_full

BLOCK = 400  # points of one class in one block, dense enough to fill pixels


def blocks(classes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return points in one dense block per class, and their ids."""
    points = np.random.default_rng(0).random((BLOCK * len(classes), 4)) * 8
    points[:, 0] += np.repeat(np.arange(len(classes)) * 10.0 - 40, BLOCK)
    return points.astype(np.float32), np.repeat(classes, BLOCK).astype(np.uint8)


def has_color(image: np.ndarray, color: ArrayLike) -> bool:
    """Return whether more than 50 pixels have a colour, RGB in [0, 1]."""
    return bool((np.abs(image[..., :3] - np.asarray(color)).max(axis=-1) < 2 / 255).sum() > 50)


def class_color(class_id: int) -> tuple[float, ...]:
    red, green, blue = NUSCENES.colors[class_id]
    return red / 255, green / 255, blue / 255


def test_picture_has_the_colours_of_its_classes(tmp_path: Path) -> None:
    points, truth = blocks([4, 11, 16])
    prediction = truth.copy()
    prediction[:BLOCK] = 3

    view = TopView(
        points,
        NUSCENES,
        {"RV": prediction, "AMVNet": truth},
        truth=truth,
        uncertain=truth == 4,
        title="title",
    )
    path = draw_scan(tmp_path / "a" / "b.png", view)

    image = imread(path)
    for class_id in (3, 4, 11, 16):
        assert has_color(image, class_color(class_id))

    assert not has_color(image, class_color(7))
    assert has_color(image, np.divide(WRONG_COLOR, 255))
    assert has_color(image, np.divide(UNCERTAIN_COLOR, 255))
    assert [file.name for file in path.parent.iterdir()] == ["b.png"]


@pytest.mark.parametrize("with_uncertain", with_full([False, True], [False]))
def test_points_that_are_lost_or_not_known_to_be_uncertain_are_left_out(
    tmp_path: Path, with_uncertain: bool
) -> None:
    points, ids = blocks([1, 0])
    points[0] = np.nan
    uncertain = ids > 0 if with_uncertain else None

    view = TopView(points, NUSCENES, {"p": ids}, ids, "title", uncertain)
    image = imread(draw_scan(tmp_path / "a.png", view))
    assert has_color(image, np.divide(UNCERTAIN_COLOR, 255)) == with_uncertain
