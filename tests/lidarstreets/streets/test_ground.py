"""The ground of streets: its classes agree with the plan, and its height has no gaps."""

from __future__ import annotations

import numpy as np
import pytest

from lidarstreets.materials import Label
from lidarstreets.streets.ground import RARELY_PARKED_SHARE, Ground
from lidarstreets.streets.kinds import STREET_KINDS
from lidarstreets.streets.plans import Island, Patch, SideRoad, rounded_union, strip_at
from lidarstreets.streets.regions import REGIONS, Region
from lidarstreets.streets.styles import Strip, draw_style

from fixtures.examples import first_of

LENGTH = 240.0
COURSE = (90.0, 130.0)
DRIVABLE = (Label.ROAD, Label.LANE_MARKING, Label.PARKING)


def draw_ground(seed: int) -> Ground:
    rng = np.random.default_rng(seed)
    return Ground(draw_style(rng, Region()), LENGTH, rng, COURSE)


@pytest.fixture(scope="module", params=first_of(range(12), quick=2))
def ground(request: pytest.FixtureRequest) -> Ground:
    return draw_ground(request.param)


def plain_places(ground: Ground) -> np.ndarray:
    """Return x along the street at which neither side roads nor ends are near."""
    xs = np.arange(5.0, LENGTH - 5, 1.0)
    x, y = np.array([ground.pose_at(x, 0.0)[:2] for x in xs]).T
    is_plain = ground.distance_from_crossings(x, y) > 25
    is_plain &= (xs > ground.plan.start + 5) & (xs < ground.plan.end - 5)
    return xs[is_plain]


def label_at(ground: Ground, x: float, t: float) -> int:
    px, py, _ = ground.pose_at(x, t)
    return int(ground.label(np.array([px]), np.array([py]))[0])


def test_street_coordinates_are_the_inverse_of_places(ground: Ground) -> None:
    for t in (-8.0, -2.0, 0.0, 5.0):
        for x in (10.0, 77.0, 200.0):
            px, py, _ = ground.pose_at(x, t)
            along, across = ground.street_coordinates(np.array([px]), np.array([py]))
            assert along[0] == pytest.approx(x, abs=0.1)
            assert across[0] == pytest.approx(t, abs=0.02)


def test_lanes_are_on_the_road(ground: Ground) -> None:
    for x in plain_places(ground)[::5]:
        for t, _ in ground.style.lanes:
            assert label_at(ground, x, t) in (Label.ROAD, Label.LANE_MARKING)


def test_strips_have_their_class(ground: Ground) -> None:
    for x in plain_places(ground)[::5]:
        for side, strips in zip((-1, 1), ground.style.strips, strict=True):
            # The parking lane is missing where an island interrupts it.
            edge = ground.kerb_t(side) if ground.is_bay(x) else ground.style.road / 2
            for strip in strips:
                assert label_at(ground, x, side * (edge + strip.width / 2)) == strip.label
                edge += strip.width
            assert label_at(ground, x, side * (edge + 0.5)) == Label.TERRAIN


def test_parking_lanes_are_parking_and_bus_bays_are_road(ground: Ground) -> None:
    for x in plain_places(ground)[::5]:
        for index, width in enumerate(ground.style.parking):
            if width and ground.is_bay(x):
                t = (2 * index - 1) * (ground.style.road / 2 + width / 2)
                is_road = (
                    ground.style.is_bus_bay[index] or ground.style.parked <= RARELY_PARKED_SHARE
                )
                assert label_at(ground, x, t) == (Label.ROAD if is_road else Label.PARKING)


def test_a_patch_covers_plots_but_no_road() -> None:
    ground = draw_ground(1)
    ground.patches.append(Patch((0, LENGTH), (-60, 60), Label.OTHER_GROUND))
    for x in plain_places(ground)[::20]:
        assert label_at(ground, x, ground.front(1) + 3) == Label.OTHER_GROUND
        assert label_at(ground, x, ground.style.lanes[0][0]) in DRIVABLE


def test_side_roads_are_roads(ground: Ground) -> None:
    for road in ground.plan.crossings:
        along = ground.style.road / 2 + 6.0
        if along < road.length - 1:
            x, y, _ = road.pose_at(along, 0.0)
            assert road.distance(np.array([x]), np.array([y]))[0] == pytest.approx(
                -road.width / 2, abs=0.3
            )
            assert ground.label(np.array([x]), np.array([y]))[0] in (Label.ROAD, Label.LANE_MARKING)


