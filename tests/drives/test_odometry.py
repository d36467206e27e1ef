"""Whether poses fit the scans of a drive."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amvnet.drives.odometry import Pair, check_fit, check_steps

from fixtures.commands import fails, not_none
from fixtures.drives import drive_poses

NAMED = ("poses", "advice")  # the beginning and the end of a message


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
def test_the_better_motion_is_named(factor: float, words: str, motion: dict[str, float]) -> None:
    after = moved_back(posts(), motion_of(**motion))
    check_fit([Pair(posts(), after, motion_of(**motion))], *NAMED)
    wrong = motion_of(**{name: factor * value for name, value in motion.items()})
    fails(lambda: check_fit([Pair(posts(), after, wrong)], *NAMED), f"motions {words} as long")
    fails(lambda: check_fit([Pair(posts(), posts(), wrong)], *NAMED), "no motion")


def test_a_few_other_points_and_a_few_other_pairs_change_nothing() -> None:
    motion = motion_of(metres=4)
    after = moved_back(posts(), motion)
    after[:20] += 7  # the first points, of a car that overtakes
    pair = Pair(posts(), after, motion)
    check_fit([pair, Pair(posts(), posts(seed=1), motion), pair], *NAMED)


def test_points_on_the_car_and_far_away_are_not_compared() -> None:
    """The car moves with the sensor, and far points are too sparse to meet."""
    motion = motion_of(metres=4)
    rng = np.random.default_rng(0)
    own = rng.uniform(-1, 1, (2000, 3))
    before, after = (
        np.concatenate([points, own, rng.uniform(40, 400, (2000, 3))])
        for points in (posts(), moved_back(posts(), motion))
    )
    check_fit([Pair(before, after, motion)], *NAMED)


def test_a_single_pose_off_the_way_is_named() -> None:
    poses = drive_poses(30)
    names = [f"{index:06d}" for index in range(30)]
    check_steps(poses, names, *NAMED)
    for metres in (20, 900):
        for index in (1, 12, 28):
            wrong = poses.copy()
            wrong[index, 1, 3] += metres
            fails(partial(check_steps, wrong, names, *NAMED), names[index], "m off the way")


def test_poses_of_kilometres_are_named() -> None:
    """The first scans had no fix."""
    poses = drive_poses(30)
    names = [f"{index:06d}" for index in range(30)]
    for first in (1, 5):
        wrong = poses.copy()
        wrong[first:, :2, 3] += (690_000, 5_335_000)
        words = (names[first - 1], names[first], "5,379,4")
        fails(partial(check_steps, wrong, names, *NAMED), "poses", *words)
    check_steps(wrong[first:], names[first:], *NAMED)


def test_ways_that_a_car_takes_have_no_jump() -> None:
    """It stands, turns round, pauses the recording, and is seen in whole metres."""
    poses = drive_poses(30)
    names = [f"{index:06d}" for index in range(30)]
    back = np.concatenate((poses[:15], poses[13::-1]))
    gap = poses.copy()
    gap[12:, 0, 3] += 300
    whole = poses.copy()
    whole[:, :3, 3] = np.round(whole[:, :3, 3])
    for some in (poses[:2], poses[::5], back, gap, whole, np.repeat(poses[:1], 9, axis=0)):
        check_steps(some, names[: len(some)], *NAMED)


@pytest.mark.parametrize("seed", range(3))
def test_the_fit_says_how_exact_poses_are(seed: int) -> None:
    """The alignment finds the true motion, of which poses are off by metres and degrees."""
    motion = motion_of(metres=3)
    pair = Pair(posts(seed=seed), moved_back(posts(seed=seed), motion), motion)
    fit = not_none(check_fit([pair], *NAMED))
    assert fit.distance == pytest.approx(0, abs=1e-9) == fit.shift
    assert not fit.is_doubtful

    wrong = replace(pair, motion=motion @ motion_of(degrees=0.6))
    fit = not_none(check_fit([wrong], *NAMED))
    assert fit.is_doubtful
    assert fit.least == pytest.approx(0, abs=0.01)
    reach = np.median(np.linalg.norm(posts(seed=seed), axis=1))
    assert fit.shift == pytest.approx(np.radians(0.6) * reach, rel=0.2)

    wrong = replace(pair, motion=motion @ motion_of(metres=-0.1, degrees=1.5))
    fails(lambda: check_fit([wrong], *NAMED), "poses", "if they are aligned", "advice")


def test_scans_without_points_to_compare_fit_any_poses() -> None:
    none = np.empty((0, 3))
    assert check_fit([], *NAMED) is None
    check_fit(
        [Pair(none, posts(), motion_of(4)), Pair(posts(), none, motion_of(4))], "poses", "advice"
    )
