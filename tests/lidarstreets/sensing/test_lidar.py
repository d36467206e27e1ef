"""The simulated LiDAR: scenes whose scans can be worked out by hand."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from lidarstreets import LIDAR_MODELS
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, place, with_random_tint
from lidarstreets.sensing.sensors import LidarModel
from lidarstreets.solids import box, hull

from fixtures.examples import first_of
from fixtures.processes import PATIENCE

pytest.importorskip("embreex")
from lidarstreets.sensing import lidar
from lidarstreets.sensing.lidar import RayScene, trace
from lidarstreets.sensing.returns import draw_lasers, receive

HDL64E = LIDAR_MODELS["hdl64e"]
# A sensor without noise, losses or motion; the tests turn on what they need.
EXACT = replace(
    HDL64E,
    range_noise=0.0,
    range_error=0.0,
    origins=((0.0, 0.0),),
    drop=0.0,
    mixed=0.0,
    gain_spread=0.0,
    decimals=6,
    rotation_period=0.0,
    half_range=np.inf,
    least_brightness=0.0,
    near_loss=0.0,
    own_returns=0.0,
)

Points = tuple[np.ndarray, np.ndarray]


class PlainRoad:
    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.full(len(x), Label.ROAD, dtype=np.uint16)

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        return np.zeros(len(x), dtype=np.float32)


def scan_mesh(
    mesh: Mesh,
    sensor: LidarModel = EXACT,
    pose: np.ndarray | None = None,
    speed: float = 0.0,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if pose is None:
        pose = np.eye(4)
    rng = np.random.default_rng(seed)
    hits = trace([RayScene(mesh)], sensor, pose, PlainRoad(), rng, speed=speed)
    return receive(hits, sensor, draw_lasers(sensor, rng), rng)


def wall(x: float, y: tuple[float, float] = (-30, 30)) -> Mesh:
    """Return a wall across the sensor's x axis, 20 m high."""
    right, left = y
    lower = [[x, right, -10], [x, left, -10], [x, left, 10]]
    upper = [[x, right, -10], [x, left, 10], [x, right, 10]]
    return part([np.array([lower, upper])], Surface.PLASTER, Label.BUILDING)


@pytest.mark.parametrize("name", LIDAR_MODELS)
def test_shots_are_whole_units_of_the_azimuth_apart(name: str) -> None:
    """The HDL-64E of KITTI counts its azimuth in 0.09 degrees: 1 in 7 steps is half as long."""
    model = replace(LIDAR_MODELS[name], shadow=())
    rays = lidar.rays_of(model)
    azimuth = np.degrees(np.arctan2(rays.direction[:, 1], rays.direction[:, 0]))
    for laser in range(len(model.elevations)):
        steps = np.diff(np.sort(azimuth[rays.ring == laser]))
        if not model.azimuth_unit:
            np.testing.assert_allclose(steps, 360 / model.azimuth_steps, atol=1e-3)
            continue

        units = steps / model.azimuth_unit
        np.testing.assert_allclose(units, np.round(units), atol=1e-3)
        short = np.mean(np.round(units) == 1)
        assert set(np.round(units)) == {1, 2}
        assert short == pytest.approx(0.148, abs=0.003)  # measured: 0.14 to 0.15


def slab(start: float, end: float, depth: float) -> Mesh:
    """Return foliage from one x to another, 30 m wide and 20 m high, its skin facing outwards."""
    middle = ((start + end) / 2, 0, 0)
    triangles = box((end - start, 30, 20), (middle[0], 0, -10))
    edges = np.diff(triangles, axis=1)
    normals = np.cross(edges[:, 0], edges[:, 1])
    inward = np.einsum("ti,ti->t", normals, triangles.mean(axis=1) - middle) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return part([triangles], Surface.LEAF, Label.VEGETATION, depth)


