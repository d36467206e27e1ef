"""Meshes of fences, walls, railings and noise barriers, which SemanticKITTI labels fence.

A `Fence` is one kind with all its measures; its segments lie along x and look alike, so that they
can be lined up along a boundary.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarstreets.bodies import fence_shapes
from lidarstreets.bodies.fence_shapes import FenceMeasures
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Surface
from lidarstreets.mesh import Mesh, join


@dataclass(frozen=True)
class Fence(FenceMeasures):
    """One kind of fence, which is drawn segment by segment."""

    def segment(self, rng: np.random.Generator, length: float) -> Mesh:
        """Return a piece of the fence, `length` metres along x."""
        mesh = _MAKERS[self.kind](self, rng, length)
        if rng.random() < self.overgrown:
            mesh = join([mesh, fence_shapes.creepers(rng, self, length)])
        return mesh


# Shares of the fences along a garden.
GARDEN_KINDS = {
    "boards": 0.17,
    "slats": 0.07,
    "pickets": 0.13,
    "lattice": 0.04,
    "mesh": 0.16,
    "railing": 0.08,
    "rails": 0.04,
    "wall": 0.10,
    "stone wall": 0.07,
    "wall and railing": 0.06,
    "panels": 0.04,
    "screen": 0.04,
}
# Shares of the fences along fields, woods, railways and yards.
OPEN_KINDS = {
    "mesh": 0.34,
    "rails": 0.20,
    "wire": 0.12,
    "pickets": 0.06,
    "boards": 0.08,
    "slats": 0.04,
    "wall": 0.06,
    "stone wall": 0.04,
    "panels": 0.06,
}
# Shares of what stands along fast roads.
ROADSIDE_KINDS = {
    "guard rail": 0.56,
    "double guard rail": 0.14,
    "wire rope": 0.06,
    "noise barrier": 0.12,
    "glass barrier": 0.04,
    "parapet": 0.08,
}
# Lowest and highest fence of each kind; other kinds as `_USUAL_HEIGHT`.
_HEIGHTS = {
    "pickets": (0.5, 1.3),
    "rails": (0.7, 1.4),
    "wire": (0.7, 1.5),
    "mesh": (0.8, 2.4),
    "wall": (0.3, 2.3),
    "stone wall": (0.3, 1.8),
    "screen": (1.5, 2.2),
    "guard rail": (0.65, 0.85),
    "double guard rail": (0.65, 0.85),
    "wire rope": (0.65, 0.85),
    "parapet": (0.8, 1.2),
    "noise barrier": (2.0, 5.0),
    "glass barrier": (1.5, 4.0),
}
_USUAL_HEIGHT = (0.6, 2.0)
_WOODEN = ("boards", "slats", "pickets", "lattice", "rails", "wire", "screen")
_STONY = {
    "wall": (Surface.PLASTER, Surface.BRICK, Surface.STONE),
    "wall and railing": (Surface.PLASTER, Surface.BRICK, Surface.STONE),
    "stone wall": (Surface.STONE,),
    "panels": (Surface.PLASTER,),
    "parapet": (Surface.PLASTER,),
    "noise barrier": (Surface.PLASTER, Surface.WOOD, Surface.METAL),
}


def draw_fence(rng: np.random.Generator, kinds: dict[str, float] | None = None) -> Fence:
    """Draw a kind of fence and its measures.

    Args:
        rng: draws them.
        kinds: shares of the kinds, such as `OPEN_KINDS`; those of gardens if None.
    """
    kind = weighted_choice(rng, GARDEN_KINDS if kinds is None else kinds)
    if kind in _WOODEN:
        surface = Surface.WOOD if rng.random() < 0.85 else Surface.PLASTIC
    elif kind in _STONY:
        surface = _STONY[kind][rng.integers(len(_STONY[kind]))]
    else:
        surface = Surface.METAL

    is_neat = rng.random() < 0.6

    return Fence(
        kind=kind,
        height=float(rng.uniform(*_HEIGHTS.get(kind, _USUAL_HEIGHT))),
        pitch=float(rng.uniform(0.09, 0.22)),
        gap=float(rng.uniform(0.0, 0.55) if kind != "mesh" else rng.uniform(0.55, 0.93)),
        surface=surface,
        lean=float(rng.normal(scale=0.005 if is_neat else 0.05)),
        uneven=float(rng.uniform(0, 0.01) if is_neat else rng.uniform(0.01, 0.05)),
        overgrown=float(rng.choice([0.0, 0.15, 0.7], p=[0.6, 0.25, 0.15])),
        tint=float(rng.normal(scale=0.8)),
    )


_Maker = Callable[[FenceMeasures, np.random.Generator, float], Mesh]
_MAKERS: dict[str, _Maker] = {
    "boards": fence_shapes.boards,
    "slats": fence_shapes.slats,
    "pickets": fence_shapes.pickets,
    "lattice": fence_shapes.lattice,
    "mesh": fence_shapes.mesh,
    "railing": fence_shapes.railing,
    "rails": fence_shapes.rails,
    "wire": fence_shapes.wire,
    "wall": fence_shapes.wall,
    "stone wall": fence_shapes.stone_wall,
    "wall and railing": fence_shapes.wall_and_railing,
    "panels": fence_shapes.panels,
    "screen": fence_shapes.screen,
    "guard rail": fence_shapes.crash_barrier,
    "double guard rail": fence_shapes.crash_barrier,
    "wire rope": fence_shapes.wire_rope,
    "parapet": fence_shapes.parapet,
    "noise barrier": fence_shapes.noise_barrier,
    "glass barrier": fence_shapes.noise_barrier,
}
KINDS = tuple(_MAKERS)
