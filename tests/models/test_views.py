"""The two views equal plain loops over the points, also for batches, borders and lost points."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from amvnet import onnx_runner
from amvnet.config.schema import PolarViewConfig, RangeViewConfig
from amvnet.errors import InputError
from amvnet.models.views import range_view
from amvnet.models.views.points import PointBatch
from amvnet.models.views.polar_view import PolarGrid, PolarView
from amvnet.models.views.range_view import RangeImage, RangeView
from amvnet.scan import Scan

from fixtures.commands import not_none

RandomScan = Callable[..., Scan]

SPHERICAL = RangeViewConfig(height=16, width=250, fov_up=10.0, fov_down=-20.0)
BY_RING = replace(SPHERICAL, rows="ring")
POLAR = PolarViewConfig(
    radial=13, angular=17, vertical=5, radius_min=2.0, radius_max=40.0, z_min=-3.0, z_max=2.0
)


def scan_of(*rows: tuple[float, float, float], ring: int = 0) -> Scan:
    intensity = 0.1 * np.arange(1, len(rows) + 1)
    points = np.column_stack([rows, intensity]).astype(np.float32)
    return Scan(points, ring=np.full(len(rows), ring))


def degenerate_scans() -> dict[str, Scan]:
    below_zero = math.nextafter(0.0, -1.0)
    return {
        "one point": scan_of((3, -4, 1)),
        "origin": scan_of((0, 0, 0), (5, 0, 0)),
        "only the origin": scan_of((0, 0, 0)),
        "seam": scan_of(
            (-5, 0.0, 0), (-5, -0.0, 0), (-7, 1e-6, 0), (-7, -1e-6, 0), (-9, below_zero, 0)
        ),
        "straight up and down": scan_of((0, 0, 4), (0, 0, -4)),
        "far away": scan_of((1e3, 2e3, 3e3), (-1e3, 2e2, -3e3)),
        "no point": Scan(np.zeros((0, 4), np.float32), ring=np.zeros(0, np.int64)),
    }


def on_half_metres(scan: Scan) -> Scan:
    """Put points on a grid of 0.5 m: off borders of cells, often equally far, exact in float32."""
    points = scan.points.copy()
    points[:, :3] = np.round(points[:, :3] * 2) / 2 + np.float32(1 / 16)
    return replace(scan, points=points)


def cell_of(share: float, cells: int) -> int:
    return min(max(math.floor(share * cells), 0), cells - 1)


def range_view_by_loop(scan: Scan, c: RangeViewConfig) -> tuple[list[int], list[int], np.ndarray]:
    """Return (P,) pixels, (H * W,) nearest points, (6, H, W) image."""
    pixels = []
    nearest = [-1] * (c.height * c.width)
    least = [math.inf] * len(nearest)
    image = np.zeros((6, c.height, c.width))
    for i, (x, y, z, intensity) in enumerate(scan.points.tolist()):
        degrees = math.degrees(math.atan2(z, math.sqrt(x * x + y * y)))
        row = cell_of((c.fov_up - degrees) / (c.fov_up - c.fov_down), c.height)
        if c.rows == "ring" or (c.rows == "laser" and scan.ring is not None):
            row = c.height - 1 - int(not_none(scan.ring)[i])
        if scan.row is not None and scan.row[i] >= 0:
            row = int(scan.row[i])
        column = cell_of((math.pi - math.atan2(y, x)) / (2 * math.pi), c.width)
        pixel = row * c.width + column
        pixels.append(pixel)

        distance = math.sqrt(x * x + y * y + z * z)
        if distance < c.nearest:
            continue
        if np.float32(distance) < least[pixel]:
            least[pixel] = float(np.float32(distance))
            nearest[pixel] = i
            image[:, row, column] = x, y, z, intensity, distance, 1
    return pixels, nearest, image


def polar_view_by_loop(
    scan: Scan, c: PolarViewConfig
) -> tuple[list[tuple[int, ...]], list[list[float]]]:
    """Return (P,) cells (radius, angle, height) and (P, 9) features."""
    axes = (
        (c.radius_min, c.radius_max, c.radial),
        (-math.pi, math.pi, c.angular),
        (c.z_min, c.z_max, c.vertical),
    )
    cells = []
    features = []
    for x, y, z, intensity in scan.points.tolist():
        polar = (math.hypot(x, y), math.atan2(y, x), z)
        cell = []
        offset = []
        for value, (low, high, count) in zip(polar, axes, strict=True):
            index = cell_of((value - low) / (high - low), count)
            centre = low + (index + 0.5) * (high - low) / count
            cell.append(index)
            offset.append(value - centre)

        cells.append(tuple(cell))
        features.append([*offset, *polar, x, y, intensity])
    return cells, features


def project_to_image(scan: Scan, config: RangeViewConfig = SPHERICAL) -> RangeImage:
    return RangeView(config).project(PointBatch.of([scan]))


def project_to_grid(*scans: Scan) -> PolarGrid:
    return PolarView(POLAR).project(PointBatch.of(scans))


def assert_equals_the_loop(scan: Scan, config: RangeViewConfig) -> None:
    view = project_to_image(scan, config)
    pixels, nearest, image = range_view_by_loop(scan.select(scan.valid), config)

    assert (view.pixel.tolist(), view.nearest.tolist()) == (pixels, nearest)
    np.testing.assert_allclose(view.image[0].numpy(), image, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("config", [SPHERICAL, BY_RING], ids=["elevation", "ring"])
@pytest.mark.parametrize(("count", "seed"), [(20_000, 0), (20_000, 1), (300, 2), (300, 3)])
def test_range_view_equals_a_loop_over_the_points(
    random_scan: RandomScan, config: RangeViewConfig, count: int, seed: int
) -> None:
    assert_equals_the_loop(random_scan(count, seed), config)
    assert_equals_the_loop(on_half_metres(random_scan(5000, 4)), config)  # distances tie
    assert_equals_the_loop(random_scan(2000, 5), RangeViewConfig(rows=config.rows))


@pytest.mark.parametrize("config", [SPHERICAL, BY_RING], ids=["elevation", "ring"])
@pytest.mark.parametrize("case", degenerate_scans())
def test_range_view_equals_a_loop_on_degenerate_scans(case: str, config: RangeViewConfig) -> None:
    assert_equals_the_loop(degenerate_scans()[case], config)


def test_points_outside_the_field_of_view_get_the_border_rows() -> None:
    view = project_to_image(scan_of((1, 0, 5), (1, 0, -5), (0, 0, 1), (0, 0, -1)))
    assert (view.pixel // SPHERICAL.width).tolist() == [0, 15, 0, 15]


def test_azimuth_runs_from_behind_over_left_front_and_right() -> None:
    scan = scan_of((-5, 1e-3, 0), (0, 5, 0), (5, -1e-3, 0), (0, -5, 0), (-5, -1e-3, 0))
    columns = project_to_image(scan).pixel % 250
    assert columns.tolist() == [0, 62, 125, 187, 249]


def test_ring_zero_is_the_last_row() -> None:
    for ring, row in ((0, 15), (15, 0)):
        view = project_to_image(scan_of((5, 0, 0), ring=ring), BY_RING)
        assert view.pixel // BY_RING.width == row


def test_a_batch_of_range_images_equals_one_by_one(random_scan: RandomScan) -> None:
    scans = [
        random_scan(400, 1),
        degenerate_scans()["no point"],
        random_scan(250, 2),
        scan_of((1, 2, 3)),
    ]
    batch = PointBatch.of(scans)
    together = RangeView(BY_RING).project(batch)
    pixels = BY_RING.height * BY_RING.width
    for b, (scan, rows) in enumerate(zip(scans, batch.slices, strict=True)):
        alone = project_to_image(scan, BY_RING)
        assert torch.equal(together.image[b], alone.image[0])
        assert torch.equal(together.pixel[rows] - b * pixels, alone.pixel)

        nearest = together.nearest[b * pixels : (b + 1) * pixels]
        assert torch.equal(torch.where(nearest < 0, -1, nearest - rows.start), alone.nearest)


@pytest.mark.parametrize("steps", [1, -1, 37])
def test_a_yaw_rotation_by_columns_is_a_circular_shift_of_the_range_image(steps: int) -> None:
    rng = np.random.default_rng(6)
    step = 2 * math.pi / 250
    azimuth = math.pi - (rng.integers(0, 250, 3000) + rng.uniform(0.1, 0.9, 3000)) * step
    z = rng.uniform(-3, 1, 3000)
    radius = rng.uniform(5, 40, 3000)

    def image_after(yaw: float) -> torch.Tensor:
        x = radius * np.cos(azimuth + yaw)
        y = radius * np.sin(azimuth + yaw)
        points = np.stack([x, y, z, radius / 40], axis=1)
        return project_to_image(Scan(points.astype(np.float32))).image[0]

    before = image_after(0.0)
    after = image_after(steps * step)
    shifted = before.roll(-steps, dims=2)
    assert torch.equal(after[[2, 3, 5]], shifted[[2, 3, 5]])  # z, intensity, mask
    torch.testing.assert_close(after[4], shifted[4], rtol=1e-5, atol=0)
    assert not torch.equal(before, shifted)


def scores_by_loop(scan: Scan, config: RangeViewConfig, scores: np.ndarray) -> np.ndarray:
    """Return the (P, K) scores of the points, given those of the pixels (K, H, W)."""
    pixels, nearest, image = range_view_by_loop(scan, config)
    expected: list[np.ndarray] = []
    for (x, y, z), pixel in zip(scan.points[:, :3].tolist(), pixels, strict=True):
        row, column = divmod(pixel, config.width)
        distance = math.sqrt(x * x + y * y + z * z)
        if nearest[pixel] < 0 or abs(image[4, row, column] - distance) <= config.hidden:
            expected.append(scores[:, row, column])
            continue

        total = range_view.OWN_WEIGHT
        summed = total * scores[:, row, column]
        for v in range(max(row - 2, 0), min(row + 3, config.height)):
            for u in (np.arange(column - 2, column + 3) % config.width).tolist():
                if image[5, v, u]:
                    weight = math.exp(-(((image[4, v, u] - distance) / config.hidden) ** 2))
                    summed += weight * scores[:, v, u]
                    total += weight
        expected.append(summed / total)
    return np.array(expected)


@pytest.mark.parametrize("nearest", [0.0, 8.0], ids=["all points", "without the car's own body"])
def test_hidden_points_get_scores_of_their_range(random_scan: RandomScan, nearest: float) -> None:
    config = replace(SPHERICAL, width=60, hidden=2.0, nearest=nearest)
    scans = [random_scan(900, 1), random_scan(700, 2)]
    view = RangeView(config).project(PointBatch.of(scans))
    scores = torch.rand(2, 3, 16, 60, generator=torch.Generator().manual_seed(0))

    given = view.to_points(scores)

    expected = [scores_by_loop(scan, config, scores[i].numpy()) for i, scan in enumerate(scans)]
    np.testing.assert_allclose(given.numpy(), np.concatenate(expected), rtol=1e-3, atol=1e-5)
    own = replace(view, hidden=0.0).to_points(scores)
    assert 0.2 < (given != own).any(dim=1).float().mean() < 0.8
    start = 0
    for i, scan in enumerate(scans):
        part = slice(start, start + len(scan))
        start += len(scan)
        image, pixel = onnx_runner.range_image(config, scan)
        by_pixel = scores[i].permute(1, 2, 0).flatten(0, 1).numpy()
        distance = onnx_runner.distances(scan.points)
        alone = onnx_runner.scores_of_points(config, image, pixel, distance, by_pixel)
        np.testing.assert_allclose(alone, given[part].numpy(), rtol=1e-4, atol=1e-6)


def test_a_wall_behind_a_pole_gets_the_scores_of_the_wall() -> None:
    config = replace(SPHERICAL, hidden=0.5)
    step = 2 * math.pi / config.width
    wall = [(20 * math.cos(i * step), 20 * math.sin(i * step), 0.0) for i in (-1.5, -0.5, 0.5)]
    x, y, z = wall[1]
    view = project_to_image(scan_of(*wall, (x / 4, y / 4, z)), config)
    shows_wall = (view.image[:, 4:5] > 10).float()

    scores = view.to_points(torch.cat([shows_wall, 1 - shows_wall], dim=1))

    assert shows_wall.sum() == 2
    torch.testing.assert_close(scores[:3, 0], torch.ones(3), rtol=0, atol=1e-3)
    assert scores[3].tolist() == [0, 1]


@pytest.mark.parametrize("case", degenerate_scans())
def test_without_hidden_points_all_have_the_scores_of_their_pixels(case: str) -> None:
    view = project_to_image(degenerate_scans()[case], replace(SPHERICAL, hidden=1000))
    scores = torch.rand(1, 3, 16, 250)
    assert torch.equal(view.to_points(scores), replace(view, hidden=0.0).to_points(scores))


@pytest.mark.parametrize("ring", [16, 1000])
def test_a_ring_out_of_range_or_none_is_an_input_error(ring: int) -> None:
    with pytest.raises(InputError, match=f"0 to 15, found {ring}"):
        project_to_image(scan_of((1, 0, 0), ring=ring), BY_RING)
    with pytest.raises(InputError, match="ring index, found none"):
        project_to_image(Scan(np.ones((3, 4), np.float32)), BY_RING)


@pytest.mark.parametrize("rows", ["elevation", "laser", "ring"])
def test_rows_and_lasers_are_taken_where_they_are_known(rows: Any, random_scan: RandomScan) -> None:
    config = replace(BY_RING, rows=rows)
    scan = random_scan(400)
    assert not_none(scan.ring).max() < config.height
    assert_equals_the_loop(scan, config)

    row = np.random.default_rng(0).integers(0, config.height, len(scan))
    assert_equals_the_loop(replace(scan, row=row), config)
    row[::3] = -1
    assert_equals_the_loop(replace(scan, row=row), config)


def test_rows_are_lasers_only_of_a_sensor_with_a_laser_for_each_row() -> None:
    scan = scan_of(*[(10, y, y / 5) for y in range(-8, 8)])
    view = RangeView(replace(BY_RING, rows="laser"))
    by_elevation = view.rows(PointBatch.of([scan]))
    for highest, counts in ((15, True), (12, True), (11, False), (7, False), (16, False)):
        ring = np.arange(16) * highest // 15
        rows = view.rows(PointBatch.of([replace(scan, ring=ring)]))
        expected = torch.from_numpy(15 - ring) if counts else by_elevation
        assert torch.equal(rows, expected)

    # In a batch each scan counts for itself.
    ring = np.arange(16)
    rows = view.rows(PointBatch.of([scan, replace(scan, ring=ring), replace(scan, ring=ring // 2)]))
    expected = torch.cat([by_elevation, torch.from_numpy(15 - ring), by_elevation])
    assert torch.equal(rows, expected)


def assert_polar_equals_the_loop(scan: Scan) -> None:
    grid = project_to_grid(scan)
    cells, features = polar_view_by_loop(scan.select(scan.valid), POLAR)
    radius, angle, voxel = np.reshape(np.array(cells, np.int64), (-1, 3)).T
    pillars = radius * 17 + angle
    assert grid.occupied[grid.slot].tolist() == pillars.tolist()
    assert grid.voxel.tolist() == voxel.tolist()

    expected = np.reshape(features, (-1, 9))
    np.testing.assert_allclose(grid.features.numpy(), expected, rtol=1e-6, atol=1e-5)
    assert grid.occupied.tolist() == sorted(set(pillars.tolist()))


@pytest.mark.parametrize(("count", "seed"), [(20_000, 0), (300, 1), (300, 2)])
def test_polar_view_equals_a_loop_by_point(random_scan: RandomScan, count: int, seed: int) -> None:
    assert_polar_equals_the_loop(random_scan(count, seed))


@pytest.mark.parametrize("case", degenerate_scans())
def test_polar_view_equals_a_loop_on_degenerate_scans(case: str) -> None:
    assert_polar_equals_the_loop(degenerate_scans()[case])


def test_points_outside_the_polar_grid_go_to_the_nearest_cell() -> None:
    scan = scan_of((0.5, 0, 0), (100, 0, 0), (10, 0, -50), (10, 0, 50), (-10, 0.0, 0))
    grid = project_to_grid(scan)

    pillars = [0 * 17 + 8, 12 * 17 + 8, 2 * 17 + 8, 2 * 17 + 8, 2 * 17 + 16]
    assert grid.occupied[grid.slot].tolist() == pillars
    assert grid.voxel.tolist() == [3, 3, 0, 4, 3]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_pool_is_the_maximum_over_each_pillar_whose_gradient_equal_values_share(
    random_scan: RandomScan, dtype: torch.dtype
) -> None:
    grid = project_to_grid(random_scan(400, 1), random_scan(300, 2))
    # A few different values, so that many are equal, and negative, so that a wrong 0 shows.
    features = torch.randint(-3, 0, (700, 3)).to(dtype).requires_grad_()
    pooled = grid.pool(features)
    factors = torch.randn_like(pooled)
    (pooled * factors).sum().backward()

    expected = torch.zeros_like(features)
    for slot, factor in enumerate(factors):
        of_pillar = grid.slot == slot
        largest = features[of_pillar].amax(dim=0)
        assert torch.equal(pooled[slot], largest)
        is_largest = (features == largest) & of_pillar[:, None]
        expected += is_largest * (factor / is_largest.sum(dim=0))
    torch.testing.assert_close(features.grad, expected)


@pytest.mark.parametrize("part", [1, 100, 1000])
def test_pooling_by_parts_is_pooling_of_all(random_scan: RandomScan, part: int) -> None:
    grid = project_to_grid(random_scan(400, 1), random_scan(300, 2))
    pooled = grid.pool_by_parts(lambda x: 2 * x[:, :5] - 30, part)
    assert torch.equal(pooled, grid.pool(2 * grid.features[:, :5] - 30))


def test_maps_hold_pillars_where_they_belong_and_zero_elsewhere(random_scan: RandomScan) -> None:
    grid = project_to_grid(random_scan(100, 1), random_scan(100, 2))
    pillars = torch.randn(len(grid.occupied), 3)
    expected = torch.zeros(2, 3, 13, 17)
    for values, pillar in zip(pillars, grid.occupied.tolist(), strict=True):
        expected[pillar // (13 * 17), :, pillar // 17 % 13, pillar % 17] = values

    assert torch.equal(grid.to_map(pillars), expected)
    assert torch.equal(grid.at_pillars(expected), pillars)
    assert (expected == 0).all(dim=1).any()


def test_a_batch_of_polar_grids_equals_one_by_one(random_scan: RandomScan) -> None:
    scans = [random_scan(200, 1), degenerate_scans()["no point"], random_scan(150, 2)]
    slices = PointBatch.of(scans).slices
    together = project_to_grid(*scans)
    maps = together.to_map(together.pool(together.features))

    pillars = together.occupied[together.slot]
    for b, (scan, rows) in enumerate(zip(scans, slices, strict=True)):
        alone = project_to_grid(scan)
        assert torch.equal(together.features[rows], alone.features)
        assert torch.equal(pillars[rows] - b * 13 * 17, alone.occupied[alone.slot])
        assert torch.equal(together.voxel[rows], alone.voxel)
        assert torch.equal(maps[b], alone.to_map(alone.pool(alone.features))[0])


@pytest.mark.parametrize("lost", [math.nan, math.inf, -math.inf])
def test_a_point_batch_leaves_lost_points_out(random_scan: RandomScan, lost: float) -> None:
    scan = random_scan(10, 1)
    for row, column in ((2, 0), (5, 1), (9, 2)):
        scan.points[row, column] = lost

    valid = [0, 1, 3, 4, 6, 7, 8]
    batch = PointBatch.of([scan])
    assert batch.points.tolist() == scan.points[valid].tolist()
    assert not_none(batch.ring).tolist() == not_none(scan.ring)[valid].tolist()


def test_rings_and_rows_that_a_scan_of_a_batch_lacks_are_minus_one(random_scan: RandomScan) -> None:
    scan = random_scan(4)
    without = replace(scan, ring=None)
    batch = PointBatch.of([scan, without, replace(without, row=np.arange(4))])
    assert not_none(batch.ring).tolist() == [*not_none(scan.ring).tolist(), *[-1] * 8]
    assert not_none(batch.row).tolist() == [*[-1] * 8, 0, 1, 2, 3]
    assert PointBatch.of([without]).ring is None
    assert PointBatch.of([scan]).row is None


def test_views_without_the_own_body_are_of_the_other_points(random_scan: RandomScan) -> None:
    scans = [random_scan(1500, 6), random_scan(900, 7)]
    others = []
    is_far = []
    for scan in scans:
        far = np.linalg.norm(scan.points[:, :3], axis=1) >= 15
        others.append(Scan(scan.points[far]))
        is_far.append(far)
    far_points = torch.from_numpy(np.concatenate(is_far))
    assert 0 < far_points.sum() < len(far_points)

    whole = PointBatch.of(scans)
    rest = PointBatch.of(others)
    image = RangeView(replace(SPHERICAL, nearest=15.0)).project(whole)
    assert torch.equal(image.image, RangeView(SPHERICAL).project(rest).image)

    grid = PolarView(replace(POLAR, nearest=15.0)).project(whole)
    expected = PolarView(POLAR).project(rest)
    assert torch.equal(grid.features, expected.features)
    maps = grid.to_map(grid.pool(grid.features))
    assert torch.equal(maps, expected.to_map(expected.pool(expected.features)))
    assert torch.equal(grid.pool_by_parts(lambda x: x, 100), grid.pool(grid.features))

    # Every point has the scores of its cell; far points those that they had without the near ones.
    scores = torch.randn(2, POLAR.vertical * 3, POLAR.radial, POLAR.angular)
    points = grid.to_points(grid.at_pillars(scores))
    assert points.shape == (len(far_points), 3)
    assert torch.equal(points[far_points], expected.to_points(expected.at_pillars(scores)))


def test_a_point_exactly_at_the_least_distance_is_seen() -> None:
    """The vehicle's own body is nearer than this."""
    own_body = float(np.nextafter(np.float32(5), np.float32(0)))
    batch = PointBatch.of([scan_of((5, 0, 0), (-own_body, 0, 0))])
    image = RangeView(replace(SPHERICAL, nearest=5.0)).project(batch)
    assert image.nearest[image.nearest >= 0].tolist() == [0]
    grid = PolarView(replace(POLAR, nearest=5.0)).project(batch)
    assert len(grid.features) == len(grid.seen) == 1


