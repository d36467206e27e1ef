"""The classes of a drawing can be told apart, and from points that are marked."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amvnet.data.class_maps import class_map
from amvnet.data.palette import LEAST, UNCERTAIN, class_colors, to_lab
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy

COLORS = st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=2, max_size=20)


def distance(first: tuple[int, int, int], second: tuple[int, int, int]) -> float:
    return float(np.linalg.norm(np.subtract(*to_lab(np.array([first, second])))))


@pytest.mark.parametrize("taxonomy", [SEMANTICKITTI, NUSCENES, class_map("coarse").target])
def test_the_classes_and_uncertain_points_can_be_told_apart(taxonomy: Taxonomy) -> None:
    colors = class_colors(taxonomy.colors)[1:]
    for first, second in combinations([*colors, UNCERTAIN], 2):
        assert distance(first, second) >= LEAST


def test_a_traffic_sign_is_not_drawn_as_a_person() -> None:
    colors = dict(zip(SEMANTICKITTI.classes, class_colors(SEMANTICKITTI.colors)[1:], strict=True))
    assert colors["person"] == (255, 30, 30)
    assert distance(colors["person"], colors["traffic-sign"]) > 2 * LEAST


@settings(deadline=None, max_examples=30)
@given(COLORS)
def test_only_colors_that_are_like_an_earlier_one_are_replaced(
    colors: list[tuple[int, int, int]],
) -> None:
    drawn = class_colors(tuple(colors))
    assert len(drawn) == len(colors)
    assert drawn[0] == colors[0]
    for index in range(1, len(colors)):
        earlier = [UNCERTAIN, *drawn[1:index]]
        is_like = min(distance(colors[index], color) for color in earlier) < LEAST
        assert is_like or drawn[index] == colors[index]


def test_black_and_white_are_100_apart() -> None:
    assert distance((0, 0, 0), (255, 255, 255)) == pytest.approx(100, abs=0.1)
