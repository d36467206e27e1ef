"""A spinning LiDAR: which rays it fires, what they hit, and which returns come back how bright."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import ModuleType

import numpy as np

from amvnet.errors import InputError
from amvnet.simulation.materials import ground_surface_table, reflection_table
from amvnet.simulation.mesh import Mesh
from amvnet.simulation.sensors import Sensor

MIXED_FROM, MIXED_TO = 0.3, 3.0  # metres: steps in depth within which one pulse gives one return in between


def require_embree() -> tuple[ModuleType, ModuleType]:
    """The two modules of embreex that cast rays.

    Raises:
        InputError: where the extra `simulate` is not installed.
    """
    try:
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
        corners = np.ascontiguousarray(mesh.triangles.reshape(-1, 3))
        self._kept = meshes.TriangleMesh(self._scene, corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
        edges = mesh.triangles[:, 1:] - mesh.triangles[:, :1]
        normals = np.cross(edges[:, 0], edges[:, 1])
        self.normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

    def cast(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance and triangle of the first hit of each ray; infinite and -1 where there is none. (R,), (R,)."""
        origins = np.broadcast_to(origin.astype(np.float32), directions.shape).copy()
        found = self._scene.run(origins, directions, output=1)
        triangle = found["primID"].astype(np.int64)
        return np.where(triangle >= 0, found["tfar"], np.inf), triangle


@dataclass(frozen=True)
class Hits:
    """What the rays of one turn hit, in the sensor's frame.

    Attributes:
        direction: (N, 3) unit vectors.
        distance: (N,) metres.
        cosine: (N,) of the angle between ray and surface normal.
        surface: (N,) rows of the reflection table.
        label: (N,) class ids.
        instance: (N,) instance ids.
        ring: (N,) index of the laser, 0 = lowest.
        shots: number of shots of the turn.
    """

    direction: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray
    surface: np.ndarray
    label: np.ndarray
    instance: np.ndarray
    ring: np.ndarray
    shots: int


