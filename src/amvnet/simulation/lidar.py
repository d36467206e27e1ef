"""A spinning LiDAR: which rays it fires, and what they hit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Protocol

import numpy as np

from amvnet.errors import InputError
from amvnet.simulation.materials import ground_surface_table
from amvnet.simulation.mesh import Mesh
from amvnet.simulation.sensors import Sensor

SHADOW_EDGE = 6.0  # degrees by which the edges of the car's shadow differ between lasers
SKINS = 16  # of clumps of leaves that a pulse may pass on its way in and out
BEYOND = 0.002  # metres behind a surface where a ray goes on
LEAF_COSINE = 0.5  # leaves look every way


def require_embree() -> tuple[ModuleType, ModuleType]:
    """The two modules of embreex that cast rays.

    Raises:
        InputError: where the extra `simulate` is not installed.
    """
    try:
        import trimesh  # noqa: F401  whose spheres the bodies are made from
        from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise InputError(
            'simulation: expected trimesh and embreex to cast rays, found none; do pip install "amvnet[simulate]"'
        ) from error
    return rtcore_scene, mesh_construction


class RayScene:
    """Meshes that rays can be cast at."""

    def __init__(self, mesh: Mesh) -> None:
        scenes, meshes = require_embree()
        self.mesh = mesh
        self._scene = scenes.EmbreeScene()
        self._kept = meshes.TriangleMesh(self._scene, mesh.triangles)
        edges = mesh.triangles[:, 1:] - mesh.triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        self.normals = (normals / length).astype(np.float32)

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance and triangle of the first hit of each ray; infinite and -1 where there is none. (R,), (R,)."""
        found = self._scene.run(origin, directions, output=1)
        triangle = found["primID"].astype(np.int64)
        return np.where(triangle >= 0, found["tfar"], np.inf), triangle


