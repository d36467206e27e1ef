from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarstreets.bodies.fences import FENCE_SHARES, draw_fence
from lidarstreets.materials import Label
from lidarstreets.sites import background
from lidarstreets.sites.background import line_side_road
from lidarstreets.sites.boundaries import Boundary
from lidarstreets.sites.site import Site
from lidarstreets.streets.ground import Ground
from lidarstreets.streets.regions import Region
from lidarstreets.streets.styles import draw_style

LOW = 0.5
HIGH = 1.8


def low_wall_and_fence(rng: np.random.Generator) -> Boundary:
    wall = replace(draw_fence(rng, FENCE_SHARES["low"]), height=LOW)
    fence = replace(draw_fence(rng, FENCE_SHARES["garden"]), height=HIGH)
    return Boundary(((wall, -0.3), (fence, 0.0)), missing=0.0)


def test_side_roads_have_all_layers_of_a_boundary(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background, "draw_boundary", low_wall_and_fence)
    rng = np.random.default_rng(0)
    heights = []
    for _ in range(6):
        ground = Ground(draw_style(rng, Region()), 120.0, rng, (40.0, 80.0))
        site = Site(ground, rng, course=np.zeros((0, 2)))
        for road in ground.plan.crossings:
            for side in (-1, 1):
                line_side_road(site, road, side)
        fences = [body for body in site.fixed if (body.label == Label.FENCE).any()]
        heights += [float(np.ptp(body.triangles[..., 2])) for body in fences]

    is_low = np.array(heights) < (LOW + HIGH) / 2
    assert 0.3 < is_low.mean() < 0.7
