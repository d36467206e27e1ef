"""Triangles with a surface, a class and an instance each, and the few solids that bodies are built from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from amvnet.simulation.materials import Label, Surface

Vector = tuple[float, float, float]

_BOX_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
_BOX_FACES = np.array(
    [
        (0, 1, 3),
        (0, 3, 2),
        (4, 5, 7),
        (4, 7, 6),
        (0, 1, 5),
        (0, 5, 4),
        (2, 3, 7),
        (2, 7, 6),
        (0, 2, 6),
        (0, 6, 4),
        (1, 3, 7),
        (1, 7, 5),
    ]
)


@dataclass(frozen=True)
class Mesh:
    """Triangles and what each is.

    Attributes:
        triangles: (T, 3, 3) float32 corners in metres; z = 0 is where a body stands.
        surface: (T,) uint8 rows of the reflection table.
        label: (T,) uint16 raw class ids; 0 is ground, whose class depends on the place.
        instance: (T,) uint16 instance ids; 0 is none.
        depth: (T,) float32 metres that a pulse goes into what the triangles enclose, on average; 0 is solid. What is
            not solid must be closed, its corners counter-clockwise seen from outside.
        tint: (T,) float32 by how many standard deviations a surface is brighter than others of its kind.
    """

    triangles: np.ndarray
    surface: np.ndarray
    label: np.ndarray
    instance: np.ndarray
    depth: np.ndarray
    tint: np.ndarray

    def __len__(self) -> int:
        return len(self.triangles)


def part(triangles: np.ndarray, surface: Surface, label: Label | int, depth: float = 0) -> Mesh:
    """Triangles that are all of one surface and one class; see `Mesh` for the depth."""
    count = len(triangles)
    return Mesh(
        triangles.astype(np.float32),
        np.full(count, surface, dtype=np.uint8),
        np.full(count, label, dtype=np.uint16),
        np.zeros(count, dtype=np.uint16),
        np.full(count, depth, dtype=np.float32),
        np.zeros(count, dtype=np.float32),
    )


def join(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one; none at all as an empty one."""
    if not meshes:
        return part(np.zeros((0, 3, 3)), Surface.ASPHALT, 0)
    return Mesh(*(np.concatenate([getattr(m, f.name) for m in meshes]) for f in fields(Mesh)))


def place(mesh: Mesh, x: float, y: float, z: float, yaw: float) -> Mesh:
    """The mesh turned about its upright axis and moved to a place."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # transposed: corners are rows
    moved = mesh.triangles @ turn + np.array([x, y, z])
    return replace(mesh, triangles=moved.astype(np.float32))


def named(mesh: Mesh, instance: int) -> Mesh:
    """The mesh as one instance."""
    return replace(mesh, instance=np.full(len(mesh), instance, dtype=np.uint16))


def tinted(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh with each of its surfaces a little brighter or darker than usual."""
    return replace(mesh, tint=rng.standard_normal(len(Surface), dtype=np.float32)[mesh.surface])


def relabelled(mesh: Mesh, labels: dict[Label, int]) -> Mesh:
    """The mesh with some class ids replaced by others."""
    label = mesh.label.copy()
    for old, new in labels.items():
        label[mesh.label == old] = new
    return replace(mesh, label=label)


def box(
    size: Vector, at: Vector = (0, 0, 0), top: tuple[float, float] = (1, 1), shift: float = 0
) -> np.ndarray:
    """A box standing on `at`; `top` narrows its upper face in x and y, `shift` moves that face along x. (12, 3, 3)."""
    corners = _BOX_CORNERS * np.array(size)
    corners[4:, :2] *= np.array(top)
    corners[4:, 0] += shift
    return (corners + np.array(at))[_BOX_FACES]


