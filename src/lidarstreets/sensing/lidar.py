"""Casts the rays of a rotating LiDAR and finds what they hit."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Protocol

import numpy as np
from scipy.special import log_ndtr

from lidarstreets.chance import patchy_normal
from lidarstreets.errors import SimulationError
from lidarstreets.materials import GROUND_SURFACES, Label, Surface
from lidarstreets.mesh import Mesh, part
from lidarstreets.sensing.sensors import LidarModel

SHADOW_EDGE = 6.0  # degrees by which the edges of the car's shadow differ between lasers
MOST_CROSSINGS = 16  # surfaces of clumps of leaves that a pulse may cross on its way in and out
BEYOND = 0.002  # metres behind a surface at which a ray continues
CLUMP = (0.2, 0.7)  # metres across a clump of leaves, and correlation of how far pulses enter it
GAP = (0.6, 0.9)  # the same of gaps between clumps
OPENNESS = (1.5, 1.7)  # of gaps: median factor on the depth, and spread of its logarithm
LEAF_COSINE = 0.5  # mean cosine of the angle of incidence: leaves and blades point anywhere


def require_embree() -> tuple[ModuleType, ModuleType]:
    """Return the two modules of embreex that cast rays.

    Raises:
        SimulationError: if the extra `simulate` is not installed.
    """
    try:
        import trimesh  # noqa: F401  makes the spheres of the foliage
        from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise SimulationError(
            "simulation: expected trimesh and embreex to cast rays, found at least one missing; "
            'run pip install "amvnet[simulate]"'
        ) from error
    return rtcore_scene, mesh_construction


def take_one_thread() -> None:
    """Let this process cast rays with one thread, if it has not cast any yet.

    Embree counts the processors that it may use when it is first used; there is no other way to
    tell it. Does nothing on systems other than Linux.
    """
    if hasattr(os, "sched_setaffinity"):
        processors = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(processors)})
        triangle = part([np.eye(3)[None]], Surface.ASPHALT, Label.ROAD)
        RayScene(triangle).cast(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
        os.sched_setaffinity(0, processors)


class RayScene:
    """A mesh that rays can be cast at."""

    def __init__(self, mesh: Mesh) -> None:
        scenes, meshes = require_embree()
        self.mesh = mesh
        self._scene = scenes.EmbreeScene()
        self._triangles = meshes.TriangleMesh(self._scene, mesh.triangles)

        edges = mesh.triangles[:, 1:] - mesh.triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        self.normals = (normals / length).astype(np.float32)

    def cast(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distance and triangle of the first hit of each ray: (R,) and (R,).

        They are infinite and -1 if a ray hits nothing.
        """
        hits = self._scene.run(origin, direction, output=1)
        triangle = hits["primID"].astype(np.int64)
        return np.where(triangle >= 0, hits["tfar"], np.inf), triangle


class GroundAppearance(Protocol):
    """Class and tint of the ground, whose triangles have no class; all arrays are (N,)."""

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the class ids at places."""

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Return the tint at places, as in `Mesh`."""


@dataclass(frozen=True)
class Rays:
    """The shots of one rotation that the car does not block, in the sensor's frame.

    They are (R,) rows, sorted by laser from the top down, then by azimuth from +x: unit vectors,
    heights of their origins in metres, indices of the lasers (0 = lowest), and seconds from the
    moment when the sensor looks ahead.
    """

    direction: np.ndarray
    height: np.ndarray
    ring: np.ndarray
    time: np.ndarray


@dataclass(frozen=True)
class Hits:
    """What the rays of one rotation hit, in the sensor's frame.

    Attributes:
        direction: (N, 3) unit vectors.
        height: (N,) metres from the origin of the coordinates up to that of the ray.
        distance: (N,) metres along the ray.
        facing: (N,) cosine of the angle between ray and surface normal.
        cosine: (N,) the same, or its mean over the leaves and blades of plants.
        surface: (N,) rows of the reflection table.
        tint: (N,) as in `Mesh`.
        label, instance: (N,) class and instance ids.
        ring: (N,) index of the laser, 0 = lowest.
        shift: (N, 3) metres that the sensor had moved when it fired.
    """

    direction: np.ndarray
    height: np.ndarray
    distance: np.ndarray
    facing: np.ndarray
    cosine: np.ndarray
    surface: np.ndarray
    tint: np.ndarray
    label: np.ndarray
    instance: np.ndarray
    ring: np.ndarray
    shift: np.ndarray

    @property
    def places(self) -> np.ndarray:
        """(N, 3) metres from the origin of the ray to the surface."""
        return self.direction * self.distance[:, None]


