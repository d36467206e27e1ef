"""Augmentation is seeded, keeps distances up to a factor, and changes only what is switched on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from amvnet.config.schema import AugmentConfig
from amvnet.scan import Scan
from amvnet.training.augment import augment, mix, yaw_rotation

RandomScan = Callable[..., Scan]
OFF = AugmentConfig(scale=0.0, flip=0.0, jitter=0.0, yaw=0.0)


def augmented(scan: Scan, config: AugmentConfig, seed: int = 0) -> Scan:
    return augment(scan, config, np.random.default_rng(seed))


def distances(scan: Scan) -> np.ndarray:
    return np.array([math.hypot(*row[:3]) for row in scan.points.tolist()])


def azimuths(scan: Scan) -> np.ndarray:
    """Return (N,) azimuths in radians."""
    return np.array([math.atan2(y, x) for x, y, _, _ in scan.points.tolist()])


def winding(scan: Scan) -> float:
    """Return a positive number if the second point is to the left of the first."""
    (ax, ay), (bx, by) = scan.points[:2, :2].tolist()
    return ax * by - ay * bx


def index_by_point(scan: Scan) -> dict[tuple[float, ...], int]:
    return {tuple(row): index for index, row in enumerate(scan.points.tolist())}


def test_only_the_same_seed_gives_the_same_scan(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    points = augmented(scan, AugmentConfig(), seed=1).points
    assert np.array_equal(augmented(scan, AugmentConfig(), seed=1).points, points)
    assert not np.array_equal(augmented(scan, AugmentConfig(), seed=2).points, points)


def test_distances_are_scaled_by_one_factor_within_its_limits(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    factors = []
    for seed in range(30):
        ratio = distances(augmented(scan, AugmentConfig(jitter=0.0), seed)) / distances(scan)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
        factors.append(ratio[0])

    assert 0.95 <= min(factors) < 0.98
    assert 1.02 < max(factors) <= 1.05


def test_rotating_and_mirroring_keep_distances_and_heights(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    changed = augmented(scan, AugmentConfig(scale=0.0, jitter=0.0))
    np.testing.assert_allclose(distances(changed), distances(scan), rtol=1e-5)
    assert np.array_equal(changed.points[:, 2], scan.points[:, 2])
    assert not np.allclose(changed.points[:, :2], scan.points[:, :2])


def test_all_points_are_rotated_by_one_angle_within_its_limits(random_scan: RandomScan) -> None:
    scan = random_scan(20)
    angles = []
    for seed in range(30):
        changed = augmented(scan, replace(OFF, yaw=30.0), seed)
        differences = (azimuths(changed) - azimuths(scan)).tolist()
        turns = [math.degrees(math.remainder(angle, math.tau)) for angle in differences]
        assert max(turns) - min(turns) < 1e-3
        angles.append(turns[0])

    assert -30 <= min(angles) < -15
    assert 15 < max(angles) <= 30


def test_a_rotation_by_a_quarter_turn_brings_front_to_left() -> None:
    np.testing.assert_allclose(yaw_rotation(math.pi / 2) @ [1, 0], [0, 1], atol=1e-12)


def test_the_scan_is_mirrored_in_all_four_ways(random_scan: RandomScan) -> None:
    scan = random_scan(20)
    mirrorings = set()
    for seed in range(40):
        signs = augmented(scan, replace(OFF, flip=0.5), seed).points[:, :3] / scan.points[:, :3]
        assert (signs == signs[0]).all()
        mirrorings.add(tuple(signs[0].tolist()))

    assert mirrorings == {(1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, 1)}


def test_jitter_is_noise_of_its_standard_deviation_on_each_coordinate(
    random_scan: RandomScan,
) -> None:
    scan = random_scan(5000)
    noise = (augmented(scan, replace(OFF, jitter=0.1)).points - scan.points)[:, :3]
    np.testing.assert_allclose(noise.std(axis=0), 0.1, rtol=0.05)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=0.01)
    assert abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.1


def test_with_everything_off_the_scan_stays_the_same(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    assert np.array_equal(augmented(scan, OFF).points, scan.points)


def test_labels_intensity_ring_and_name_stay_by_default(random_scan: RandomScan) -> None:
    scan = replace(random_scan(50), name="somewhere")
    changed = augmented(scan, AugmentConfig())
    assert np.array_equal(changed.points[:, 3], scan.points[:, 3])
    assert changed.labels is scan.labels
    assert changed.ring is scan.ring
    assert changed.name == "somewhere"
    assert changed.points.dtype == np.float32


def test_the_original_scan_is_not_modified(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    before = scan.points.copy()
    augmented(scan, AugmentConfig(flip=1.0))
    assert np.array_equal(scan.points, before)


def test_lost_returns_stay_lost_and_keep_their_index(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    scan.points[7, 0] = math.nan
    assert np.flatnonzero(~augmented(scan, AugmentConfig()).valid).tolist() == [7]


@pytest.mark.parametrize("flip", [0.0, 1.0])
def test_mirroring_both_axes_or_none_keeps_the_winding(
    random_scan: RandomScan, flip: float
) -> None:
    scan = random_scan(2)
    changed = augmented(scan, replace(OFF, flip=flip, yaw=180.0))
    assert winding(changed) == pytest.approx(winding(scan), rel=1e-4)


def test_points_are_dropped_together_with_their_labels_and_rings(random_scan: RandomScan) -> None:
    scan = random_scan(1000)
    assert scan.labels is not None
    assert scan.ring is not None

    index_of = index_by_point(scan)
    shares = []
    for seed in range(30):
        changed = augmented(scan, replace(OFF, drop=0.4), seed)
        indices = [index_of[tuple(row)] for row in changed.points.tolist()]
        assert indices == sorted(indices)
        assert changed.labels is not None
        assert changed.ring is not None
        assert np.array_equal(changed.labels, scan.labels[indices])
        assert np.array_equal(changed.ring, scan.ring[indices])
        shares.append(1 - len(changed) / len(scan))

    assert min(shares) < 0.1
    assert 0.3 < max(shares) < 0.45


def test_a_single_point_is_never_dropped(random_scan: RandomScan) -> None:
    scan = random_scan(1)
    for seed in range(50):
        assert len(augmented(scan, replace(OFF, drop=0.99), seed)) == 1


def test_all_points_are_lifted_by_one_height_within_its_limits(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    heights = []
    for seed in range(30):
        change = augmented(scan, replace(OFF, height=0.5), seed).points - scan.points
        assert (change[:, [0, 1, 3]] == 0).all()
        np.testing.assert_allclose(change[:, 2], change[0, 2], atol=1e-5)
        heights.append(change[0, 2])

    assert -0.5 <= min(heights) < -0.3
    assert 0.3 < max(heights) <= 0.5


def test_intensity_is_scaled_by_one_factor_and_stays_at_most_one(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    intensity = scan.points[:, 3]
    gains = []
    for seed in range(30):
        changed = augmented(scan, replace(OFF, intensity=0.5), seed).points
        assert np.array_equal(changed[:, :3], scan.points[:, :3])

        gain = changed[:, 3].min() / intensity.min()
        np.testing.assert_allclose(changed[:, 3], np.minimum(intensity * gain, 1), rtol=1e-5)
        gains.append(gain)

    assert 0.5 <= min(gains) < 0.7
    assert 1.3 < max(gains) <= 1.5


def test_some_scans_have_no_intensity(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    sums = []
    for seed in range(100):
        changed = augmented(scan, replace(OFF, no_intensity=0.3), seed)
        sums.append(changed.points[:, 3].sum())

    assert set(np.round(sums, 3)) == {0, np.round(scan.points[:, 3].sum(), 3)}
    assert 15 < sums.count(0) < 45


def test_a_mixed_scan_has_one_sector_of_another_scan(random_scan: RandomScan) -> None:
    scan = random_scan(2000, 1)
    other = random_scan(1500, 2)
    shares = []
    for seed in range(30):
        mixed = mix(scan, other, np.random.default_rng(seed))
        is_foreign = from_other_scan(mixed, scan, other)

        around = is_foreign[np.argsort(azimuths(mixed))]
        borders = np.count_nonzero(around != np.roll(around, 1))
        assert borders == 2
        shares.append(is_foreign.sum() / len(other))

    assert 0.2 < min(shares) < 0.4
    assert 0.6 < max(shares) < 0.8


def from_other_scan(mixed: Scan, scan: Scan, other: Scan) -> np.ndarray:
    """Return (N,) bool: whether a point comes from `other`; check its label and ring."""
    assert mixed.labels is not None
    assert mixed.ring is not None

    index_in_scan = index_by_point(scan)
    index_in_other = index_by_point(other)
    is_foreign = []
    for row, label, ring in zip(mixed.points.tolist(), mixed.labels, mixed.ring, strict=True):
        point = tuple(row)
        if point in index_in_other:
            source = other
            index = index_in_other[point]
        else:
            source = scan
            index = index_in_scan[point]
        is_foreign.append(source is other)

        assert source.labels is not None
        assert source.ring is not None
        assert label == source.labels[index]
        assert ring == source.ring[index]
    return np.array(is_foreign)
