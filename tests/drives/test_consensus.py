"""The consensus of a drive equals its formula, in a plain loop."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pytest

from amvnet.drives.consensus import (
    LEAST,
    OWN,
    SIZE,
    Consensus,
    DriveScan,
    VoxelTable,
    index_of,
    keys_of,
)

CLASSES = 8
STEP = 1 / 16  # log scores and weights are whole numbers of these steps


def random_drive(scans: int, seed: int = 0, count: int = 60) -> list[DriveScan[int]]:
    """Return scans of the same random places, from a car that drives and turns."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-2, 2, (count, 3))
    drive = []
    for index in range(scans):
        angle = 0.1 * index
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = [500_000 + 1.03 * index, 5_000_000, 3]  # metres, as in UTM
        world = places + rng.normal(0, 0.05, places.shape) + [500_000, 5_000_000, 3]
        xyz = (world - pose[:3, 3]) @ pose[:3, :3]
        scores = rng.dirichlet(np.full(CLASSES, 0.3), count)
        scores[rng.random(count) < 0.1] = 0
        scores[rng.random(count) < 0.1] = 1 / CLASSES  # of the least weight
        drive.append(DriveScan(index, xyz, scores, pose))
    return drive


def voxel_of(scan: DriveScan[int], point: int, size: float) -> tuple[int, ...]:
    world = scan.pose[:3, :3] @ scan.xyz[point] + scan.pose[:3, 3]
    return tuple(np.floor(world / size).astype(int))


def expected(drive: Sequence[DriveScan[int]], consensus: Consensus) -> Iterator[np.ndarray]:
    """Yield the fused probabilities by the formula of `Consensus`, point by point."""
    for current in range(len(drive)):
        reach = drive[max(current - consensus.reach, 0) : current + consensus.ahead + 1]
        votes: dict[tuple[float, tuple[int, ...]], list[tuple[float, np.ndarray]]] = {}
        for scan in reach:
            for point, scores in enumerate(scan.scores):
                if scores.any():
                    logs = np.log(np.maximum(scores, LEAST))
                    weight = max(np.round(scores.max() ** 2 / STEP), 1) * STEP
                    vote = (weight, np.round(logs / STEP) * STEP)
                    for size in (SIZE, 2 * SIZE):
                        votes.setdefault((size, voxel_of(scan, point, size)), []).append(vote)

        fused = np.zeros((len(drive[current].xyz), CLASSES))
        for point, scores in enumerate(drive[current].scores):
            if not scores.any():
                continue
            logs = OWN * np.log(np.maximum(scores, LEAST))
            for size in (SIZE, 2 * SIZE):
                of_voxel = votes[size, voxel_of(drive[current], point, size)]
                total = sum(weight for weight, _ in of_voxel)
                mean = sum(weight * values for weight, values in of_voxel) / total
                logs = logs + (1 - OWN) / 2 * mean
            fused[point] = np.exp(logs) / np.exp(logs).sum()
        yield fused


@pytest.mark.parametrize("past_only", [False, True])
@pytest.mark.parametrize(("scans", "reach"), [(1, 3), (2, 3), (9, 2), (5, 9)])
def test_the_consensus_equals_its_formula(scans: int, reach: int, past_only: bool) -> None:
    drive = random_drive(scans)
    consensus = Consensus(reach=reach, past_only=past_only)
    results = list(consensus.stream(drive))
    assert [item for item, _ in results] == list(range(scans))
    for (_, fused), reference in zip(results, expected(drive, consensus), strict=True):
        np.testing.assert_allclose(fused, reference, atol=1e-5)


def test_a_second_drive_and_scores_that_do_not_add_up_to_1_change_nothing() -> None:
    drive = random_drive(5)
    consensus = Consensus(reach=2)
    first = list(consensus.stream(drive))
    scaled = [replace(scan, scores=scan.scores * (2 + scan.item)) for scan in drive]
    for (_, fused), (_, again) in zip(first, consensus.stream(scaled), strict=True):
        np.testing.assert_allclose(again, fused, atol=1e-5)


def test_a_scan_follows_when_the_scans_after_it_are_read() -> None:
    read: list[int] = []

    def scans() -> Iterator[DriveScan[int]]:
        for scan in random_drive(6):
            read.append(scan.item)
            yield scan

    ahead = [(item, len(read)) for item, _ in Consensus(reach=2).stream(scans())]
    assert ahead == [(0, 3), (1, 4), (2, 5), (3, 6), (4, 6), (5, 6)]
    read.clear()
    at_once = [(item, len(read)) for item, _ in Consensus(past_only=True).stream(scans())]
    assert at_once == [(index, index + 1) for index in range(6)]


def test_scans_out_of_reach_leave_nothing_behind_to_the_bit() -> None:
    """A run that is resumed begins with the scans in reach, and computes the same."""
    drive = random_drive(12)
    whole = dict(Consensus(reach=2).stream(drive))
    rest = dict(Consensus(reach=2).stream(drive[4:]))
    for item in range(6, 12):
        np.testing.assert_array_equal(rest[item], whole[item])


def test_the_memory_depends_on_the_reach_and_not_on_the_length_of_the_drive() -> None:
    """Each scan sees 60 places that no other scan sees; five scans are in reach."""
    drive = random_drive(40)
    for scan in drive:
        scan.pose[0, 3] += 100 * scan.item
    consensus = Consensus(reach=2)
    for _ in consensus.stream(drive):
        assert all(len(table._sums) <= 1.5 * 6 * 60 for table in consensus._tables)


def test_a_scan_alone_keeps_the_labels_of_points_with_a_voxel_of_their_own() -> None:
    rng = np.random.default_rng(1)
    xyz = np.arange(30)[:, None] * np.array([2.0, 0, 0])
    scores = rng.dirichlet(np.ones(CLASSES), 30)
    ((_, fused),) = Consensus().stream([DriveScan(0, xyz, scores, np.eye(4))])
    np.testing.assert_array_equal(fused.argmax(axis=1), scores.argmax(axis=1))


def test_keys_tell_voxels_apart_and_give_their_places() -> None:
    index = np.random.default_rng(2).integers(-(2**20), 2**20, (1000, 3))
    np.testing.assert_array_equal(index_of(keys_of(index)), index)


def test_a_table_adds_and_removes_like_a_dictionary() -> None:
    rng = np.random.default_rng(3)
    table = VoxelTable(3)
    added: list[tuple[np.ndarray, np.ndarray]] = []
    sums: dict[int, np.ndarray] = {}
    for _ in range(60):
        if added and rng.random() < 0.4:
            keys, values = added.pop(0)
            table.remove(keys, values)
            sign = -1
        else:
            keys = np.unique(rng.integers(0, 50, 20))
            values = rng.integers(1, 9, (len(keys), 3)).astype(np.float32)
            added.append((keys, values))
            table.add(keys, values)
            sign = 1
        for key, row in zip(keys.tolist(), values, strict=True):
            sums[key] = sums.get(key, np.zeros(3)) + sign * row

        keys, values, scans = table.contents()
        seen = {key for of_scan, _ in added for key in of_scan.tolist()}
        assert keys.tolist() == sorted(seen)
        for key, row, count in zip(keys.tolist(), values, scans, strict=True):
            np.testing.assert_array_equal(row, sums[key])
            assert count == sum(key in of_scan for of_scan, _ in added)
