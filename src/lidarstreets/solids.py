"""Make the solids that all bodies are built from.

Each solid is an array of (T, 3, 3) corners of T triangles, in metres.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

Vector = tuple[float, float, float]

# Corners of the unit box, whose lower face is centred on the origin; x changes fastest.
_BOX_CORNERS = np.array(list(product((0.0, 1.0), (-0.5, 0.5), (-0.5, 0.5))))[:, ::-1]
# Corners of the two triangles of each face, counter-clockwise seen from outside.
_BOX_FACES = np.array([
    (0, 3, 1), (0, 2, 3),  # bottom
    (4, 5, 7), (4, 7, 6),  # top
    (0, 1, 5), (0, 5, 4),  # right
    (2, 7, 3), (2, 6, 7),  # left
    (0, 6, 2), (0, 4, 6),  # rear
    (1, 3, 7), (1, 7, 5),  # front
])  # fmt: skip


def box(
    size: Vector, at: Vector = (0, 0, 0), top: tuple[float, float] = (1, 1), shift: float = 0
) -> NDArray[np.float64]:
    """Return the (12, 3, 3) triangles of a box.

    Args:
        size: length along x, width along y and height along z, metres.
        at: centre of the lower face, metres.
        top: size of the upper face in x and y as factors on the size of the lower face.
        shift: distance by which the upper face is moved along x, metres.
    """
    corners = _BOX_CORNERS * np.array(size)
    corners[4:, :2] *= np.array(top)
    corners[4:, 0] += shift
    triangles: NDArray[np.float64] = (corners + np.array(at))[_BOX_FACES]
    return triangles


def copies(
    triangles: NDArray[np.float64], x: ArrayLike = 0.0, y: ArrayLike = 0.0, z: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Return one copy of (T, 3, 3) triangles for each offset (x, y, z) in metres.

    The offsets are broadcast against each other: `x=[0, 1], z=2` gives two copies, both 2 m up.
    """
    offsets = np.stack(np.broadcast_arrays(x, y, z), axis=-1)
    copied: NDArray[np.float64] = (triangles + offsets[..., None, None, :]).reshape(-1, 3, 3)
    return copied


def tube(
    start: Vector,
    end: Vector,
    radius: float,
    end_radius: float | None = None,
    sides: int = 8,
    *,
    closed: bool = True,
) -> NDArray[np.float64]:
    """Return the triangles of a round bar between two points.

    Args:
        start, end: ends of its axis, metres.
        radius: radius at the start, metres.
        end_radius: radius at the end, metres; by default the same.
        sides: number of flat sides that the bar has.
        closed: whether the bar has its two end faces.

    Returns:
        (4 * sides, 3, 3), or (2 * sides, 3, 3) if the bar is not closed.
    """
    if end_radius is None:
        end_radius = radius

    start_point = np.array(start, dtype=float)
    end_point = np.array(end, dtype=float)
    axis = (end_point - start_point) / np.linalg.norm(end_point - start_point)

    # The corners of a circle about the axis, (sides, 3).
    x, y, z = axis
    across = np.array([0, z, -y]) if abs(x) < 0.9 else np.array([-z, 0, x])
    across /= np.linalg.norm(across)
    a, b, c = across
    upward = np.array([y * c - z * b, z * a - x * c, x * b - y * a])  # axis x across
    angle = np.arange(sides) * 2 * np.pi / sides
    circle = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * upward

    low = start_point + circle * radius
    high = end_point + circle * end_radius
    next_low = np.roll(low, -1, axis=0)
    next_high = np.roll(high, -1, axis=0)
    side = quads(low, next_low, next_high, high)
    if not closed:
        return side

    start_points = np.broadcast_to(start_point, low.shape)
    end_points = np.broadcast_to(end_point, high.shape)
    ends = [_triangles(start_points, next_low, low), _triangles(end_points, high, next_high)]
    return np.concatenate([side, *ends])


def prism(
    profile: Sequence[tuple[float, float]], width: float, top_width: float | None = None
) -> NDArray[np.float64]:
    """Return the (4 * n, 3, 3) triangles of a side view extruded along y.

    Args:
        profile: n corners (x, z) of the side view, which is convex or nearly so.
        width: width along y at the lowest corner, metres.
        top_width: width along y at the highest corner, metres; by default the same.
    """
    if top_width is None:
        top_width = width

    xz = np.array(profile, dtype=float)
    rise = (xz[:, 1] - xz[:, 1].min()) / np.ptp(xz[:, 1])
    half_width = 0.5 * (width + rise * (top_width - width))

    left = np.column_stack([xz[:, 0], half_width, xz[:, 1]])
    right = left * np.array([1, -1, 1])
    next_left = np.roll(left, -1, axis=0)
    next_right = np.roll(right, -1, axis=0)
    left_middle = np.broadcast_to(left.mean(axis=0), left.shape)
    right_middle = np.broadcast_to(right.mean(axis=0), right.shape)

    side = quads(left, next_left, next_right, right)
    ends = [_triangles(left_middle, left, next_left), _triangles(right_middle, right, next_right)]
    return np.concatenate([side, *ends])


