"""Augmentation: seeded, keeps distances but for one factor; what a value of it does not name stays as it was."""

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
STILL = AugmentConfig(scale=0.0, flip=0.0, jitter=0.0, yaw=0.0)


def augmented(scan: Scan, config: AugmentConfig, seed: int = 0) -> Scan:
    return augment(scan, config, np.random.default_rng(seed))


def distances(scan: Scan) -> np.ndarray:
    return np.array([math.hypot(*row[:3]) for row in scan.points.tolist()])


def winding(scan: Scan) -> float:
    """Positive if the second point is to the left of the first, seen from the sensor."""
    (ax, ay), (bx, by) = scan.points[:2, :2].tolist()
    return ax * by - ay * bx


def test_the_same_seed_gives_the_same_scan_and_another_another(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    first, again, other = (augmented(scan, AugmentConfig(), seed).points for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_distances_are_scaled_by_one_factor_within_its_limits(random_scan: RandomScan) -> None:
    scan, factors = random_scan(50), []
    for seed in range(30):
        ratio = distances(augmented(scan, AugmentConfig(jitter=0.0), seed)) / distances(scan)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-5)
        factors.append(ratio[0])
    assert 0.95 <= min(factors) < 0.98
    assert 1.02 < max(factors) <= 1.05


def test_turning_and_mirroring_keep_distances_and_heights(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    changed = augmented(scan, AugmentConfig(scale=0.0, jitter=0.0))
    np.testing.assert_allclose(distances(changed), distances(scan), rtol=1e-5)
    assert np.array_equal(changed.points[:, 2], scan.points[:, 2])
    assert not np.allclose(changed.points[:, :2], scan.points[:, :2])


def test_turning_is_by_one_angle_within_its_limits(random_scan: RandomScan) -> None:
    scan, angles = random_scan(20), []
    for seed in range(30):
        changed = augmented(scan, replace(STILL, yaw=30.0), seed).points.tolist()
        pairs = zip(changed, scan.points.tolist(), strict=True)
        radians = [math.atan2(y, x) - math.atan2(b, a) for (x, y, *_), (a, b, *_) in pairs]
        turns = [math.degrees(math.remainder(r, math.tau)) for r in radians]
        assert max(turns) - min(turns) < 1e-3
        angles.append(turns[0])
    assert -30 <= min(angles) < -15
    assert 15 < max(angles) <= 30


def test_a_rotation_by_a_quarter_turn_brings_front_to_left() -> None:
    np.testing.assert_allclose(yaw_rotation(math.pi / 2) @ [1, 0], [0, 1], atol=1e-12)


def test_all_four_mirrorings_occur_and_none_else(random_scan: RandomScan) -> None:
    scan, seen = random_scan(20), set()
    for seed in range(40):
        signs = augmented(scan, replace(STILL, flip=0.5), seed).points[:, :3] / scan.points[:, :3]
        assert (signs == signs[0]).all()
        seen.add(tuple(signs[0].tolist()))
    assert seen == {(1, 1, 1), (-1, 1, 1), (1, -1, 1), (-1, -1, 1)}


def test_jitter_is_noise_of_its_standard_deviation_on_each_coordinate(
    random_scan: RandomScan,
) -> None:
    scan = random_scan(5000)
    noise = (augmented(scan, replace(STILL, jitter=0.1)).points - scan.points)[:, :3]
    np.testing.assert_allclose(noise.std(axis=0), 0.1, rtol=0.05)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=0.01)
    assert abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.1


def test_with_everything_off_the_scan_is_as_it_was(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    assert np.array_equal(augmented(scan, STILL).points, scan.points)


def test_labels_intensity_ring_and_name_stay(random_scan: RandomScan) -> None:
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


def test_lost_points_stay_lost_and_in_their_place(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    scan.points[7, 0] = math.nan
    assert np.flatnonzero(~augmented(scan, AugmentConfig()).valid).tolist() == [7]


@pytest.mark.parametrize("flip", [0.0, 1.0])
def test_mirroring_both_axes_or_none_keeps_the_winding(
    random_scan: RandomScan, flip: float
) -> None:
    scan = random_scan(2)
    changed = augmented(scan, replace(STILL, flip=flip, yaw=180.0))
    assert winding(changed) == pytest.approx(winding(scan), rel=1e-4)


def test_lost_points_take_their_labels_and_rings_with_them(random_scan: RandomScan) -> None:
    scan, shares = random_scan(1000), []
    place = {tuple(row): i for i, row in enumerate(scan.points.tolist())}
    for seed in range(30):
        left = augmented(scan, replace(STILL, drop=0.4), seed)
        kept = [place[tuple(row)] for row in left.points.tolist()]
        assert kept == sorted(kept)
        assert scan.labels is not None
        assert scan.ring is not None
        assert np.array_equal(left.labels, scan.labels[kept])
        assert np.array_equal(left.ring, scan.ring[kept])
        shares.append(1 - len(kept) / len(scan))
    assert min(shares) < 0.1
    assert 0.3 < max(shares) < 0.45


def test_a_lone_point_is_never_lost(random_scan: RandomScan) -> None:
    assert all(
        len(augmented(random_scan(1), replace(STILL, drop=0.99), seed)) == 1 for seed in range(50)
    )


def test_a_lift_is_one_height_within_its_limits(random_scan: RandomScan) -> None:
    scan, lifts = random_scan(50), []
    for seed in range(30):
        change = augmented(scan, replace(STILL, height=0.5), seed).points - scan.points
        assert (change[:, [0, 1, 3]] == 0).all()
        np.testing.assert_allclose(change[:, 2], change[0, 2], atol=1e-5)
        lifts.append(change[0, 2])
    assert -0.5 <= min(lifts) < -0.3
    assert 0.3 < max(lifts) <= 0.5


def test_intensity_is_scaled_by_one_factor_and_stays_at_most_one(random_scan: RandomScan) -> None:
    scan, gains = random_scan(50), []
    for seed in range(30):
        changed = augmented(scan, replace(STILL, intensity=0.5), seed).points
        assert np.array_equal(changed[:, :3], scan.points[:, :3])
        gain = changed[:, 3].min() / scan.points[:, 3].min()
        np.testing.assert_allclose(
            changed[:, 3], np.minimum(scan.points[:, 3] * gain, 1), rtol=1e-5
        )
        gains.append(gain)
    assert 0.5 <= min(gains) < 0.7
    assert 1.3 < max(gains) <= 1.5


def test_some_scans_have_no_intensity(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    sums = [
        augmented(scan, replace(STILL, no_intensity=0.3), seed).points[:, 3].sum()
        for seed in range(100)
    ]
    assert set(np.round(sums, 3)) == {0, np.round(scan.points[:, 3].sum(), 3)}
    assert 15 < sums.count(0) < 45


def test_a_mixed_scan_is_one_sector_of_another_and_the_rest_of_its_own(
    random_scan: RandomScan,
) -> None:
    scan, other = random_scan(2000, 1), random_scan(1500, 2)
    where = {tuple(row): (s, i) for s in (scan, other) for i, row in enumerate(s.points.tolist())}
    widths = []
    for seed in range(30):
        mixed = mix(scan, other, np.random.default_rng(seed))
        assert mixed.labels is not None
        assert mixed.ring is not None
        drawn = []
        for row, label, ring in zip(mixed.points.tolist(), mixed.labels, mixed.ring, strict=True):
            source, i = where[tuple(row)]
            assert source.labels is not None
            assert source.ring is not None
            assert (label, ring) == (source.labels[i], source.ring[i])
            drawn.append((math.atan2(row[1], row[0]), source is other))
        drawn.sort()
        assert sum(a != b for (_, a), (_, b) in zip(drawn, drawn[1:] + drawn[:1], strict=True)) == 2
        widths.append(sum(foreign for _, foreign in drawn) / len(other))
    assert 0.2 < min(widths) < 0.4
    assert 0.6 < max(widths) < 0.8
