"""Labelled triangle meshes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from lidarstreets.materials import Label, Surface
from lidarstreets.solids import moved


@dataclass(frozen=True)
class Mesh:
    """Triangles with a surface, a class and an instance each.

    Attributes:
        triangles: (T, 3, 3) float32 corners in metres; a body stands on z = 0.
        surface: (T,) uint8 rows of the reflection table.
        label: (T,) uint16 class ids; 0 is ground, whose class depends on the place.
        instance: (T,) uint16 instance ids; 0 is none.
        depth: (T,) float32 mean distance in metres that a pulse travels inside the triangles
            before it is reflected, if there were no gaps between the leaves; 0 is solid. A mesh
            that is not solid must be closed, with its corners counter-clockwise seen from outside.
        tint: (T,) float32 brightness of the surface, in standard deviations from the mean of its
            kind.
    """

    triangles: np.ndarray
    surface: np.ndarray
    label: np.ndarray
    instance: np.ndarray
    depth: np.ndarray
    tint: np.ndarray

    def __len__(self) -> int:
        return len(self.triangles)


# Draws one body.
Maker = Callable[[np.random.Generator], Mesh]


def part(
    solids: Sequence[np.ndarray],
    surface: Surface,
    label: Label | int,
    depth: float = 0,
    *,
    tint: float = 0,
) -> Mesh:
    """Return solids, (T, 3, 3) each, as one mesh of one surface and one class.

    See `Mesh` for the depth and the tint.
    """
    triangles = np.concatenate([np.zeros((0, 3, 3)), *solids])
    count = len(triangles)

    return Mesh(
        triangles=triangles.astype(np.float32),
        surface=np.full(count, surface, dtype=np.uint8),
        label=np.full(count, label, dtype=np.uint16),
        instance=np.zeros(count, dtype=np.uint16),
        depth=np.full(count, depth, dtype=np.float32),
        tint=np.full(count, tint, dtype=np.float32),
    )


def join(*meshes: Mesh) -> Mesh:
    """Return several meshes as one; the result is empty if there are none."""
    if not meshes:
        return part([], Surface.ASPHALT, 0)

    columns = {}
    for column in fields(Mesh):
        arrays = [getattr(mesh, column.name) for mesh in meshes]
        columns[column.name] = np.concatenate(arrays)
    return Mesh(**columns)


def place(mesh: Mesh, x: float = 0, y: float = 0, z: float = 0, yaw: float = 0) -> Mesh:
    """Return the mesh turned by `yaw` radians about the z axis, then moved by metres."""
    corners = moved(mesh.triangles, (x, y, z), yaw)
    return replace(mesh, triangles=corners.astype(np.float32))


def scaled(mesh: Mesh, factor: float) -> Mesh:
    """Return the mesh, its size multiplied by a factor."""
    return replace(mesh, triangles=mesh.triangles * np.float32(factor))


def rolled(mesh: Mesh, roll: float) -> Mesh:
    """Return the mesh turned by `roll` radians about the x axis: it leans to the right."""
    cos = np.cos(roll)
    sin = np.sin(roll)
    rotation = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    return replace(mesh, triangles=(mesh.triangles @ rotation.T).astype(np.float32))


def with_random_tint(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """Return the mesh with each of its surfaces a little brighter or darker than before."""
    tints = rng.standard_normal(len(Surface), dtype=np.float32)
    return replace(mesh, tint=mesh.tint + tints[mesh.surface])


def with_labels(mesh: Mesh, labels: dict[Label, int]) -> Mesh:
    """Return the mesh with the class ids that are keys of `labels` replaced by their values."""
    label = mesh.label.copy()
    for old, new in labels.items():
        label[mesh.label == old] = new
    return replace(mesh, label=label)
