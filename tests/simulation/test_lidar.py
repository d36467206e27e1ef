"""The simulated LiDAR: what a scene that can be worked out by hand must look like to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amvnet.simulation import SENSORS
from amvnet.simulation.materials import REFLECTIONS, Label, Surface
from amvnet.simulation.mesh import Mesh, box, hull, join, part, place, tinted
from amvnet.simulation.sensors import Sensor

pytest.importorskip("embreex")
from amvnet.simulation.lidar import RayScene, trace
from amvnet.simulation.returns import laser_gains, receive

HDL64E = SENSORS["hdl64e"]
# Nothing left to chance but what a test asks for.
EXACT = replace(HDL64E, range_noise=0.0, drop=0.0, mixed=0.0, gain_spread=0.0, decimals=6, turn=0.0)


class Plain:
    """Ground that is road everywhere."""

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.full(len(x), Label.ROAD, dtype=np.uint16)

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        return np.zeros(len(x), dtype=np.float32)


def scanned(
    mesh: Mesh,
    sensor: Sensor = EXACT,
    pose: np.ndarray | None = None,
    speed: float = 0.0,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    hits = trace([RayScene(mesh)], sensor, np.eye(4) if pose is None else pose, Plain(), rng, speed)
    return receive(hits, sensor, laser_gains(sensor, rng), rng)


def wall(x: float, y: tuple[float, float] = (-30, 30), surface: Surface = Surface.PLASTER) -> Mesh:
    """A wall across the sensor's axis, 20 m high."""
    a, b = y
    corners = np.array(
        [[[x, a, -10], [x, b, -10], [x, b, 10]], [[x, a, -10], [x, b, 10], [x, a, 10]]]
    )
    return part(corners, surface, Label.BUILDING)


@pytest.fixture(scope="module")
def ground() -> tuple[np.ndarray, np.ndarray]:
    """Points and rings of a plane below the sensor."""
    far = 500.0
    corners = [
        [[-far, -far, 0], [far, -far, 0], [far, far, 0]],
        [[-far, -far, 0], [far, far, 0], [-far, far, 0]],
    ]
    pose = np.eye(4)
    pose[:3, 3] = (3.0, -2.0, HDL64E.height)
    points, labels, ring = scanned(
        part(np.array(corners), Surface.GRASS, 0), replace(HDL64E, turn=0.0), pose
    )
    assert (labels == Label.ROAD).all()
    return points, ring


def test_flat_ground_has_the_ranges_of_the_textbook(ground: tuple[np.ndarray, np.ndarray]) -> None:
    points, ring = ground
    distance = np.linalg.norm(points[:, :3].astype(float), axis=1)
    elevation = np.array(HDL64E.elevations)[::-1][ring]
    error = distance - HDL64E.height / np.sin(np.radians(-elevation))
    assert abs(error.mean()) < 0.001
    assert error.std() == pytest.approx(HDL64E.range_noise, rel=0.05)


def test_every_point_lies_on_its_beam_and_beams_are_in_firing_order(
    ground: tuple[np.ndarray, np.ndarray],
) -> None:
    points, ring = ground
    beams = np.array(HDL64E.elevations)
    assert len(beams) == 64
    assert (np.diff(beams) < 0).all()
    elevation = np.degrees(
        np.arcsin(points[:, 2] / np.linalg.norm(points[:, :3].astype(float), axis=1))
    )
    assert np.abs(elevation - beams[::-1][ring]).max() < 0.01
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    step = np.diff(ring.astype(int))
    assert (step <= 0).all()
    assert (np.diff(azimuth)[step == 0] > 0).all()


def test_the_own_car_hides_what_is_behind_its_parts(ground: tuple[np.ndarray, np.ndarray]) -> None:
    x, y, z = ground[0][:, :3].T
    azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
    behind = np.abs(azimuth) > 170
    assert elevation[behind].min() > -18.5
    assert elevation[~behind].min() < -23


def test_some_returns_at_edges_lie_in_between() -> None:
    found = []
    for mixed in (0.0, 0.5):
        points, _, _ = scanned(
            join([wall(10, (1, 9)), wall(12, (-9, 9))]), replace(EXACT, mixed=mixed)
        )
        found.append(np.count_nonzero((points[:, 0] > 10.05) & (points[:, 0] < 11.95)))
    assert found[0] == 0
    assert found[1] > 10


@pytest.mark.parametrize("depth", [0.05, 0.5])
def test_pulses_end_in_foliage_after_the_mean_depth(depth: float) -> None:
    """Where leaves are thick, the depths are exponential: mean and spread are the free path."""
    points, labels, _ = scanned(slab(15, 40, depth))
    ahead = points[np.abs(points[:, 1] / points[:, 0]) < 0.2, :3].astype(float)
    length = np.linalg.norm(ahead, axis=1) * (1 - 15 / ahead[:, 0])
    assert (labels == Label.VEGETATION).all()
    assert length.min() > -1e-4
    assert length.mean() == pytest.approx(depth, rel=0.05)
    assert length.std() == pytest.approx(depth, rel=0.1)


def slab(start: float, end: float, depth: float) -> Mesh:
    """Foliage from one x to another, 30 m wide and 20 m high, its skin looking outwards."""
    triangles = box((end - start, 30, 20), ((start + end) / 2, 0, -10))
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("ti,ti->t", normals, triangles.mean(axis=1) - ((start + end) / 2, 0, 0)) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return part(triangles, Surface.LEAF, Label.VEGETATION, depth)