@pytest.fixture(scope="module")
def ground() -> Points:
    """Points and rings of a plane below the sensor."""
    far = 500.0
    right = [[-far, -far, 0], [far, -far, 0], [far, far, 0]]
    left = [[-far, -far, 0], [far, far, 0], [-far, far, 0]]
    plane = part([np.array([right, left])], Surface.GRASS, 0)
    pose = np.eye(4)
    pose[:3, 3] = (3.0, -2.0, HDL64E.height)

    sensor = replace(EXACT, range_noise=HDL64E.range_noise, drop=0.01, mixed=HDL64E.mixed)
    points, labels, ring = scan_mesh(plane, sensor, pose)
    assert (labels == Label.ROAD).all()
    return points, ring


def test_flat_ground_has_the_ranges_of_the_textbook(ground: Points) -> None:
    points, ring = ground
    distance = np.linalg.norm(points[:, :3].astype(float), axis=1)
    elevation = np.array(HDL64E.elevations)[::-1][ring]
    error = distance - HDL64E.height / np.sin(np.radians(-elevation))
    assert abs(error.mean()) < 0.001

    # Relief is no deeper than a fraction of the noise if it is seen from above.
    assert error[distance < 6].std() == pytest.approx(HDL64E.range_noise, rel=0.05)


@pytest.mark.full
def test_relief_is_deeper_along_a_ray_that_grazes_it() -> None:
    """Relief is a height: along a ray it is as much deeper as the ray is flatter."""
    corner = 100.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    meadow = part([corner[[[0, 1, 2], [0, 2, 3]]]], Surface.GRASS, Label.TERRAIN)
    sensor = replace(EXACT, azimuth_steps=300)
    sine = np.sin(np.radians(-np.array(sensor.elevations)))[::-1]
    pose = np.eye(4)
    pose[2, 3] = sensor.height

    ratios = []
    for seed in range(20):
        points, _, ring = scan_mesh(meadow, sensor, pose, seed=seed)
        distance = np.linalg.norm(points[:, :3].astype(float), axis=1)
        flat = sensor.height / sine[ring]
        depth = np.abs(distance - flat)
        near = np.median(depth[(flat > 5) & (flat < 8)])
        far = np.median(depth[(flat > 14) & (flat < 22)])
        ratios.append(np.log(far / near))
    assert np.mean(ratios) == pytest.approx(np.log(18 / 6.5), abs=0.4)


@pytest.mark.full
def test_glare_and_loss_come_in_patches_of_a_surface() -> None:
    paint = part([wall(8).triangles], Surface.LIGHT_PAINT, Label.CAR)
    points, _, ring = scan_mesh(paint, replace(EXACT, least_brightness=0.1))
    every, _, _ = scan_mesh(wall(8))

    # As many are lost as the table says.
    drop = Surface.LIGHT_PAINT.reflection.drop
    assert 1 - len(points) / len(every) == pytest.approx(drop, rel=0.35)

    # Without intensity, most neighbours have none either; by chance, few would.
    is_dark = points[:, 3] == 0
    share = is_dark.mean()
    same_laser = np.diff(ring) == 0
    dark_pairs = is_dark[:-1] & is_dark[1:] & same_laser
    assert 0.1 < share < 0.6
    assert dark_pairs.sum() / (is_dark[:-1] & same_laser).sum() > 2.5 * share


@pytest.mark.full
def test_the_lower_lasers_tell_how_bright_darker_things_are() -> None:
    lasers = draw_lasers(HDL64E, np.random.default_rng(0))
    assert (lasers.least_brightness[32:] == HDL64E.least_brightness).all()
    assert (lasers.least_brightness[:32] < 0.5 * HDL64E.least_brightness).all()

    tyre = part([wall(6).triangles], Surface.RUBBER, Label.CAR)
    points, _, ring = scan_mesh(tyre, replace(EXACT, least_brightness=0.11))
    without = points[:, 3] == 0
    assert without[ring < 32].mean() < 0.8 * without[ring >= 32].mean()