class GroundLook(Protocol):
    """What the ground, whose triangles have no class, looks like at places x, y; all arrays are (N,)."""

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Raw class ids."""

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """How bright, as in `Mesh`."""


@dataclass(frozen=True)
class Rays:
    """The shots of one turn that the own car lets out, in the sensor's frame; laser by laser, azimuth from +x.

    Attributes:
        direction: (R, 3) float32 unit vectors.
        ring: (R,) uint8 index of the laser, 0 = lowest.
        time: (R,) float32 seconds from the moment when the sensor looks ahead.
    """

    direction: np.ndarray
    ring: np.ndarray
    time: np.ndarray


@dataclass(frozen=True)
class Hits:
    """What the rays of one turn hit, in the sensor's frame.

    Attributes:
        direction: (N, 3) unit vectors.
        distance: (N,) metres.
        cosine: (N,) of the angle between ray and surface normal.
        surface: (N,) rows of the reflection table.
        tint: (N,) as in `Mesh`.
        label: (N,) class ids.
        instance: (N,) instance ids.
        ring: (N,) index of the laser, 0 = lowest.
        shift: (N, 3) metres that the sensor had moved when it fired.
    """

    direction: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray
    surface: np.ndarray
    tint: np.ndarray
    label: np.ndarray
    instance: np.ndarray
    ring: np.ndarray
    shift: np.ndarray


@lru_cache(maxsize=4)
def fired(sensor: Sensor) -> Rays:
    """The shots of one turn."""
    elevation = np.radians(np.array(sensor.elevations))[:, None]
    # The lasers of a real device do not sit on one line: each is turned by a little of its own.
    skew = ((np.arange(len(elevation)) * 0.618) % 1.0)[:, None]
    turned = (np.arange(sensor.azimuth_steps) + skew) / sensor.azimuth_steps
    azimuth, level = 2 * np.pi * turned, np.cos(elevation)
    rays = np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1
    )
    ring = np.repeat(np.arange(len(sensor.elevations), dtype=np.uint8)[::-1], sensor.azimuth_steps)
    time = sensor.turn * ((turned + 0.5) % 1 - 0.5) * (1 if sensor.counter_clockwise else -1)
    free = ~_hidden(sensor)
    columns = (
        rays.reshape(-1, 3)[free].astype(np.float32),
        ring[free],
        time.ravel()[free].astype(np.float32),
    )
    for array in columns:
        array.flags.writeable = False
    return Rays(*columns)


def _hidden(sensor: Sensor) -> np.ndarray:
    """(R,) True where the own car stops a shot; laser by laser."""
    elevation = np.array(sensor.elevations)[:, None]
    azimuth = np.arange(sensor.azimuth_steps) * 360 / sensor.azimuth_steps
    # The edges differ between lasers, which look out of the device at several places.
    azimuth = azimuth + SHADOW_EDGE * ((np.arange(len(elevation)) * 0.382) % 1.0 - 0.5)[:, None]
    hidden = np.zeros((len(elevation), sensor.azimuth_steps), dtype=bool)
    for start, end, low, high in sensor.shadow:
        hidden |= ((azimuth - start) % 360 < end - start) & (elevation > low) & (elevation < high)
    return hidden.ravel()


class _Front:
    """How far some rays have come: the nearest hit of each over all scenes.

    Attributes:
        distance: (R,) float32 metres; infinite where there is none.
        facing: (R,) product of ray and normal, negative where the ray comes from outside.
        surface, label, instance, depth, tint: (R,) as in `Mesh`, of what was hit.
    """

    def __init__(
        self, scenes: Sequence[RayScene], origin: np.ndarray, direction: np.ndarray
    ) -> None:
        self.distance = np.full(len(direction), np.inf, dtype=np.float32)
        self.facing = np.zeros(len(direction), dtype=np.float32)
        self.depth, self.tint = np.zeros((2, len(direction)), dtype=np.float32)
        self.surface = np.zeros(len(direction), dtype=np.uint8)
        self.label, self.instance = np.zeros((2, len(direction)), dtype=np.uint16)
        for scene in scenes:
            far, triangle = scene.cast(origin, direction)
            hit = np.flatnonzero(far < self.distance)
            struck, mesh = triangle[hit], scene.mesh
            self.distance[hit] = far[hit]
            self.facing[hit] = np.einsum("ij,ij->i", scene.normals[struck], direction[hit])
            for name in _OF_TRIANGLES:
                getattr(self, name)[hit] = getattr(mesh, name)[struck]

    def move(self, index: np.ndarray, to: _Front, rows: np.ndarray, gone: np.ndarray) -> None:
        """Let some rays, which had gone so far, arrive where some rows of another front are."""
        self.distance[index] = gone + to.distance[rows]
        for name in ("facing", *_OF_TRIANGLES):
            getattr(self, name)[index] = getattr(to, name)[rows]


_OF_TRIANGLES = ("surface", "label", "instance", "depth", "tint")


def trace(
    scenes: Sequence[RayScene],
    sensor: Sensor,
    pose: np.ndarray,
    ground: GroundLook,
    rng: np.random.Generator,
    speed: float = 0.0,
) -> Hits:
    """What each shot hits first, or where in foliage it ends.

    Args:
        scenes: what there is, in the street's frame.
        sensor: which shots are fired.
        pose: (4, 4) from the sensor's frame to the street's, when it looks ahead.
        ground: what triangles of class 0 are.
        rng: decides how deep pulses go into foliage.
        speed: of the sensor along its x, metres per second.
    """
    rays = fired(sensor)
    turn = pose[:3, :3].astype(np.float32)
    direction = rays.direction @ turn.T
    shift = np.zeros_like(direction)
    shift[:, 0] = speed * rays.time
    origin = (pose[:3, 3] + shift @ turn.T).astype(np.float32)
    front = _Front(scenes, origin, direction)
    _enter_foliage(front, scenes, origin, direction, rng)
    seen = np.flatnonzero(np.isfinite(front.distance))
    distance, label, surface, tint = (
        x[seen] for x in (front.distance, front.label, front.surface, front.tint)
    )
    bare = np.flatnonzero(label == 0)
    x, y = (origin[seen[bare], :2] + direction[seen[bare], :2] * distance[bare, None]).T
    label[bare] = ground.label(x, y)
    surface[bare], tint[bare] = ground_surface_table()[label[bare]], ground.tint(x, y, label[bare])
    cosine = np.where(front.depth[seen] > 0, LEAF_COSINE, np.abs(front.facing[seen]))
    kept = (
        rays.direction[seen],
        distance,
        cosine,
        surface,
        tint,
        label,
        front.instance[seen],
        rays.ring[seen],
    )
    return Hits(*kept, shift[seen])


def _enter_foliage(
    front: _Front,
    scenes: Sequence[RayScene],
    origin: np.ndarray,
    direction: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Move rays that hit foliage on to the leaf that they end at, or through to what is behind it."""
    index = np.flatnonzero(front.depth > 0)
    clumps = np.zeros(len(index), dtype=np.int32)  # that a ray is in: they overlap
    for _ in range(SKINS):
        if not len(index):
            return
        clumps += np.where(front.facing[index] < 0, 1, -1)
        on = front.distance[index] + BEYOND
        beyond = _Front(scenes, origin[index] + direction[index] * on[:, None], direction[index])
        free = rng.standard_exponential(len(index), dtype=np.float32) * front.depth[index]
        free[clumps <= 0] = np.inf
        stopped = free < beyond.distance
        front.distance[index[stopped]] += free[stopped]
        through = np.flatnonzero(~stopped)
        index, clumps = index[through], clumps[through]
        front.move(index, beyond, through, on[through])
        leafy = front.depth[index] > 0
        index, clumps = index[leafy], clumps[leafy]
