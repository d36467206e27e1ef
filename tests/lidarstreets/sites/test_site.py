"""Streets filled with bodies: nothing overlaps in a lane or covers the sensor."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from lidarstreets.course import Drive
from lidarstreets.drive import build_site
from lidarstreets.materials import MOVING, Label
from lidarstreets.mesh import Mesh
from lidarstreets.sites.site import Site
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.regions import REGIONS
from lidarstreets.streets.styles import Style, draw_style

from fixtures.examples import first_of

DRIVABLE = (Label.ROAD, Label.LANE_MARKING, Label.PARKING)


def busy(style: Style) -> Style:
    """Return a street with much traffic and no people."""
    return replace(style, traffic=4.0, people=0.0)


def footprint(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return middle and half size of a vehicle in its own frame, mirrors excluded."""
    corners = mesh.triangles.reshape(-1, 3)[:, :2]
    low = corners.min(axis=0)
    high = corners.max(axis=0)
    return (low + high) / 2, (high - low) / 2


@pytest.mark.parametrize("seed", first_of(range(6)))
def test_vehicles_of_one_lane_do_not_overlap(seed: int) -> None:
    pytest.importorskip("trimesh")
    site, _ = draw_site(seed)
    driving = {MOVING[Label.CAR], MOVING[Label.TRUCK], MOVING[Label.BUS]}
    movers = [mover for mover in site.movers if set(np.unique(mover.mesh.label)) & driving]

    for t, _ in site.ground.style.lanes:
        lane = [mover for mover in movers if abs(mover.t - t) < 0.9]
        for time in (0.0, 3.0, 11.0):
            order = sorted(lane, key=lambda mover: mover.street_x(site.ground, time))
            for first, second in pairwise(order):
                gap = second.street_x(site.ground, time) - first.street_x(site.ground, time)
                lengths = footprint(first.mesh)[1][0] + footprint(second.mesh)[1][0]
                assert gap > 0.9 * lengths


@cache
def draw_site(seed: int) -> tuple[Site, np.ndarray]:
    rng = np.random.default_rng(seed)
    drive = Drive()
    way = (drive.margin, drive.margin + 4 * drive.spacing)
    region = list(REGIONS.values())[seed % len(REGIONS)]
    ground = Ground(busy(draw_style(rng, region)), way[1] + drive.margin, rng, way)
    site, course = build_site(ground, 4, 8.0, rng, drive)
    return site, np.array([course.pose_at(index) for index in range(4)])


@pytest.mark.parametrize("seed", first_of(range(10)))
def test_the_sensor_is_over_a_drivable_surface_and_in_no_body(seed: int) -> None:
    pytest.importorskip("trimesh")
    site, poses = draw_site(seed)
    labels = site.ground.label(poses[:, 0], poses[:, 1])
    assert np.isin(labels, [*DRIVABLE, Label.OTHER_GROUND, Label.SIDEWALK]).all()
    assert np.isin(labels, DRIVABLE).mean() > 0.7

    for body in site.fixed:
        corners = body.triangles.reshape(-1, 3)
        height = corners[:, 2] - site.ground.height(poses[:1, 0], poses[:1, 1])
        low_corners = corners[(height < 2.0) & (height > -1.0), :2]
        for x, y, _ in poses:
            if len(low_corners):
                distance = np.hypot(*(low_corners - np.array([x, y])).T).min()
                assert distance > 0.9