@lru_cache(maxsize=4)
def fired(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Directions of all shots that the own car lets out, laser by laser from the top, azimuth from +x, and rings.

    Returns:
        (R, 3) float32 and (R,) uint8, 0 = lowest.
    """
    elevation = np.radians(np.array(sensor.elevations))[:, None]
    # The lasers of a real device do not sit on one line: each is turned by a little of its own.
    skew = ((np.arange(len(elevation)) * 0.618) % 1.0)[:, None]
    azimuth = (np.arange(sensor.azimuth_steps) + skew) * 2 * np.pi / sensor.azimuth_steps
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1)
    free = ~_hidden(sensor)
    rays = rays.reshape(-1, 3)[free].astype(np.float32)
    ring = np.repeat(np.arange(len(sensor.elevations), dtype=np.uint8)[::-1], sensor.azimuth_steps)[free]
    for array in (rays, ring):
        array.flags.writeable = False
    return rays, ring


def _hidden(sensor: Sensor) -> np.ndarray:
    """(R,) True where the own car stops a shot; laser by laser."""
    elevation = np.array(sensor.elevations)[:, None]
    azimuth = np.arange(sensor.azimuth_steps) * 360 / sensor.azimuth_steps
    hidden = np.zeros((len(elevation), sensor.azimuth_steps), dtype=bool)
    for start, end, low, high in sensor.shadow:
        hidden |= ((azimuth - start) % 360 < end - start) & (elevation > low) & (elevation < high)
    return hidden.ravel()


GroundLabel = Callable[[np.ndarray, np.ndarray], np.ndarray]


def trace(scenes: Sequence[RayScene], sensor: Sensor, pose: np.ndarray, ground_label: GroundLabel) -> Hits:
    """What each shot hits first; pose (4, 4) maps the sensor's frame to the street's."""
    rays, ring = fired(sensor)
    turned = (rays @ pose[:3, :3].T.astype(np.float32)).astype(np.float32)
    distance = np.full(len(rays), np.inf)
    cosine, surface = np.zeros(len(rays)), np.zeros(len(rays), dtype=np.uint8)
    label, instance = np.zeros((2, len(rays)), dtype=np.uint16)
    for scene in scenes:
        far, triangle = scene.cast(pose[:3, 3], turned)
        hit = np.flatnonzero(far < distance)
        struck = triangle[hit]
        distance[hit] = far[hit]
        cosine[hit] = np.abs((scene.normals[struck] * turned[hit]).sum(axis=1))
        surface[hit], label[hit] = scene.mesh.surface[struck], scene.mesh.label[struck]
        instance[hit] = scene.mesh.instance[struck]
    seen = np.isfinite(distance)
    ground = np.flatnonzero(seen & (label == 0))
    spot = pose[:2, 3] + turned[ground, :2] * distance[ground, None]
    label[ground] = ground_label(spot[:, 0], spot[:, 1])
    surface[ground] = ground_surface_table()[label[ground]]
    shots = len(sensor.elevations) * sensor.azimuth_steps
    return Hits(rays[seen], distance[seen], cosine[seen], surface[seen], label[seen], instance[seen], ring[seen], shots)


def receive(hits: Hits, sensor: Sensor, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points and labels that come back from the hits: noise, brightness, lost returns.

    Returns:
        (N, 4) float32 x, y, z, intensity, (N,) uint32 class ids with the instance in the upper half, and (N,)
        uint8 rings.
    """
    reflectivity, spread, dark, drop = reflection_table()[hits.surface].T
    count = len(hits.distance)
    # The received power falls with the square of the range; the return is lost where it drowns in noise.
    reach = sensor.reach * np.sqrt(reflectivity * np.maximum(hits.cosine, 1e-3))
    kept = 1 / (1 + (hits.distance / reach) ** 6) * (1 - drop) * (1 - sensor.drop)
    distance = _mixed(hits, sensor, rng) + rng.normal(scale=sensor.range_noise, size=count)
    kept[(distance < sensor.min_range) | (distance > sensor.max_range)] = 0
    # The device evens out range and incidence, but not wholly.
    shade = np.maximum(hits.cosine, 1e-3) ** 0.12 * (1 - 0.2 * hits.distance / sensor.max_range)
    intensity = reflectivity * shade * (1 + spread * rng.normal(size=count))
    intensity[rng.random(count) < dark] = 0
    intensity = np.clip(np.round(sensor.gain * intensity, 2 if sensor.gain == 1 else 3), 0, 0.99)
    back = rng.random(count) < kept
    points = np.column_stack([hits.direction * distance[:, None], intensity])[back].astype(np.float32)
    label = hits.label[back].astype(np.uint32) | hits.instance[back].astype(np.uint32) << np.uint32(16)
    if not sensor.keeps_lost:
        return points, label, hits.ring[back]
    lost, rings = _lost(hits, sensor, hits.ring[back], rng)
    zeros = np.zeros(len(lost), dtype=np.uint32)
    return np.concatenate([points, lost]), np.concatenate([label, zeros]), np.concatenate([hits.ring[back], rings])


def _lost(hits: Hits, sensor: Sensor, back: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The rows that nuScenes has for shots without a return: near the sensor, most of them behind its right side."""
    missing = sensor.azimuth_steps - np.bincount(back, minlength=len(sensor.elevations))
    ring = np.repeat(np.arange(len(missing), dtype=np.uint8), missing)
    one_side = rng.random(len(ring)) < 0.65
    azimuth = np.where(one_side, rng.normal(np.radians(165), 0.15, len(ring)), rng.uniform(-np.pi, np.pi, len(ring)))
    distance = np.minimum(rng.exponential(0.25, len(ring)), 0.99)
    elevation = np.where(one_side, rng.normal(-0.04, 0.03, len(ring)), rng.normal(-0.3, 0.3, len(ring)))
    level = np.cos(elevation)
    direction = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    bright = np.where(rng.random(len(ring)) < 0.1, 0.2, 0.008)
    return np.column_stack([distance[:, None] * direction, bright]).astype(np.float32), ring


def _mixed(hits: Hits, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """(N,) distances, of which some at edges lie between both surfaces: a beam is as wide as the step to the next."""
    step = np.diff(hits.distance, append=hits.distance[-1:])
    neighbours = (hits.direction * np.roll(hits.direction, -1, axis=0)).sum(axis=1) > np.cos(np.radians(0.5))
    edge = neighbours & (np.abs(step) > MIXED_FROM) & (np.abs(step) < MIXED_TO) & (rng.random(len(step)) < sensor.mixed)
    return hits.distance + np.where(edge, rng.random(len(step)) * step, 0)
