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

MIXED_FROM, MIXED_TO = 0.3, 3.0  # metres: steps in depth within which one pulse gives one return in between


@dataclass(frozen=True)
class Sensor:
    """A LiDAR as a table of numbers."""

    # Elevation of each laser in degrees, from the top down: the order in which points are written.
    elevations: tuple[float, ...]
    # Shots of each laser per turn.
    azimuth_steps: int
    # Height above the ground in metres.
    height: float
    # Nearest and farthest range that is measured, in metres.
    min_range: float
    max_range: float
    # Standard deviation of the range in metres.
    range_noise: float
    # Share of the returns that are lost whatever they hit.
    drop: float
    # Range in metres at which half the returns of a white, head-on surface are lost.
    reach: float
    # Share of the returns at an edge in depth that lie somewhere between the two surfaces.
    mixed: float
    # What the own car and its racks hide: azimuth from and to, elevation from and to, in degrees.
    shadow: tuple[tuple[float, float, float, float], ...]


# The elevations are medians over points of KITTI's scans, laser by laser; so are the places that its car hides.
HDL64E = Sensor(
    elevations=(
        2.59,
        2.20,
        1.96,
        1.51,
        1.22,
        0.81,
        0.54,
        0.17,
        -0.18,
        -0.59,
        -0.89,
        -1.23,
        -1.58,
        -1.89,
        -2.17,
        -2.52,
        -2.84,
        -3.25,
        -3.51,
        -3.92,
        -4.22,
        -4.56,
        -4.89,
        -5.18,
        -5.54,
        -5.85,
        -6.14,
        -6.41,
        -6.77,
        -7.14,
        -7.38,
        -7.76,
        -8.38,
        -8.90,
        -9.35,
        -9.74,
        -10.20,
        -10.80,
        -11.30,
        -11.72,
        -12.17,
        -12.60,
        -13.12,
        -13.64,
        -14.21,
        -14.64,
        -15.14,
        -15.51,
        -16.13,
        -16.66,
        -17.21,
        -17.67,
        -18.16,
        -18.58,
        -19.01,
        -19.58,
        -20.07,
        -20.71,
        -21.17,
        -21.59,
        -22.01,
        -22.67,
        -23.13,
        -23.64,
    ),
    azimuth_steps=2180,
    height=1.73,
    min_range=1.5,
    max_range=80.0,
    range_noise=0.015,
    drop=0.01,
    reach=560.0,
    mixed=0.06,
    shadow=(
        (-14, 14, -90, -20.9),
        (14, 20, -90, -21.9),
        (28, 32, -90, -22.9),
        (132, 142, -90, -19.7),
        (159, 167, -90, -13.0),
        (196, 206, -90, -13.0),
        (160, 208, -90, -18.1),
        (150, 214, -90, -22.4),
        (230, 240, -90, -19.7),
        (284, 304, -22.9, -15.8),
        (328, 332, -90, -21.9),
        (336, 340, -90, -21.9),
    ),
)
SENSORS: dict[str, Sensor] = {"hdl64e": HDL64E}


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
        label: (N,) raw class ids.
        instance: (N,) instance ids.
    """

    direction: np.ndarray
    distance: np.ndarray
    cosine: np.ndarray
    surface: np.ndarray
    label: np.ndarray
    instance: np.ndarray


@lru_cache(maxsize=4)
def fired(sensor: Sensor) -> np.ndarray:
    """Directions of all shots that the own car lets out, laser by laser from the top, azimuth from +x. (R, 3)."""
    elevation = np.radians(np.array(sensor.elevations))[:, None]
    # The lasers of a real device do not sit on one line: each is turned by a little of its own.
    skew = ((np.arange(len(elevation)) * 0.618) % 1.0)[:, None]
    azimuth = (np.arange(sensor.azimuth_steps) + skew) * 2 * np.pi / sensor.azimuth_steps
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1)
    rays = rays.reshape(-1, 3)[~_hidden(sensor)].astype(np.float32)
    rays.flags.writeable = False
    return rays


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
    rays = fired(sensor)
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
    return Hits(rays[seen], distance[seen], cosine[seen], surface[seen], label[seen], instance[seen])


def receive(hits: Hits, sensor: Sensor, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The points and labels that come back from the hits: noise, brightness, lost returns.

    Returns:
        (N, 4) float32 x, y, z, intensity and (N,) uint32 raw labels with the instance in the upper half.
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
    intensity = np.round(np.clip(intensity, 0, 0.99), 2)
    back = rng.random(count) < kept
    points = np.column_stack([hits.direction * distance[:, None], intensity])[back].astype(np.float32)
    label = hits.label[back].astype(np.uint32) | hits.instance[back].astype(np.uint32) << np.uint32(16)
    return points, label


def _mixed(hits: Hits, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """(N,) distances, of which some at edges lie between both surfaces: a beam is as wide as the step to the next."""
    step = np.diff(hits.distance, append=hits.distance[-1:])
    neighbours = (hits.direction * np.roll(hits.direction, -1, axis=0)).sum(axis=1) > np.cos(np.radians(0.5))
    edge = neighbours & (np.abs(step) > MIXED_FROM) & (np.abs(step) < MIXED_TO) & (rng.random(len(step)) < sensor.mixed)
    return hits.distance + np.where(edge, rng.random(len(step)) * step, 0)
