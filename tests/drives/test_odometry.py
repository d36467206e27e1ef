"""Whether poses fit the scans of a drive."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amvnet.drives.odometry import Pair, check_fit

from fixtures.commands import fails


def posts(count: int = 600, seed: int = 0) -> np.ndarray:
    """Return points (N, 3) of posts 5 to 25 m away."""
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(-np.pi, np.pi, count)
    distance = rng.uniform(5, 25, count)
    return np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), 0 * azimuth])


def motion_of(metres: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    motion[0, 3] = metres
    return motion


def moved_back(points: np.ndarray, motion: np.ndarray) -> np.ndarray:
    return np.asarray((points - motion[:3, 3]) @ motion[:3, :3])


@pytest.mark.parametrize(("factor", "words"), [(1.25, "0.8 times"), (0.8, "1.25 times")])
@pytest.mark.parametrize("motion", [{"metres": 4.0}, {"degrees": 20.0}])
def test_the_message_names_the_motion_that_fits_better(
    factor: float, words: str, motion: dict[str, float]
) -> None:
    after = moved_back(posts(), motion_of(**motion))
    check_fit([Pair(posts(), after, motion_of(**motion))], "poses")
    wrong = motion_of(**{name: factor * value for name, value in motion.items()})
    fails(lambda: check_fit([Pair(posts(), after, wrong)], "poses"), f"motions {words} as long")
    fails(lambda: check_fit([Pair(posts(), posts(), wrong)], "poses"), "no motion")


def test_a_few_other_points_and_a_few_other_pairs_change_nothing() -> None:
    motion = motion_of(metres=4)
    after = moved_back(posts(), motion)
    after[:20] += 7  # the first points, of a car that overtakes
    pair = Pair(posts(), after, motion)
    other = Pair(posts(), posts(seed=1), motion)
    check_fit([pair, other, pair], "poses")


def test_points_on_the_car_and_far_away_are_not_compared() -> None:
    """The car moves with the sensor, and far points are too sparse to meet."""
    motion = motion_of(metres=4)
    rng = np.random.default_rng(0)
    own = rng.uniform(-1, 1, (2000, 3))
    before, after = (
        np.concatenate([points, own, rng.uniform(40, 400, (2000, 3))])
        for points in (posts(), moved_back(posts(), motion))
    )
    check_fit([Pair(before, after, motion)], "poses")


def test_scans_without_points_to_compare_fit_any_poses() -> None:
    none = np.empty((0, 3))
    check_fit([], "poses")
    check_fit([Pair(none, posts(), motion_of(4)), Pair(posts(), none, motion_of(4))], "poses")