def tube(
    start: Vector, end: Vector, radius: float, end_radius: float | None = None, sides: int = 8
) -> np.ndarray:
    """A closed round bar from one point to another, with another radius at its end if given. (4 sides, 3, 3)."""
    a, b = np.array(start, dtype=float), np.array(end, dtype=float)
    axis = (b - a) / np.linalg.norm(b - a)
    across = np.cross(axis, (1.0, 0, 0) if abs(axis[0]) < 0.9 else (0, 1.0, 0))
    across /= np.linalg.norm(across)
    angle = np.arange(sides) * 2 * np.pi / sides
    circle = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(
        axis, across
    )  # (sides, 3)
    low, high = a + circle * radius, b + circle * (radius if end_radius is None else end_radius)
    next_low, next_high = np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)
    starts, ends = np.broadcast_to(a, low.shape), np.broadcast_to(b, low.shape)
    quads = [
        (low, next_low, next_high),
        (low, next_high, high),
        (starts, next_low, low),
        (ends, high, next_high),
    ]
    return np.concatenate([np.stack(corners, axis=1) for corners in quads])


def prism(
    profile: Sequence[tuple[float, float]], width: float, top_width: float | None = None
) -> np.ndarray:
    """A side view (x, z), convex or nearly so, drawn out across y; narrower towards its top if given. (4 n, 3, 3)."""
    xz = np.array(profile, dtype=float)
    rise = (xz[:, 1] - xz[:, 1].min()) / np.ptp(xz[:, 1])
    half = 0.5 * (width + rise * ((width if top_width is None else top_width) - width))
    left = np.column_stack([xz[:, 0], half, xz[:, 1]])
    right = left * np.array([1, -1, 1])
    next_left, next_right = np.roll(left, -1, axis=0), np.roll(right, -1, axis=0)
    middles = [np.broadcast_to(side.mean(axis=0), side.shape) for side in (left, right)]
    faces = [(left, next_left, next_right), (left, next_right, right)]
    faces += [(middles[0], left, next_left), (middles[1], right, next_right)]
    return np.concatenate([np.stack(corners, axis=1) for corners in faces])


def hoop(radius: float, thickness: float, at: Vector, sides: int = 12) -> np.ndarray:
    """A flat ring in the x-z plane, as the rim of a bicycle wheel. (2 sides, 3, 3)."""
    angle = np.arange(sides) * 2 * np.pi / sides
    circle = np.column_stack([np.cos(angle), np.zeros(sides), np.sin(angle)])
    outer, inner = circle * radius, circle * (radius - thickness)
    next_outer, next_inner = np.roll(outer, -1, axis=0), np.roll(inner, -1, axis=0)
    faces = [(outer, next_outer, next_inner), (outer, next_inner, inner)]
    return np.concatenate([np.stack(corners, axis=1) for corners in faces]) + np.array(at)


@lru_cache(maxsize=4)
def _sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners (V, 3) and faces (T, 3) of a unit sphere."""
    from trimesh.creation import icosphere

    ball = icosphere(subdivisions=subdivisions)
    return np.asarray(ball.vertices), np.asarray(ball.faces)


def hull(
    rng: np.random.Generator,
    centre: Vector,
    radii: Vector,
    taper: float = 0,
    square: float = 1,
    fine: bool = True,
) -> np.ndarray:
    """The bumpy, closed hull of a clump of leaves; counter-clockwise seen from outside. (T, 3, 3).

    Args:
        rng: where the bumps come from.
        centre: its middle in metres.
        radii: its half axes in metres.
        taper: by what share it is narrower at its top and wider at its foot.
        square: below 1 it comes closer to a box.
        fine: 320 triangles instead of 80.
    """
    corners, faces = _sphere(2 if fine else 1)
    waves = np.sin(corners @ rng.normal(scale=3.0, size=(3, 3)) + rng.uniform(0, 6.3, size=3)).sum(
        axis=1
    )
    swell = 1 + 0.09 * waves + rng.normal(scale=0.11, size=len(corners))
    shape = np.sign(corners) * np.abs(corners) ** square * swell[:, None]
    shape[:, :2] *= np.maximum(1 - taper * shape[:, 2:], 0.05)  # a tip stays a tip
    return (shape * np.array(radii) + np.array(centre))[faces]
