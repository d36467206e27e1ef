"""Build, join and move labelled triangle meshes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from lidarstreets.materials import Label, Surface
from lidarstreets.solids import moved


@dataclass(frozen=True)
class Mesh:
    """T triangles. Each has a surface, a class and an instance.

    Attributes:
        triangles: (T, 3, 3) float32 corners in metres; a body stands on z = 0.
        surface: (T,) uint8 values of `Surface`.
        label: (T,) uint16 class ids; 0 is ground, whose class depends on the place.
        instance: (T,) uint16 instance ids; 0 is no instance.
        depth: (T,) float32 mean distance in metres that a pulse travels behind the triangle before
            a leaf reflects it, without the gaps between clumps of leaves; 0 is a solid surface. A
            mesh that is not solid must be closed, with its corners counter-clockwise seen from
            outside.
        tint: (T,) float32 brightness of the surface, in standard deviations (`Reflection.shade`)
            from the mean of its kind.
    """

    triangles: np.ndarray
    surface: np.ndarray
    label: np.ndarray
    instance: np.ndarray
    depth: np.ndarray
    tint: np.ndarray

    def __len__(self) -> int:
        return len(self.triangles)


# Function that draws one body.
Maker = Callable[[np.random.Generator], Mesh]


def part(
    solids: Sequence[np.ndarray],
    surface: Surface,
    label: Label | int,
    depth: float = 0,
    *,
    tint: float = 0,
) -> Mesh:
    """Return several solids as one mesh of one surface and one class.

    Args:
        solids: (T, 3, 3) triangles of each solid, metres.
        surface: surface of all triangles.
        label: class id of all triangles.
        depth: depth in metres, as in `Mesh`; 0 is solid.
        tint: brightness, as in `Mesh`.
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
    """Return several meshes as one mesh, or an empty mesh if there are none."""
    if not meshes:
        return part([], Surface.ASPHALT, 0)

    columns = {}
    for column in fields(Mesh):
        arrays = [getattr(mesh, column.name) for mesh in meshes]
        columns[column.name] = np.concatenate(arrays)
    return Mesh(**columns)


def place(mesh: Mesh, x: float = 0, y: float = 0, z: float = 0, yaw: float = 0) -> Mesh:
    """Return the mesh turned by `yaw` radians about the z axis, then moved by x, y, z metres."""
    corners = moved(mesh.triangles, (x, y, z), yaw)
    return replace(mesh, triangles=corners.astype(np.float32))


def scaled(mesh: Mesh, factor: float) -> Mesh:
    """Return the mesh `factor` times as large, seen from the origin."""
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
    """Return the mesh with other class ids: `labels` gives the new id for each old one."""
    label = mesh.label.copy()
    for old, new in labels.items():
        label[mesh.label == old] = new
    return replace(mesh, label=label)