@lru_cache(maxsize=4)
def rays_of(sensor: LidarModel) -> Rays:
    """Return the rays of one rotation; the arrays are shared and read-only."""
    lasers = len(sensor.elevations)
    elevation = np.radians(np.array(sensor.elevations))[:, None]

    # The lasers of a real device are not in one line: each has an azimuth offset of its own.
    offset = ((np.arange(lasers) * 0.618) % 1.0)[:, None]
    fraction = (np.arange(sensor.azimuth_steps) + offset) / sensor.azimuth_steps  # of a rotation
    azimuth = 2 * np.pi * fraction

    horizontal = np.cos(elevation)
    x = horizontal * np.cos(azimuth)
    y = horizontal * np.sin(azimuth)
    z = np.sin(elevation) + 0 * azimuth
    direction = np.stack([x, y, z], axis=-1).reshape(-1, 3)

    height = np.interp(sensor.elevations, *np.transpose(sensor.origins))
    height = np.repeat(height, sensor.azimuth_steps)
    ring = np.repeat(np.arange(lasers, dtype=np.uint8)[::-1], sensor.azimuth_steps)
    sign = 1 if sensor.counter_clockwise else -1
    time = sensor.rotation_period * ((fraction + 0.5) % 1 - 0.5) * sign

    free = ~_is_hidden(sensor)
    rays = Rays(
        direction=direction[free].astype(np.float32),
        height=height[free].astype(np.float32),
        ring=ring[free],
        time=time.ravel()[free].astype(np.float32),
    )
    for array in (rays.direction, rays.height, rays.ring, rays.time):
        array.flags.writeable = False
    return rays


def _is_hidden(sensor: LidarModel) -> np.ndarray:
    """Return whether the car blocks each shot, laser by laser: (R,) bool."""
    elevation = np.array(sensor.elevations)[:, None]
    azimuth = np.arange(sensor.azimuth_steps) * 360 / sensor.azimuth_steps

    # The edges differ between lasers, which look out of the device at different places.
    offset = (np.arange(len(elevation)) * 0.382) % 1.0 - 0.5
    azimuth = azimuth + SHADOW_EDGE * offset[:, None]

    hidden = np.zeros((len(elevation), sensor.azimuth_steps), dtype=bool)
    for start, end, lowest, highest in sensor.shadow:
        within_azimuth = (azimuth - start) % 360 < end - start
        hidden |= within_azimuth & (elevation > lowest) & (elevation < highest)
    return hidden.ravel()


class _NearestHits:
    """The nearest hit of each of R rays over all scenes; all columns are (R,).

    The columns of `Mesh` describe the triangle that is hit. The distance is infinite if a ray hits
    none; `facing`, the product of ray and normal, is negative if the ray comes from outside.
    """

    def __init__(
        self, scenes: Sequence[RayScene], origin: np.ndarray, direction: np.ndarray
    ) -> None:
        count = len(direction)
        self.distance = np.full(count, np.inf, dtype=np.float32)
        self.facing = np.zeros(count, dtype=np.float32)
        self.surface = np.zeros(count, dtype=np.uint8)
        self.label = np.zeros(count, dtype=np.uint16)
        self.instance = np.zeros(count, dtype=np.uint16)
        self.depth = np.zeros(count, dtype=np.float32)
        self.tint = np.zeros(count, dtype=np.float32)

        for scene in scenes:
            distance, triangle = scene.cast(origin, direction)
            nearer = np.flatnonzero(distance < self.distance)
            hit = triangle[nearer]
            self.distance[nearer] = distance[nearer]
            self.facing[nearer] = np.einsum("ij,ij->i", scene.normals[hit], direction[nearer])
            for name in _MESH_COLUMNS:
                getattr(self, name)[nearer] = getattr(scene.mesh, name)[hit]

    def replace(
        self, index: np.ndarray, hits: _NearestHits, rows: np.ndarray, start: np.ndarray
    ) -> None:
        """Replace the hits of some rays by rows of others, whose rays began at `start` metres."""
        self.distance[index] = start + hits.distance[rows]
        for name in ("facing", *_MESH_COLUMNS):
            getattr(self, name)[index] = getattr(hits, name)[rows]


