"""Cast the rays of a rotating LiDAR and find what they hit."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from lidarstreets.chance import patchy_normal
from lidarstreets.errors import SimulationError
from lidarstreets.materials import GROUND_SURFACES, Label, Surface
from lidarstreets.mesh import Mesh, part
from lidarstreets.sensing.sensors import LidarModel

SHADOW_EDGE = 6.0  # largest difference of the edges of the car's shadow between lasers, degrees
MAX_CROSSINGS = 16  # largest number of surfaces of foliage that a pulse crosses on its way
RESTART_DISTANCE = 0.002  # distance behind a surface at which its ray continues, metres
# Arguments of `patchy_normal`, patch in metres and correlation: for how far pulses enter a clump of
# leaves, and for the gaps between clumps.
CLUMP_PATCH = (0.2, 0.7)
GAP_PATCH = (0.6, 0.9)
# Median of the factor on the depth of foliage in a gap, and standard deviation of its logarithm.
GAP_OPENNESS = (1.5, 1.7)
LEAF_COSINE = 0.5  # mean cosine of the angle of incidence on leaves, which point anywhere


def require_embree() -> tuple[ModuleType, ModuleType]:
    """Return the modules `rtcore_scene` and `mesh_construction` of embreex, which cast rays.

    Raises:
        SimulationError: if the extra `simulate` is not installed.
    """
    try:
        with _signals_at_the_end():
            import trimesh.creation  # noqa: F401  makes the spheres of the foliage
            from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise SimulationError(
            "simulation: expected trimesh and embreex to cast rays, found at least one missing; "
            'run pip install "amvnet[simulate]"'
        ) from error
    return rtcore_scene, mesh_construction


@contextmanager
def _signals_at_the_end() -> Iterator[None]:
    """Let SIGINT and SIGTERM wait: trimesh drops all exceptions while it is imported."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    handlers = {}
    for number in (signal.SIGINT, signal.SIGTERM):
        handlers[number] = signal.signal(number, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    for heard in waiting:
        signal.raise_signal(heard)


def take_one_thread() -> None:
    """Let this process cast rays with one thread. Call this before it casts its first ray.

    When Embree is first used, it counts the processors that it may use, and takes as many threads.
    There is no other way to set their number. Do nothing on systems other than Linux.
    """
    if hasattr(os, "sched_setaffinity"):
        processors = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(processors)})
        triangle = part([np.eye(3)[None]], Surface.ASPHALT, Label.ROAD)
        RayScene(triangle).cast(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
        os.sched_setaffinity(0, processors)


class RayScene:
    """A mesh that rays can be cast at.

    Raises:
        SimulationError: if embreex is missing.
    """

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
        """Return how far each of R rays travels, and the triangle that it hits.

        Args:
            origin: (R, 3) float32 starts of the rays, metres.
            direction: (R, 3) float32 unit vectors.

        Returns:
            (R,) distances in metres, infinite if a ray hits nothing; and (R,) int64 indices of the
            triangles, -1 if a ray hits nothing.
        """
        hits = self._scene.run(origin, direction, output=1)
        triangle = hits["primID"].astype(np.int64)
        return np.where(triangle >= 0, hits["tfar"], np.inf), triangle


class GroundAppearance(Protocol):
    """The class and the tint of the ground, whose triangles have neither; all arrays are (N,)."""

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the class ids at the places x, y, metres."""

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Return the tints at the places x, y, metres, as in `Mesh`."""


@dataclass(frozen=True)
class Rays:
    """R shots of one rotation, in the sensor's frame.

    They are sorted by laser from the top down, then by azimuth from +x.

    Attributes:
        direction: (R, 3) float32 unit vectors.
        height: (R,) float32 heights of their origins, metres.
        ring: (R,) uint8 indices of the lasers; 0 is the lowest laser.
        time: (R,) float32 seconds after the moment when the sensor looks ahead.
    """

    direction: np.ndarray
    height: np.ndarray
    ring: np.ndarray
    time: np.ndarray


@dataclass(frozen=True)
class Hits:
    """What the rays of one rotation hit, in the sensor's frame: N hits.

    Attributes:
        direction: (N, 3) unit vectors of the rays.
        height: (N,) heights of the origins of the rays over the origin of the frame, metres.
        distance: (N,) distances along the rays, metres.
        facing: (N,) cosines of the angles between rays and surface normals, 0 to 1.
        cosine: (N,) the same cosines; for leaves and blades of grass their mean `LEAF_COSINE`.
        surface: (N,) values of `Surface`.
        tint: (N,) tints, as in `Mesh`.
        label: (N,) class ids.
        instance: (N,) instance ids; 0 is no instance.
        ring: (N,) indices of the lasers; 0 is the lowest laser.
        shift: (N, 3) how far the sensor had moved when it fired, metres.
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
    def places(self) -> NDArray[np.float32]:
        """The vectors from the origins of the rays to the surfaces: (N, 3), metres."""
        places: NDArray[np.float32] = self.direction * self.distance[:, None]
        return places


@lru_cache(maxsize=4)
def rays_of(sensor: LidarModel, blocked: bool = False) -> Rays:
    """Return the rays of one rotation; the arrays are shared and read-only.

    Args:
        blocked: return the rays that the car blocks, instead of the others.
    """
    lasers = len(sensor.elevations)
    elevation = np.radians(np.array(sensor.elevations))[:, None]

    # The lasers of a real device do not form one line: each has its own offset in azimuth.
    offset = ((np.arange(lasers) * 0.618) % 1.0)[:, None]
    fraction = (np.arange(sensor.azimuth_steps) + offset) / sensor.azimuth_steps  # of a rotation
    azimuth = 2 * np.pi * fraction
    # The device reports the last whole unit that it passed.
    if sensor.azimuth_unit:
        unit = np.radians(sensor.azimuth_unit)
        azimuth = unit * (np.floor(azimuth / unit) + offset)

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

    chosen = _is_hidden(sensor) == blocked
    rays = Rays(
        direction=direction[chosen].astype(np.float32),
        height=height[chosen].astype(np.float32),
        ring=ring[chosen],
        time=time.ravel()[chosen].astype(np.float32),
    )
    for array in (rays.direction, rays.height, rays.ring, rays.time):
        array.flags.writeable = False
    return rays


def _is_hidden(sensor: LidarModel) -> np.ndarray:
    """Return whether the car blocks each shot, laser by laser: (R,) bool."""
    elevation = np.array(sensor.elevations)[:, None]
    azimuth = np.arange(sensor.azimuth_steps) * 360 / sensor.azimuth_steps

    # The edges of the shadow differ, because the lasers look out of the device at different places.
    offset = (np.arange(len(elevation)) * 0.382) % 1.0 - 0.5
    azimuth = azimuth + SHADOW_EDGE * offset[:, None]

    hidden = np.zeros((len(elevation), sensor.azimuth_steps), dtype=bool)
    for start, end, lowest, highest in sensor.shadow:
        within_azimuth = (azimuth - start) % 360 < end - start
        hidden |= within_azimuth & (elevation > lowest) & (elevation < highest)
    return hidden.ravel()


class _NearestHits:
    """The nearest hit of each of R rays over all scenes; all columns are (R,).

    The columns of `Mesh` describe the triangle that a ray hits. The distance is infinite if the ray
    hits nothing. `facing`, the dot product of ray and normal, is negative if the ray comes from
    outside.
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
        """Replace the hits of the rays `index` by the rows `rows` of other hits.

        Those rays began at `start` metres along the rays of this object.
        """
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

    Args:
        scenes: the meshes, in the frame of the street.
        pose: (4, 4) transform from the sensor's frame to the frame of the street at the moment when
            the sensor looks ahead.
        ground: gives the class and the tint of triangles without a class.
        rng: draws where rays end in foliage.
        speed: speed of the sensor along its x axis, metres per second.

    Raises:
        SimulationError: if embreex is missing.
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

    The distance that a ray travels inside is exponentially distributed. Its mean is the depth of
    the foliage times a factor that differs from gap to gap.
    """
    index = np.flatnonzero(nearest.depth > 0)  # indices of the rays that are still on their way
    clumps = np.zeros(len(index), dtype=np.int32)  # number of clumps around the end of each ray

    for _ in range(MAX_CROSSINGS):
        if not len(index):
            return

        # Each ray has reached the surface of a clump: find the next surface behind it.
        clumps += np.where(nearest.facing[index] < 0, 1, -1)
        start = nearest.distance[index] + RESTART_DISTANCE
        next_origin = origin[index] + direction[index] * start[:, None]
        behind = _NearestHits(scenes, next_origin, direction[index])

        # Between the two surfaces, a leaf may stop the ray.
        leafless = patchy_normal(rng, next_origin, *CLUMP_PATCH)
        gap = patchy_normal(rng, next_origin, *GAP_PATCH)
        depth = GAP_OPENNESS[0] * np.exp(GAP_OPENNESS[1] * gap) * nearest.depth[index]
        free_path = -log_ndtr(leafless) * depth
        free_path[clumps <= 0] = np.inf
        stops = free_path < behind.distance
        nearest.distance[index[stops]] += free_path[stops]

        # The other rays reach the next surface, and continue if it is foliage.
        rows = np.flatnonzero(~stops)
        index = index[rows]
        clumps = clumps[rows]
        nearest.replace(index, behind, rows, start[rows])
        leafy = nearest.depth[index] > 0
        index = index[leafy]
        clumps = clumps[leafy]
