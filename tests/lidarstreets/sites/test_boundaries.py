import numpy as np

from lidarstreets.bodies.fences import Fence
from lidarstreets.sites.boundaries import LOW_WALL_CHANCE, draw_boundary


def test_some_gardens_have_a_low_wall_in_front_of_their_fence_or_hedge() -> None:
    rng = np.random.default_rng(0)
    boundaries = [draw_boundary(rng) for _ in range(500)]

    walls = []
    for boundary in boundaries:
        layer, offset = boundary.layers[0]
        if offset < 0:
            walls.append(layer)
            assert len(boundary.layers) > 1
    assert abs(len(walls) / len(boundaries) - LOW_WALL_CHANCE) < 0.06
    for wall in walls:
        assert isinstance(wall, Fence)
        assert wall.kind in ("wall", "stone wall")
        assert wall.height < 1


def test_only_gardens_have_a_low_wall() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        assert draw_boundary(rng, "open").layers[0][1] == 0
