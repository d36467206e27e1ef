"""The classes of a drawing can be told apart, and from points that are marked."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from amvnet.data.class_maps import BUILT_IN, class_map
from amvnet.data.taxonomy import (
    DRAWN_COLORS,
    NUSCENES,
    SEMANTICKITTI,
    TAXONOMIES,
    UNCERTAIN_COLOR,
    Taxonomy,
    class_colors,
)

LEAST = 20.0  # distance of two colours in CIELAB from which they can be told apart
DARK = 20  # lightness in CIELAB; darker colours cannot be seen on the dark page
# From linear sRGB to CIE XYZ, relative to white (D65).
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def to_lab(color: tuple[int, int, int]) -> np.ndarray:
    encoded = np.array(color) / 255
    linear = np.where(encoded > 0.04045, ((encoded + 0.055) / 1.055) ** 2.4, encoded / 12.92)
    ratio = TO_XYZ @ linear / TO_XYZ.sum(axis=1)
    x, y, z = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def distance(first: tuple[int, int, int], second: tuple[int, int, int]) -> float:
    return float(np.linalg.norm(to_lab(first) - to_lab(second)))


@pytest.mark.parametrize(
    "taxonomy", [SEMANTICKITTI, NUSCENES, *(class_map(name).target for name in BUILT_IN)]
)
def test_the_classes_and_uncertain_points_can_be_told_apart(taxonomy: Taxonomy) -> None:
    for first, second in combinations([*class_colors(taxonomy)[1:], UNCERTAIN_COLOR], 2):
        assert distance(first, second) >= LEAST


def test_a_traffic_sign_is_not_drawn_as_a_person() -> None:
    colors = dict(zip(SEMANTICKITTI.names, class_colors(SEMANTICKITTI), strict=True))
    assert colors["person"] == (255, 30, 30)
    assert distance(colors["person"], colors["traffic-sign"]) > 2 * LEAST


@pytest.mark.parametrize("name", TAXONOMIES)
def test_only_colors_that_are_like_another_one_or_dark_are_replaced(name: str) -> None:
    taxonomy = TAXONOMIES[name]
    official = dict(zip(taxonomy.names, taxonomy.colors, strict=True))
    assert set(DRAWN_COLORS[name]) <= set(taxonomy.classes)
    for replaced in DRAWN_COLORS[name]:
        others = [color for other, color in official.items() if other != replaced]
        distances = [
            distance(official[replaced], color) for color in [*others[1:], UNCERTAIN_COLOR]
        ]
        is_dark = to_lab(official[replaced])[0] < DARK
        assert min(distances) < LEAST or is_dark


def test_black_and_white_are_100_apart() -> None:
    assert distance((0, 0, 0), (255, 255, 255)) == pytest.approx(100, abs=0.1)