def loft(rings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (2 * n * k, 3, 3) triangles of the closed body through (n, k, 3) rings of corners.

    If the corners of each ring are counter-clockwise seen from the last ring, the corners of the
    triangles are counter-clockwise seen from outside.
    """
    following = np.roll(rings, -1, axis=1)
    low = rings[:-1].reshape(-1, 3)
    next_low = following[:-1].reshape(-1, 3)
    high = rings[1:].reshape(-1, 3)
    next_high = following[1:].reshape(-1, 3)

    start = np.broadcast_to(rings[0].mean(axis=0), rings[0].shape)
    end = np.broadcast_to(rings[-1].mean(axis=0), rings[-1].shape)
    side = quads(low, next_low, next_high, high)
    ends = [_triangles(start, following[0], rings[0]), _triangles(end, rings[-1], following[-1])]
    return np.concatenate([side, *ends])


def planks(
    x: ArrayLike,
    width: ArrayLike,
    bottom: ArrayLike,
    top: ArrayLike,
    y: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Return the (2 * n, 3, 3) triangles of n upright rectangles that face along y.

    The arguments are in metres and are broadcast against each other. `x` is the middle of each
    rectangle, and `bottom` and `top` are the heights of its lower and its upper edge.
    """
    x, width, bottom, top, y = np.broadcast_arrays(x, width, bottom, top, y)
    left = (x - width / 2).ravel()
    right = (x + width / 2).ravel()
    bottom = bottom.ravel()
    top = top.ravel()
    y = y.ravel()

    a = np.stack([left, y, bottom], axis=1)
    b = np.stack([right, y, bottom], axis=1)
    c = np.stack([right, y, top], axis=1)
    d = np.stack([left, y, top], axis=1)
    return quads(a, b, c, d)


def turned(triangles: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    """Return (T, 3, 3) triangles turned by `yaw` radians about the z axis."""
    cos = np.cos(yaw)
    sin = np.sin(yaw)
    rotation = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])  # transposed: corners are rows
    rotated: NDArray[np.float64] = triangles @ rotation
    return rotated


def moved(triangles: NDArray[np.float64], at: Vector, yaw: float = 0.0) -> NDArray[np.float64]:
    """Return (T, 3, 3) triangles turned by `yaw` radians about the z axis, then moved by `at`."""
    shifted: NDArray[np.float64] = turned(triangles, yaw) + np.array(at)
    return shifted


def leaning(triangles: NDArray[np.float64], x: float, y: float) -> NDArray[np.float64]:
    """Return (T, 3, 3) triangles moved by x and y metres for each metre above the ground."""
    offset = np.zeros_like(triangles)
    offset[..., 0] = x * triangles[..., 2]
    offset[..., 1] = y * triangles[..., 2]
    return triangles + offset


def hoop(radius: float, thickness: float, at: Vector, sides: int = 12) -> NDArray[np.float64]:
    """Return the (2 * sides, 3, 3) triangles of a flat ring in the x-z plane, such as a tyre.

    Args:
        radius: outer radius, metres.
        thickness: outer radius less inner radius, metres.
        at: centre of the ring, metres.
        sides: number of straight sides.
    """
    angle = np.arange(sides) * 2 * np.pi / sides
    circle = np.column_stack([np.cos(angle), np.zeros(sides), np.sin(angle)])

    outer = circle * radius
    inner = circle * (radius - thickness)
    next_outer = np.roll(outer, -1, axis=0)
    next_inner = np.roll(inner, -1, axis=0)
    triangles: NDArray[np.float64] = quads(outer, next_outer, next_inner, inner) + np.array(at)
    return triangles


def quads(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64], d: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (2 * n, 3, 3) triangles of n quadrangles.

    `a`, `b`, `c` and `d` are the (n, 3) corners in the order around each quadrangle.
    """
    return np.concatenate([_triangles(a, b, c), _triangles(a, c, d)])


def _triangles(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return n triangles, (n, 3, 3), from their (n, 3) corners."""
    return np.stack([a, b, c], axis=1)


@lru_cache(maxsize=4)
def _sphere(subdivisions: int) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """Return the corners (V, 3) and the faces (T, 3) of a unit sphere."""
    from trimesh.creation import icosphere

    sphere = icosphere(subdivisions=subdivisions)
    return np.asarray(sphere.vertices), np.asarray(sphere.faces)


def hull(
    rng: np.random.Generator,
    centre: Vector,
    radii: Vector,
    taper: float = 0,
    square: float = 1,
    fine: bool = True,
) -> NDArray[np.float64]:
    """Return the (T, 3, 3) triangles of the bumpy, closed hull of a clump of leaves.

    The corners are counter-clockwise seen from outside.

    Args:
        rng: draws the bumps.
        centre: centre of the hull, metres.
        radii: half the length of the hull along x, y and z, metres.
        taper: share by which the hull is narrower at the top and wider at the bottom.
        square: exponent of the shape: 1 is an ellipsoid; below 1, the hull is closer to a box.
        fine: whether the hull has 320 triangles instead of 80.
    """
    corners, faces = _sphere(2 if fine else 1)

    waves = np.sin(corners @ rng.normal(scale=3.0, size=(3, 3)) + rng.uniform(0, 6.3, size=3))
    swell = 1 + 0.09 * waves.sum(axis=1) + rng.normal(scale=0.11, size=len(corners))

    shape = np.sign(corners) * np.abs(corners) ** square * swell[:, None]
    shape[:, :2] *= np.maximum(1 - taper * shape[:, 2:], 0.05)  # keep the tip from turning over
    triangles: NDArray[np.float64] = (shape * np.array(radii) + np.array(centre))[faces]
    return triangles