def reached(scene: Mesh) -> float:
    """The share of the pulses ahead that the wall behind some foliage returns."""
    points, labels, _ = scanned(scene)
    ahead = np.abs(points[:, 1] / points[:, 0]) < 0.15
    return float((labels[ahead] == Label.BUILDING).mean())


def test_where_clumps_overlap_foliage_goes_on() -> None:
    """Their union is 4 m deep, and not the 2 m until the first of them ends."""
    assert reached(join([slab(14, 16, 1), slab(15, 18, 1), wall(22)])) == pytest.approx(
        np.exp(-4), rel=0.2
    )


def test_many_clumps_can_be_passed() -> None:
    clumps = [slab(10 + 2 * i, 11 + 2 * i, 100.0) for i in range(5)]
    assert reached(join([*clumps, wall(22)])) == pytest.approx(np.exp(-5 / 100), rel=0.05)


def test_through_a_thin_crown_some_pulses_reach_what_is_behind() -> None:
    """Of those through the middle, as many as exponential free paths let: exp(-thickness / depth)."""
    points, labels, _ = scanned(join([slab(14.5, 15.5, 0.5), wall(20)]))
    ahead = np.abs(points[:, 1] / points[:, 0]) < 0.15
    through = (labels[ahead] == Label.BUILDING).mean()
    # A leaf reflects less than the wall and is lost a little more often.
    assert through == pytest.approx(np.exp(-1 / 0.5), rel=0.08)
    assert np.abs(points[labels == Label.BUILDING, 0] - 20).max() < 0.01
    assert points[(labels == Label.VEGETATION) & (np.abs(points[:, 1]) < 5), 0].max() < 15.51


def test_a_hull_is_closed_and_looks_outwards() -> None:
    for seed in range(20):
        triangles = hull(np.random.default_rng(seed), (1, 2, 3), (2, 1, 4), taper=0.7, square=0.6)
        edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]).round(6)
        there, back = (
            {e.tobytes() for e in edges + 0.0},
            {e.tobytes() for e in edges[:, ::-1] + 0.0},
        )
        assert there == back  # each edge is passed once in each direction
        outward = np.einsum(
            "ti,ti->t",
            triangles[:, 0] - (1, 2, 3),
            np.cross(*np.diff(triangles, axis=1).swapaxes(0, 1)),
        )
        assert (outward > 0).mean() > 0.99  # a bump of a thin tip may hang over


@pytest.mark.parametrize("counter_clockwise", [True, False])
@pytest.mark.parametrize("corrected", [True, False])
def test_a_moving_sensor_smears_a_scan_unless_it_is_corrected(
    corrected: bool, counter_clockwise: bool
) -> None:
    """Ahead at the middle of the turn: what is on the left is seen a quarter of a turn later, or earlier."""
    sensor = replace(EXACT, turn=0.1, corrected=corrected, counter_clockwise=counter_clockwise)
    left = part(wall(10).triangles[..., [1, 0, 2]], Surface.PLASTER, Label.BUILDING)
    pole = part(box((0.2, 0.2, 20), (0, 10, -10)), Surface.METAL, Label.POLE)
    points, labels, _ = scanned(join([place(left, 0, 5, 0, 0), wall(20), pole]), sensor, speed=20.0)
    middle = points[labels == Label.POLE, 0].mean()
    moved = 20 * 0.025 * (1 if counter_clockwise else -1)  # metres, when it looks to the left
    assert middle == pytest.approx(0.0 if corrected else -moved, abs=0.05)
    ahead = points[(labels == Label.BUILDING) & (np.abs(points[:, 1]) < 0.2)]
    np.testing.assert_allclose(ahead[:, 0], 20, atol=0.02)


def test_a_thing_is_of_one_brightness_and_things_differ() -> None:
    rng = np.random.default_rng(1)
    panes = [tinted(wall(15, (y, y + 1)), rng) for y in range(-8, 8)]
    points, _, _ = scanned(join(panes))
    own = [points[(points[:, 1] > y + 0.1) & (points[:, 1] < y + 0.9), 3] for y in range(-8, 8)]
    medians = np.array([np.median(one) for one in own])
    within = np.mean([np.median(np.abs(one - m)) for one, m in zip(own, medians, strict=True)])
    assert medians.std() > 2 * within
    shade = REFLECTIONS[Surface.PLASTER].shade
    assert 0.5 * shade < np.log(medians).std() < 1.7 * shade


def test_far_grazing_ground_is_darker(ground: tuple[np.ndarray, np.ndarray]) -> None:
    points, _ = ground
    distance = np.linalg.norm(points[:, :2], axis=1)
    near, far = (np.median(points[np.abs(distance - d) < 0.2 * d, 3]) for d in (8, 40))
    assert far < 0.6 * near


def test_gains_differ_between_lasers_and_are_those_of_one_device() -> None:
    gains = laser_gains(HDL64E, np.random.default_rng(0))
    assert gains.shape == (64,)
    assert 0.05 < gains.std() < 0.3
    assert gains.min() >= 0.3
    assert (laser_gains(EXACT, np.random.default_rng(0)) == 1).all()