def test_every_point_lies_on_its_beam_and_beams_are_in_firing_order(ground: Points) -> None:
    points, ring = ground
    beams = np.array(HDL64E.elevations)
    assert len(beams) == 64
    assert (np.diff(beams) < 0).all()

    distance = np.linalg.norm(points[:, :3].astype(float), axis=1)
    elevation = np.degrees(np.arcsin(points[:, 2] / distance))
    assert np.abs(elevation - beams[::-1][ring]).max() < 0.01

    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    ring_step = np.diff(ring.astype(int))
    assert (ring_step <= 0).all()
    assert (np.diff(azimuth)[ring_step == 0] > 0).all()


def test_the_car_hides_what_is_behind_its_parts(ground: Points) -> None:
    x, y, z = ground[0][:, :3].T
    azimuth = np.degrees(np.arctan2(y, x))
    elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
    behind = np.abs(azimuth) > 170
    assert elevation[behind].min() > -19.7
    assert elevation[~behind].min() < -23


@pytest.mark.parametrize(("mixed", "smallest", "largest"), [(0.0, 0, 0), (0.5, 11, np.inf)])
def test_some_returns_at_edges_lie_in_between(mixed: float, smallest: int, largest: int) -> None:
    points, _, _ = scan_mesh(join(wall(10, (1, 9)), wall(12, (-9, 9))), replace(EXACT, mixed=mixed))
    between = np.count_nonzero((points[:, 0] > 10.05) & (points[:, 0] < 11.95))
    assert smallest <= between <= largest