def test_islands_have_their_class(ground: Ground) -> None:
    for island in ground.plan.islands:
        x = np.clip(sum(island.x) / 2, 0, LENGTH)
        assert label_at(ground, float(x), sum(island.t) / 2) == island.label


def test_the_ground_is_continuous_except_for_kerbs(ground: Ground) -> None:
    """Two places 2 cm apart differ by no more than the kerb and a steep terrace."""
    rng = np.random.default_rng(0)
    x = rng.uniform(0, LENGTH, 20_000)
    y = ground.middle(x) + rng.uniform(-30, 30, 20_000)
    height = ground.height(x, y)
    step = np.abs(ground.height(x + 0.02, y) - height)
    assert np.isfinite(height).all()
    assert np.quantile(step, 0.9) < 0.02
    assert step.max() < 0.35


@pytest.mark.parametrize("seed", first_of(range(20), quick=2))
def test_the_road_has_no_steps(seed: int) -> None:
    ground = draw_ground(seed)
    for x in plain_places(ground)[::10]:
        for t, _ in ground.style.lanes:
            px, py, _ = ground.pose_at(x, t)
            ahead = float(ground.height(px + 0.05, py))
            assert abs(ahead - float(ground.height(px, py))) < 0.02


def test_the_mesh_follows_the_height(ground: Ground) -> None:
    corners = ground.mesh().triangles.reshape(-1, 3).astype(float)[:40_000]
    error = corners[:, 2] - ground.height(corners[:, 0], corners[:, 1])
    assert np.quantile(np.abs(error), 0.95) < 0.01


@pytest.mark.parametrize("region", REGIONS)
def test_every_kind_of_street_is_drawn(region: str) -> None:
    rng = np.random.default_rng(0)
    styles = [draw_style(rng, REGIONS[region]) for _ in range(300)]
    assert {style.kind for style in styles} == set(STREET_KINDS)
    assert sum(kind.share for kind in STREET_KINDS.values()) == pytest.approx(1)
    for style in styles:
        for t, direction in style.lanes:
            assert style.median / 2 < abs(t) < style.road / 2
            assert direction in (-1, 1)


def test_a_corner_is_rounded() -> None:
    """A place on the bisector of two edges is on the road if it is outside of the circle."""
    radius = 4.0
    corner = radius - radius / np.sqrt(2)
    near = rounded_union(np.array([corner - 0.1]), np.array([corner - 0.1]), radius)
    far = rounded_union(np.array([corner + 0.1]), np.array([corner + 0.1]), radius)
    assert near[0] < 0 < far[0]
    assert rounded_union(np.array([-1.0]), np.array([7.0]), radius)[0] == -1
    assert rounded_union(np.array([9.0]), np.array([6.0]), radius)[0] == 6


def test_strips_are_laid_from_the_kerb_outwards() -> None:
    strips = (Strip(1.0, Label.TERRAIN), Strip(2.0, Label.SIDEWALK))
    label, off = strip_at(strips, np.array([0.5, 1.5, 2.9, 3.1]), Label.OTHER_GROUND)
    assert label.tolist() == [Label.TERRAIN, Label.SIDEWALK, Label.SIDEWALK, Label.OTHER_GROUND]
    assert off == pytest.approx([-2.5, -1.5, -0.1, 0.1])


@pytest.mark.parametrize("bend", [0.0, 0.02, -0.02])
def test_a_side_road_is_where_its_poses_are(bend: float) -> None:
    road = SideRoad(10, 5, 10, yaw=1.0, side=1, width=6.0, bend=bend)
    for along in (4.0, 20.0, 45.0):
        x, y, _ = road.pose_at(along, 0.0)
        assert road.distance(np.array([x]), np.array([y]))[0] == pytest.approx(-3, abs=1e-6)


def test_an_island_has_round_ends() -> None:
    island = Island((0, 10), (-1, 1), Label.TERRAIN)
    along = np.array([5.0, 0.0, 0.1, -1.0])
    distance = island.distance(along, np.array([0.0, 0.0, 0.9, 0.0]))
    assert distance[:2] == pytest.approx([-1, 0])
    assert distance[2] > 0
    assert distance[3] == pytest.approx(1)
