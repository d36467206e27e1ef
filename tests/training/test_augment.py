"""Augmentation is seeded, keeps distances up to a factor, and changes only what is switched on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from amvnet.config.schema import AugmentConfig
from amvnet.scan import Scan, yaw_rotation
from amvnet.training.augment import (
    ELEVATION_BINS,
    augment,
    lasers,
    mix,
    mix_lasers,
    paste,
    tilt_rotation,
)

from fixtures.commands import not_none

RandomScan = Callable[..., Scan]
OFF = AugmentConfig(scale=0.0, flip=0.0, jitter=0.0, yaw=0.0)


def augmented(scan: Scan, config: AugmentConfig, seed: int = 0) -> Scan:
    return augment(scan, config, np.random.default_rng(seed))


def distances(scan: Scan) -> np.ndarray:
    return np.array([math.hypot(*row[:3]) for row in scan.points.tolist()])


def azimuths(scan: Scan) -> np.ndarray:
    return np.array([math.atan2(y, x) for x, y, _, _ in scan.points.tolist()])


def elevations(scan: Scan) -> np.ndarray:
    return np.array([math.atan2(z, math.hypot(x, y)) for x, y, z, _ in scan.points.tolist()])


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


def test_jitter_is_noise_of_its_deviation_on_each_coordinate(random_scan: RandomScan) -> None:
    scan = random_scan(5000)
    noise = (augmented(scan, replace(OFF, jitter=0.1)).points - scan.points)[:, :3]
    np.testing.assert_allclose(noise.std(axis=0), 0.1, rtol=0.05)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=0.01)
    assert abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.1


def test_labels_intensity_ring_name_and_lost_returns_stay(random_scan: RandomScan) -> None:
    scan = replace(random_scan(50), name="somewhere")
    scan.points[7, :3] = math.nan
    before = scan.points.copy()
    np.testing.assert_array_equal(augmented(scan, OFF).points, before)
    changed = augmented(scan, AugmentConfig(flip=1.0))
    np.testing.assert_array_equal(scan.points, before)  # the given scan, too
    assert np.flatnonzero(~changed.valid).tolist() == [7]
    assert np.array_equal(changed.points[:, 3], scan.points[:, 3])
    assert changed.labels is scan.labels
    assert changed.ring is scan.ring
    assert changed.name == "somewhere"
    assert changed.points.dtype == np.float32


def test_points_are_dropped_together_with_their_labels_and_rings(random_scan: RandomScan) -> None:
    scan = random_scan(1000)

    index_of = index_by_point(scan)
    shares = []
    for seed in range(30):
        changed = augmented(scan, replace(OFF, drop=0.4), seed)
        indices = [index_of[tuple(row)] for row in changed.points.tolist()]
        assert indices == sorted(indices)
        assert np.array_equal(not_none(changed.labels), not_none(scan.labels)[indices])
        assert np.array_equal(not_none(changed.ring), not_none(scan.ring)[indices])
        shares.append(1 - len(changed) / len(scan))

    assert min(shares) < 0.1
    assert 0.3 < max(shares) < 0.45


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
        sums.append(augmented(scan, replace(OFF, no_intensity=0.3), seed).points[:, 3].sum())

    assert set(np.round(sums, 3)) == {0, np.round(scan.points[:, 3].sum(), 3)}
    assert 15 < sums.count(0) < 45
    config = replace(OFF, no_intensity=1.0, intensity_offset=0.5)
    assert not augmented(scan, config).points[:, 3].any()


def test_a_mixed_scan_has_one_sector_of_another_scan(random_scan: RandomScan) -> None:
    scan = random_scan(2000, 1)
    other = random_scan(1500, 2)
    shares = []
    for seed in range(30):
        mixed = mix(scan, other, np.random.default_rng(seed))
        is_foreign = from_other_scan(mixed, scan, other)

        around = is_foreign[np.argsort(azimuths(mixed))]
        assert np.count_nonzero(around != np.roll(around, 1)) == 2
        shares.append(is_foreign.sum() / len(other))

    assert 0.2 < min(shares) < 0.4
    assert 0.6 < max(shares) < 0.8


@pytest.mark.full
def test_a_scan_of_mixed_lasers_has_bands_of_elevation_of_both(random_scan: RandomScan) -> None:
    scan = random_scan(2000, 1)
    other = random_scan(1500, 2)
    counts = set()
    for seed in range(30):
        mixed = mix_lasers(scan, other, np.random.default_rng(seed))
        is_foreign = from_other_scan(mixed, scan, other)

        upwards = is_foreign[np.argsort(elevations(mixed))]
        counts.add(1 + np.count_nonzero(upwards[1:] != upwards[:-1]))
        assert 0.1 < is_foreign.sum() / len(other) < 0.9

    assert counts == {3, 4, 5, 6}


@pytest.mark.parametrize("has_own", [(True, True), (True, False), (False, True)])
def test_points_of_the_car_itself_stay_known_in_joined_scans(
    has_own: tuple[bool, bool], random_scan: RandomScan
) -> None:
    def with_own(seed: int, is_known: bool) -> Scan:
        scan = random_scan(200, seed)
        own = np.random.default_rng(seed).random(200) < 0.2
        return replace(scan, own=own if is_known else None, file_xyz=scan.points[:, :3])

    scan, other = with_own(1, has_own[0]), with_own(2, has_own[1])
    own = set()
    for each in (scan, other):
        own |= {tuple(point) for point in each.points[~each.valid].tolist()}
    for join in (mix, mix_lasers):
        joined = join(scan, other, np.random.default_rng(0))
        found = {tuple(point) for point in joined.points[~joined.valid].tolist()}
        assert found == own & set(index_by_point(joined))
        assert joined.file_xyz is None


def test_scans_without_a_common_band_are_not_mixed_to_nothing() -> None:
    high = Scan(np.array([[1, 0, 9, 0.5]], np.float32))
    low = Scan(np.array([[1, 0, -9, 0.5]], np.float32))
    for seed in range(30):
        assert len(mix_lasers(high, low, np.random.default_rng(seed))) > 0


def test_objects_are_pasted_at_their_place_turned_once_or_twice(random_scan: RandomScan) -> None:
    scan = random_scan(200, 1)
    other = random_scan(100, 2)
    assert scan.labels is not None
    assert other.labels is not None

    classes = np.unique(other.labels)[1:3]
    is_object = np.isin(other.labels, classes)
    count = is_object.sum()
    assert 0 < count < len(other)

    copies = set()
    for seed in range(20):
        pasted = paste(scan, other, classes.tolist(), np.random.default_rng(seed))
        assert np.array_equal(pasted.points[: len(scan)], scan.points)
        added = pasted.points[len(scan) :].reshape(-1, count, 4)
        assert np.array_equal(added[0], other.points[is_object])
        copies.add(len(added) - 1)

        # The copies keep their range, height and intensity.
        radius = np.hypot(added[:, :, 0], added[:, :, 1])
        np.testing.assert_allclose(radius[1:] - radius[0], 0, atol=1e-4)
        assert (added[:, :, 2:] == added[0, :, 2:]).all()
        assert not np.allclose(added[1], added[0])

        assert pasted.labels is not None
        times = len(added)
        assert np.array_equal(pasted.labels[len(scan) :], np.tile(other.labels[is_object], times))
        assert len(not_none(pasted.ring)) == len(pasted)

    assert copies == {1, 2}


def test_tilting_keeps_distances_and_the_vertical_within_limits(random_scan: RandomScan) -> None:
    scan = random_scan(50)
    scan.points[0] = (0, 0, 10, 0.5)
    rolls = []
    pitches = []
    for seed in range(40):
        changed = augmented(scan, replace(OFF, tilt=3.0), seed)
        np.testing.assert_allclose(distances(changed), distances(scan), rtol=1e-5)
        x, y, z, _ = changed.points[0].tolist()
        rolls.append(math.degrees(math.asin(y / 10)))
        pitches.append(math.degrees(math.atan2(x, z)))

    for angles in (rolls, pitches):
        assert -3 <= min(angles) < -1.5
        assert 1.5 < max(angles) <= 3


def test_a_roll_lifts_the_left_and_a_pitch_lowers_the_front() -> None:
    quarter = math.pi / 2
    np.testing.assert_allclose(tilt_rotation(quarter, 0) @ [0, 1, 0], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(tilt_rotation(0, quarter) @ [1, 0, 0], [0, 0, -1], atol=1e-12)
    # First about x, then about y.
    both = tilt_rotation(quarter, quarter)
    np.testing.assert_allclose(both @ [0, 1, 0], [1, 0, 0], atol=1e-12)


@pytest.mark.parametrize("change", ["intensity_offset", "intensity_gamma"])
def test_a_changed_intensity_stays_from_0_to_1_alone(random_scan: RandomScan, change: str) -> None:
    scan = random_scan(500)
    for seed in range(20):
        changed = augmented(scan, replace(OFF, **{change: 0.9}), seed)
        assert np.array_equal(changed.points[:, :3], scan.points[:, :3])
        assert not np.array_equal(changed.points[:, 3], scan.points[:, 3])
        assert changed.points[:, 3].min() >= 0
        assert changed.points[:, 3].max() <= 1


def test_an_offset_and_an_exponent_are_those_of_the_whole_scan(random_scan: RandomScan) -> None:
    scan = random_scan(500)
    scan.points[:, 3] = np.linspace(0.3, 0.7, 500)
    intensity = scan.points[:, 3]
    offsets = []
    exponents = []
    for seed in range(30):
        shifted = augmented(scan, replace(OFF, intensity_offset=0.2), seed).points[:, 3]
        np.testing.assert_allclose(shifted - intensity, shifted[0] - intensity[0], atol=1e-6)
        offsets.append(shifted[0] - intensity[0])

        bent = augmented(scan, replace(OFF, intensity_gamma=0.5), seed).points[:, 3]
        ratio = np.log(bent) / np.log(intensity)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)
        exponents.append(math.log(ratio[0]))

    assert -0.2 <= min(offsets) < -0.1
    assert 0.1 < max(offsets) <= 0.2
    assert -0.5 <= min(exponents) < -0.25
    assert 0.25 < max(exponents) <= 0.5 + 1e-4


def test_every_laser_is_dimmed_by_one_factor_of_its_own(random_scan: RandomScan) -> None:
    scan = random_scan(2000)
    assert scan.ring is not None
    scan.points[:, 3] = np.random.default_rng(0).uniform(0.1, 0.6, len(scan))
    gains = augmented(scan, replace(OFF, laser_gain=0.4)).points[:, 3] / scan.points[:, 3]

    factors = []
    for ring in np.unique(scan.ring):
        of_ring = gains[scan.ring == ring]
        np.testing.assert_allclose(of_ring, of_ring[0], rtol=1e-5)
        factors.append(of_ring[0])
    assert 0.6 <= min(factors) < max(factors) <= 1.4
    assert len(np.unique(np.round(factors, 4))) > len(factors) / 2

    scan.points[:, 3] = 0.9
    assert augmented(scan, replace(OFF, laser_gain=0.4)).points[:, 3].max() == 1


def test_lasers_without_rings_are_bins_of_elevation(random_scan: RandomScan) -> None:
    scan = replace(random_scan(5000), ring=None)
    scan.points[3, 0] = math.nan
    bins = lasers(scan)
    assert (bins.min(), bins.max()) == (0, ELEVATION_BINS - 1)

    valid = scan.valid
    order = np.argsort(elevations(scan)[valid])
    assert (np.diff(bins[valid][order]) >= 0).all()


def test_whole_lasers_are_dropped_every_second_or_at_random(random_scan: RandomScan) -> None:
    scan = random_scan(3000)
    assert scan.ring is not None
    all_rings = range(scan.ring.max() + 1)
    halves = [set(all_rings[::2]), set(all_rings[1::2])]
    second = 0
    shares = []
    for seed in range(60):
        changed = augmented(scan, replace(OFF, laser_drop=1.0), seed)
        rings = set(not_none(changed.ring).tolist())
        assert len(changed) == np.isin(scan.ring, list(rings)).sum()

        is_every_second = rings in halves
        second += is_every_second
        if not is_every_second:
            shares.append(1 - len(rings) / len(all_rings))

    assert 15 < second < 45
    assert min(shares) < 0.15
    assert 0.3 < max(shares) < 0.9


@pytest.mark.full
def test_dropped_blocks_are_rectangles_of_azimuth_and_elevation(random_scan: RandomScan) -> None:
    scan = random_scan(4000)
    index_of = index_by_point(scan)
    shares = []
    for seed in range(30):
        changed = augmented(scan, replace(OFF, block_drop=1.0), seed)
        kept = [index_of[tuple(row)] for row in changed.points.tolist()]
        is_lost = np.ones(len(scan), bool)
        is_lost[kept] = False
        shares.append(is_lost.mean())

        # Most of the neighbours of a lost point are lost, too.
        angles = np.stack([azimuths(scan) * np.cos(elevations(scan)), elevations(scan)], axis=1)
        if is_lost.sum() > 50:
            distance = np.abs(angles[is_lost][:, None] - angles[None]).max(axis=2)
            nearest = np.argsort(distance, axis=1)[:, :12]
            assert is_lost[nearest].mean() > 0.5

    assert 0 < np.mean(shares) < 0.2
    assert max(shares) < 0.5


@pytest.mark.parametrize("drop", ["laser_drop", "block_drop"])
def test_what_is_dropped_at_random_leaves_other_scans(random_scan: RandomScan, drop: str) -> None:
    scan = random_scan(3000)
    scan.points[:, :3] *= 80 / np.median(distances(scan))
    whole = 0
    for seed in range(60):
        whole += len(augmented(scan, replace(OFF, **{drop: 0.3}), seed)) == len(scan)
    assert 30 < whole < 58


def test_a_scan_of_one_point_outlasts_every_kind_of_drop() -> None:
    scan = Scan(np.array([[90, 0, 1, 0.5]], np.float32), ring=np.zeros(1, np.int64))
    config = replace(OFF, laser_drop=1.0, block_drop=1.0, drop=0.9)
    for seed in range(30):
        assert len(augmented(scan, config, seed)) == 1


def test_what_is_off_takes_no_random_numbers(random_scan: RandomScan) -> None:
    """A seed gives the same scan as before there were these kinds of augmentation."""
    scan = random_scan(50)
    rng = np.random.default_rng(3)
    changed = augment(scan, AugmentConfig(drop=0.2, intensity=0.1), rng)

    expected = np.random.default_rng(3)
    expected.random(len(scan))
    expected.uniform(0, 0.2)
    expected.uniform(-0.05, 0.05)
    expected.random(2)
    expected.standard_normal((len(changed), 3), dtype=np.float32)
    expected.uniform(-180, 180)
    expected.uniform(0, 0)
    expected.random()
    expected.uniform(-0.1, 0.1)
    assert rng.bit_generator.state == expected.bit_generator.state


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

        assert label == not_none(source.labels)[index]
        assert ring == not_none(source.ring)[index]
    return np.array(is_foreign)


def test_lost_returns_and_other_classes_are_not_pasted(random_scan: RandomScan) -> None:
    scan = random_scan(50, seed=0)
    other = random_scan(60, seed=1)
    points = other.points.copy()
    points[::3, :3] = np.nan
    labels = np.ones(len(other), np.uint8)
    pasted = paste(scan, Scan(points, labels, other.ring), [1], np.random.default_rng(0))
    assert pasted.valid[len(scan) :].all()
    assert (len(pasted) - len(scan)) % 40 == 0
    assert np.array_equal(paste(scan, other, [], np.random.default_rng(0)).points, scan.points)
