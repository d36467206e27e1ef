from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarstreets.bodies.fences import BELOW_GROUND, FENCE_SHARES, draw_fence
from lidarstreets.materials import Label
from lidarstreets.sites import background
from lidarstreets.sites.background import line_side_road
from lidarstreets.sites.boundaries import Boundary
from lidarstreets.sites.site import Site
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.regions import Region
from lidarstreets.streets.styles import draw_style

LOW = 0.5  # height of the wall, metres
HIGH = 1.8  # height of the fence behind it, metres
STREETS = 6  # some streets have no side road, and some side roads have no boundary


def draw_low_wall_and_fence(rng: np.random.Generator) -> Boundary:
    """Take the place of `draw_boundary`."""
    wall = replace(draw_fence(rng, FENCE_SHARES["low"]), height=LOW)
    fence = replace(draw_fence(rng, FENCE_SHARES["garden"]), height=HIGH)
    return Boundary(((wall, -0.3), (fence, 0.0)), missing=0.0)


def test_side_roads_have_all_layers_of_a_boundary(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many segments are of the wall as of the fence, but for a few that have no place."""
    monkeypatch.setattr(background, "draw_boundary", draw_low_wall_and_fence)
    rng = np.random.default_rng(0)
    heights = []
    for _ in range(STREETS):
        ground = Ground(draw_style(rng, Region()), 120.0, rng, (40.0, 80.0))
        site = Site(ground, rng, course=np.zeros((0, 2)))
        for road in ground.plan.crossings:
            for side in (-1, 1):
                line_side_road(site, road, side)
        for body in site.fixed:
            segment = body.triangles[body.label == Label.FENCE]  # without plants that overgrow it
            if len(segment):
                heights.append(float(np.ptp(segment[..., 2])))

    walls = np.count_nonzero(np.array(heights) < BELOW_GROUND + (LOW + HIGH) / 2)
    fences = len(heights) - walls
    assert fences > 0
    assert walls == pytest.approx(fences, rel=0.1)