@pytest.fixture
def without_gaps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make all foliage equally dense, so that each pulse ends by chance of its own."""
    monkeypatch.setattr(lidar, "GAP_OPENNESS", (1.0, 0.0))
    monkeypatch.setattr(lidar, "CLUMP_PATCH", (0.2, 0.0))


@pytest.mark.usefixtures("without_gaps")
@pytest.mark.parametrize("depth", [0.05, 0.5])
def test_pulses_end_in_foliage_after_the_mean_depth(depth: float) -> None:
    """In thick foliage the depths are exponential: mean and deviation are the free path."""
    points, labels, _ = scan_mesh(slab(15, 40, depth))
    ahead = points[np.abs(points[:, 1] / points[:, 0]) < 0.2, :3].astype(float)
    length = np.linalg.norm(ahead, axis=1) * (1 - 15 / ahead[:, 0])
    assert (labels == Label.VEGETATION).all()
    assert length.min() > -1e-4
    assert length.mean() == pytest.approx(depth, rel=0.05)
    assert length.std() == pytest.approx(depth, rel=0.1)


def share_through(scene: Mesh) -> float:
    """Return the share of the pulses ahead that pass some foliage and hit the wall behind it."""
    points, labels, _ = scan_mesh(scene)
    ahead = np.abs(points[:, 1] / points[:, 0]) < 0.15
    return float((labels[ahead] == Label.BUILDING).mean())


@pytest.mark.full
@pytest.mark.usefixtures("without_gaps")
def test_overlapping_clumps_are_one() -> None:
    """Their union is 4 m deep, not the 2 m at which the first of them ends."""
    scene = join(slab(14, 16, 1), slab(15, 18, 1), wall(22))
    assert share_through(scene) == pytest.approx(np.exp(-4), rel=0.2)


@pytest.mark.full
@pytest.mark.usefixtures("without_gaps")
def test_many_clumps_can_be_passed() -> None:
    clumps = [slab(10 + 2 * i, 11 + 2 * i, 100.0) for i in range(5)]
    assert share_through(join(*clumps, wall(22))) == pytest.approx(np.exp(-5 / 100), rel=0.05)


@pytest.mark.usefixtures("without_gaps")
def test_some_pulses_pass_a_thin_crown() -> None:
    """Their share is that of exponential free paths: exp(-thickness / depth)."""
    scene = join(slab(14.5, 15.5, 0.5), wall(20))
    # A leaf reflects less than the wall and is lost a little more often.
    assert share_through(scene) == pytest.approx(np.exp(-1 / 0.5), rel=0.12)

    points, labels, _ = scan_mesh(scene)
    is_near_axis = np.abs(points[:, 1]) < 5
    assert np.abs(points[labels == Label.BUILDING, 0] - 20).max() < 0.01
    assert points[(labels == Label.VEGETATION) & is_near_axis, 0].max() < 15.51


@pytest.mark.full
def test_foliage_has_gaps_and_dense_places() -> None:
    """Pulses that enter near one another end at a similar depth, others at very different ones."""
    points, _, _ = scan_mesh(slab(15, 400, 0.1))
    ahead = points[np.abs(points[:, 1] / points[:, 0]) < 0.2, :3].astype(float)
    entry = ahead * (15 / ahead[:, :1])
    depth = np.log(np.linalg.norm(ahead - entry, axis=1) + 1e-3)
    # The standard deviation of the logarithm of an exponential distribution is 1.28.
    assert depth.std() > 1.5 * 1.28

    near = np.linalg.norm(np.diff(entry, axis=0), axis=1) < 0.05
    step = np.diff(depth)
    assert near.mean() > 0.9
    assert step[near].std() < 0.9 * np.sqrt(2) * depth.std()


def test_a_hull_is_closed_and_faces_outwards() -> None:
    centre = (1, 2, 3)
    for seed in range(20):
        triangles = hull(np.random.default_rng(seed), centre, (2, 1, 4), taper=0.7, square=0.6)

        edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)]).round(6) + 0.0
        forward = {edge.tobytes() for edge in edges}
        backward = {edge.tobytes() for edge in edges[:, ::-1]}
        assert forward == backward  # each edge is passed once in each direction

        sides = np.diff(triangles, axis=1)
        normals = np.cross(sides[:, 0], sides[:, 1])
        outward = np.einsum("ti,ti->t", triangles[:, 0] - centre, normals)
        assert (outward > 0).mean() > 0.99  # a bump of a thin tip may hang over


@pytest.mark.parametrize("counter_clockwise", first_of((True, False)))
@pytest.mark.parametrize("corrected", [True, False])
def test_motion_smears_a_scan_if_not_corrected(corrected: bool, counter_clockwise: bool) -> None:
    """A rotation is centred on ahead: the sensor looks left a quarter of it later, or earlier."""
    sensor = replace(
        EXACT, rotation_period=0.1, motion_corrected=corrected, counter_clockwise=counter_clockwise
    )
    left_wall = replace(wall(10), triangles=wall(10).triangles[..., [1, 0, 2]])
    pole = part([box((0.2, 0.2, 20), (0, 10, -10))], Surface.METAL, Label.POLE)
    scene = join(place(left_wall, 0, 5, 0, 0), wall(20), pole)
    points, labels, _ = scan_mesh(scene, sensor, speed=20.0)

    pole_x = points[labels == Label.POLE, 0].mean()
    moved = 20 * 0.025 * (1 if counter_clockwise else -1)  # metres, when it looks to the left
    assert pole_x == pytest.approx(0.0 if corrected else -moved, abs=0.05)

    ahead = points[(labels == Label.BUILDING) & (np.abs(points[:, 1]) < 0.2)]
    np.testing.assert_allclose(ahead[:, 0], 20, atol=0.02)


@pytest.mark.full
def test_a_body_has_one_brightness_and_bodies_differ() -> None:
    rng = np.random.default_rng(1)
    rights = range(-16, 16)  # y of the right edges of 32 walls, 1 m wide each
    panels = [with_random_tint(wall(15, (y, y + 1)), rng) for y in rights]
    points, _, _ = scan_mesh(join(*panels))

    medians = []
    deviations = []
    for y in rights:
        inside = (points[:, 1] > y + 0.1) & (points[:, 1] < y + 0.9)
        intensity = points[inside, 3]
        medians.append(np.median(intensity))
        deviations.append(np.median(np.abs(intensity - medians[-1])))

    # Walls differ by their tints alone, and the returns of one by the noise of the intensity.
    reflection = Surface.PLASTER.reflection
    tints = np.array([panel.tint[0] for panel in panels])
    unexplained = np.log(medians) - reflection.shade * tints
    assert unexplained.std() < 0.02
    assert np.mean(np.divide(deviations, medians)) < reflection.spread


@pytest.mark.full
def test_far_grazing_ground_is_darker(ground: Points) -> None:
    points, _ = ground
    distance = np.linalg.norm(points[:, :2], axis=1)
    near = np.median(points[np.abs(distance - 8) < 0.2 * 8, 3])
    far = np.median(points[np.abs(distance - 40) < 0.2 * 40, 3])
    assert far < 0.6 * near


@pytest.mark.full
def test_lasers_differ_in_gain_and_the_upper_ones_see_near_surfaces_darker() -> None:
    lasers = draw_lasers(HDL64E, np.random.default_rng(0))
    assert lasers.gain.shape == lasers.near_loss.shape == (64,)
    assert 0.05 < lasers.gain.std() < 0.3
    assert lasers.gain.min() >= 0.3
    assert (lasers.near_loss[:32] == 0).all()
    assert 0.1 < lasers.near_loss[32:].mean() < 0.3

    exact = draw_lasers(EXACT, np.random.default_rng(0))
    assert (exact.gain == 1).all()
    assert (exact.near_loss == 0).all()

    sensor = replace(EXACT, near_loss=0.3)
    near, _, near_ring = scan_mesh(wall(5), sensor)
    far, _, far_ring = scan_mesh(wall(20), sensor)
    assert brightness(near[near_ring >= 32]) < 0.85 * brightness(near[near_ring < 32])
    assert brightness(far[far_ring >= 32]) == pytest.approx(brightness(far[far_ring < 32]), rel=0.1)


@pytest.mark.full
def test_each_laser_measures_a_wall_with_an_error_of_its_own() -> None:
    sensor = replace(EXACT, range_error=0.05)
    errors = draw_lasers(sensor, np.random.default_rng(3)).range_error
    assert 0.03 < errors.std() < 0.07

    lasers = draw_lasers(sensor, np.random.default_rng(3))
    for x in (8.0, 30.0):
        hits = trace([RayScene(wall(x))], sensor, np.eye(4), PlainRoad(), np.random.default_rng(0))
        points, _, ring = receive(hits, sensor, lasers, np.random.default_rng(1))
        distance = np.linalg.norm(points[:, :3].astype(float), axis=1)
        to_the_wall = x * distance / points[:, 0]
        assert np.allclose(distance - to_the_wall, errors[ring], atol=1e-3)


@pytest.mark.full
def test_a_laser_sees_near_things_from_its_own_height() -> None:
    """Points of one laser lie on a line that begins at its height, at any range."""
    sensor = replace(EXACT, origins=HDL64E.origins)
    heights = np.interp(sensor.elevations, *np.transpose(sensor.origins))[::-1]
    slopes = np.tan(np.radians(sensor.elevations))[::-1]
    assert heights.max() == pytest.approx(0.21, abs=0.005)
    assert heights.min() == pytest.approx(0.12, abs=0.005)

    for x in (5.0, 25.0):
        points, _, ring = scan_mesh(wall(x), sensor)
        across = np.hypot(points[:, 0], points[:, 1])
        assert np.allclose(points[:, 2], heights[ring] + slopes[ring] * across, atol=2e-3)


def brightness(points: np.ndarray) -> float:
    """Return the mean intensity of the points that have one."""
    return float(points[points[:, 3] > 0, 3].mean())


@pytest.mark.full
def test_brightness_is_half_at_half_the_range_and_weak_returns_have_none() -> None:
    """A dark wall 40 m away is at the limit; the same wall 10 m away is not."""
    fading = replace(EXACT, half_range=40.0)
    plain, _, _ = scan_mesh(wall(40, (-2, 2)), EXACT)
    faded, _, _ = scan_mesh(wall(40, (-2, 2)), fading)
    assert brightness(faded) == pytest.approx(brightness(plain) / 2, rel=0.02)

    sensor = replace(fading, least_brightness=brightness(faded))
    # As weak returns come in patches, only wide walls have the mean share of them.
    every, _, _ = scan_mesh(wall(40, (-10, 10)), fading)
    far, _, _ = scan_mesh(wall(40, (-10, 10)), sensor)
    near, _, _ = scan_mesh(wall(10, (-10, 10)), sensor)
    assert len(far) == pytest.approx(len(every), rel=0.02)
    assert 0.3 < (far[:, 3] == 0).mean() < 0.7
    assert (near[:, 3] == 0).mean() < 0.05


def test_the_shots_that_the_car_blocks_return_from_its_roof() -> None:
    """nuScenes has a point for every shot; one in eight hits the roof of the car itself."""
    shadow = ((150.0, 210.0, -90.0, -12.0),)
    sensor = replace(EXACT, keeps_lost_returns=True, roof=0.5, shadow=shadow)
    points, labels, ring = scan_mesh(wall(20), sensor)
    assert (np.bincount(ring) == sensor.azimuth_steps).all()

    distance = np.linalg.norm(points[:, :3], axis=1)
    is_roof = (distance > 1) & (distance < 3)  # lost returns are nearer, and the wall is farther
    assert np.array_equal(np.sort(ring[is_roof]), np.sort(lidar.rays_of(sensor, blocked=True).ring))
    x, y, z = points[is_roof, :3].T
    np.testing.assert_allclose(z, -0.5, atol=0.1)
    assert np.degrees(np.arctan2(-z, np.hypot(x, y))).min() > 12
    assert np.abs(np.degrees(np.arctan2(y, -x))).max() < 34

    # So few points have a class that the shares of the classes hardly change.
    for within_car in (is_roof, distance < 1):
        assert (labels[within_car] == Label.CAR).mean() == pytest.approx(0.1, abs=0.02)
        assert set(labels[within_car]) == {0, Label.CAR}


@pytest.mark.full
def test_a_factor_on_a_surface_changes_its_brightness_alone() -> None:
    brick = replace(wall(10), surface=np.full(2, Surface.BRICK, np.uint8))
    sensor = replace(EXACT, gamma=2.0, gain=0.5)
    bright = replace(sensor, surfaces=(("PLASTER", 1.2, 1.0, 1.0, 1.0),))
    for mesh, ratio in ((wall(10), 1.2**2), (brick, 1.0)):
        plain, with_factor = scan_mesh(mesh, sensor)[0], scan_mesh(mesh, bright)[0]
        np.testing.assert_array_equal(plain[:, :3], with_factor[:, :3])
        np.testing.assert_allclose(with_factor[:, 3], plain[:, 3] * ratio, atol=1e-5)


def test_the_car_itself_returns_a_few_dark_points_in_firing_order() -> None:
    sensor = replace(EXACT, own_returns=30.0)
    points, labels, ring = scan_mesh(wall(20), sensor)
    distance = np.linalg.norm(points[:, :3], axis=1)
    own = distance < 3
    assert 10 < own.sum() < 60
    assert (labels[own] == Label.OUTLIER).all()
    assert (points[own, 3] == 0).all()

    elevation = np.degrees(np.arcsin(points[own, 2] / distance[own]))
    lasers = np.array(sensor.elevations)[::-1][ring[own]]
    np.testing.assert_allclose(elevation, lasers, atol=1e-3)

    # From the top down, and once around for each laser.
    assert (np.diff(ring.astype(int)) <= 0).all()
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    assert (np.diff(azimuth)[np.diff(ring) == 0] > -0.1).all()


INTERRUPTED = """
import signal, sys
from importlib.abc import MetaPathFinder
from lidarstreets.sensing.lidar import require_embree

class Finder(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "trimesh.voxel":
            signal.raise_signal(signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Finder())
try:
    require_embree()
except KeyboardInterrupt:
    print("stopped")
"""


@pytest.mark.full
def test_a_signal_during_the_import_of_trimesh_is_not_lost() -> None:
    """Trimesh drops the exceptions of its imports."""
    words = [sys.executable, "-c", INTERRUPTED]
    done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stdout) == (0, "stopped\n"), done.stderr
