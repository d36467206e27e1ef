"""A few of many scans."""

from collections.abc import Sequence
from itertools import pairwise

import pytest

from amvnet.data.recordings import evenly_spaced


def test_spaced_items_are_distinct_in_order_and_reach_both_ends() -> None:
    for count in range(2, 40):
        for limit in range(2, 50):
            chosen = evenly_spaced(range(count), limit)
            steps = {after - before for before, after in pairwise(chosen)}

            assert len(chosen) == min(count, limit)
            assert (chosen[0], chosen[-1]) == (0, count - 1)
            assert min(steps) > 0
            assert max(steps) - min(steps) <= 1


@pytest.mark.parametrize(("items", "limit", "expected"), [("", 3, []), ("abc", 1, ["a"])])
def test_no_items_and_a_single_place(items: Sequence[str], limit: int, expected: list[str]) -> None:
    assert evenly_spaced(items, limit) == expected