def test_points_at_the_borders_of_cells_have_the_cells_of_double_precision() -> None:
    rng = np.random.default_rng(0)
    columns = math.pi * (1 - 2 * np.arange(SPHERICAL.width) / SPHERICAL.width)
    sectors = math.pi * (2 * np.arange(POLAR.angular) / POLAR.angular - 1)
    azimuth = np.repeat(np.concatenate([columns, sectors]), 20)
    distance = rng.uniform(3, 39, len(azimuth))
    x = distance * np.cos(azimuth)
    y = distance * np.sin(azimuth)
    xyz = np.stack([x, y, rng.uniform(-3, 2, len(x))], axis=1).astype(np.float32)
    scan = Scan(np.column_stack([xyz, np.full(len(x), 0.5)]).astype(np.float32))

    pixels, _, _ = range_view_by_loop(scan, SPHERICAL)
    cells, _ = polar_view_by_loop(scan, POLAR)
    assert project_to_image(scan).pixel.tolist() == pixels
    grid = project_to_grid(scan)
    assert grid.occupied[grid.slot].tolist() == [r * POLAR.angular + a for r, a, _ in cells]

    # In single precision, other cells would come out.
    shares = 0.5 - np.arctan2(xyz[:, 1], xyz[:, 0]) / np.float32(2 * math.pi)
    single = np.floor(shares * np.float32(SPHERICAL.width)).clip(0, SPHERICAL.width - 1)
    assert (single != np.array(pixels) % SPHERICAL.width).any()