_MESH_COLUMNS = ("surface", "label", "instance", "depth", "tint")


def trace(
    scenes: Sequence[RayScene],
    sensor: LidarModel,
    pose: np.ndarray,
    ground: GroundAppearance,
    rng: np.random.Generator,
    speed: float = 0.0,
) -> Hits:
    """Return what each shot of one rotation hits first, or where it ends in foliage.

    The pose is the (4, 4) transform from the sensor's frame to the frame of the street, when the
    sensor looks ahead; the speed is along its x axis in metres per second.
    """
    rays = rays_of(sensor)
    rotation = pose[:3, :3].astype(np.float32)
    direction = rays.direction @ rotation.T
    shift = np.zeros_like(direction)
    shift[:, 0] = speed * rays.time
    start = shift.copy()
    start[:, 2] += rays.height
    origin = (pose[:3, 3] + start @ rotation.T).astype(np.float32)

    nearest = _NearestHits(scenes, origin, direction)
    _enter_foliage(nearest, scenes, origin, direction, rng)

    hit = np.flatnonzero(np.isfinite(nearest.distance))
    distance = nearest.distance[hit]
    label = nearest.label[hit]
    surface = nearest.surface[hit]
    tint = nearest.tint[hit]

    # The ground's triangles have no class: ask the ground for it.
    bare = np.flatnonzero(label == 0)
    x, y = (origin[hit[bare], :2] + direction[hit[bare], :2] * distance[bare, None]).T
    label[bare] = ground.label(x, y)
    for ground_label, ground_surface in GROUND_SURFACES.items():
        surface[bare[label[bare] == ground_label]] = ground_surface
    tint[bare] = ground.tint(x, y, label[bare])

    facing = np.abs(nearest.facing[hit])
    has_leaves = (nearest.depth[hit] > 0) | np.isin(surface, (Surface.GRASS, Surface.LEAF))

    return Hits(
        direction=rays.direction[hit],
        height=rays.height[hit],
        distance=distance,
        facing=facing,
        cosine=np.where(has_leaves, LEAF_COSINE, facing),
        surface=surface,
        tint=tint,
        label=label,
        instance=nearest.instance[hit],
        ring=rays.ring[hit],
        shift=shift[hit],
    )


def _enter_foliage(
    nearest: _NearestHits,
    scenes: Sequence[RayScene],
    origin: np.ndarray,
    direction: np.ndarray,
    rng: np.random.Generator,
) -> None:
    """Extend rays that hit foliage to the leaf that stops them, or to the surface behind it.

    The distance inside is exponentially distributed. Its mean is the depth of the foliage times a
    factor that differs from gap to gap.
    """
    index = np.flatnonzero(nearest.depth > 0)  # of the rays that are still on their way
    clumps = np.zeros(len(index), dtype=np.int32)  # that each ray is inside of: clumps overlap

    for _ in range(MOST_CROSSINGS):
        if not len(index):
            return

        # Each ray has reached the surface of a clump: look for the next surface behind it.
        clumps += np.where(nearest.facing[index] < 0, 1, -1)
        start = nearest.distance[index] + BEYOND
        next_origin = origin[index] + direction[index] * start[:, None]
        behind = _NearestHits(scenes, next_origin, direction[index])

        # Between the two surfaces, a leaf may stop it.
        leafless = patchy_normal(rng, next_origin, *CLUMP)
        gap = patchy_normal(rng, next_origin, *GAP)
        depth = OPENNESS[0] * np.exp(OPENNESS[1] * gap) * nearest.depth[index]
        free_path = -log_ndtr(leafless) * depth
        free_path[clumps <= 0] = np.inf
        stops = free_path < behind.distance
        nearest.distance[index[stops]] += free_path[stops]

        # The other rays reach the next surface; they continue if it is foliage.
        rows = np.flatnonzero(~stops)
        index = index[rows]
        clumps = clumps[rows]
        nearest.replace(index, behind, rows, start[rows])
        leafy = nearest.depth[index] > 0
        index = index[leafy]
        clumps = clumps[leafy]
