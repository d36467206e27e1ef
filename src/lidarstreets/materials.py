"""The classes of a simulated street, and how each kind of surface reflects a laser pulse."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np


class Label(IntEnum):
    """A class of a simulated street.

    The values are raw SemanticKITTI ids; those from 300 are classes that only nuScenes has.
    """

    OUTLIER = 1
    CAR = 10
    BICYCLE = 11
    BUS = 13
    MOTORCYCLE = 15
    TRUCK = 18
    OTHER_VEHICLE = 20
    PERSON = 30
    BICYCLIST = 31
    MOTORCYCLIST = 32
    ROAD = 40
    PARKING = 44
    SIDEWALK = 48
    OTHER_GROUND = 49
    BUILDING = 50
    FENCE = 51
    OTHER_STRUCTURE = 52
    LANE_MARKING = 60
    VEGETATION = 70
    TRUNK = 71
    TERRAIN = 72
    POLE = 80
    TRAFFIC_SIGN = 81
    OTHER_OBJECT = 99
    BARRIER = 300
    TRAFFIC_CONE = 301
    CONSTRUCTION_VEHICLE = 302
    TRAILER = 303


# The raw SemanticKITTI id of moving bodies, by class. Other classes have no such id.
MOVING = {
    Label.CAR: 252,
    Label.BICYCLIST: 253,
    Label.PERSON: 254,
    Label.MOTORCYCLIST: 255,
    Label.BUS: 257,
    Label.TRUCK: 258,
    Label.OTHER_VEHICLE: 259,
}

# The SemanticKITTI class that is written in place of each class that only nuScenes has.
SEMANTICKITTI_IDS = {
    Label.BARRIER: Label.OTHER_STRUCTURE,
    Label.TRAFFIC_CONE: Label.OTHER_OBJECT,
    Label.CONSTRUCTION_VEHICLE: Label.OTHER_VEHICLE,
    Label.TRAILER: Label.OTHER_VEHICLE,
}

# The nuScenes-lidarseg category of each class; those without one, outliers, are noise.
NUSCENES_CATEGORIES = {
    Label.CAR: "vehicle.car",
    Label.BICYCLE: "vehicle.bicycle",
    Label.BUS: "vehicle.bus.rigid",
    Label.MOTORCYCLE: "vehicle.motorcycle",
    Label.TRUCK: "vehicle.truck",
    Label.OTHER_VEHICLE: "vehicle.trailer",
    Label.PERSON: "human.pedestrian.adult",
    Label.BICYCLIST: "vehicle.bicycle",  # nuScenes counts riders as part of the vehicle
    Label.MOTORCYCLIST: "vehicle.motorcycle",
    Label.ROAD: "flat.driveable_surface",
    Label.PARKING: "flat.driveable_surface",
    Label.SIDEWALK: "flat.sidewalk",
    Label.OTHER_GROUND: "flat.other",
    Label.BUILDING: "static.manmade",
    Label.FENCE: "static.manmade",
    Label.OTHER_STRUCTURE: "static.manmade",
    Label.LANE_MARKING: "flat.driveable_surface",
    Label.VEGETATION: "static.vegetation",
    Label.TRUNK: "static.vegetation",
    Label.TERRAIN: "flat.terrain",
    Label.POLE: "static.manmade",
    Label.TRAFFIC_SIGN: "static.manmade",
    Label.OTHER_OBJECT: "static.other",
    Label.BARRIER: "movable_object.barrier",
    Label.TRAFFIC_CONE: "movable_object.trafficcone",
    Label.CONSTRUCTION_VEHICLE: "vehicle.construction",
    Label.TRAILER: "vehicle.trailer",
}


class Surface(IntEnum):
    """A kind of surface; the value is its row in `reflection_table`."""

    ASPHALT = 0
    PAVING = 1
    GRASS = 2
    GRAVEL = 3
    ROAD_PAINT = 4
    PLASTER = 5
    BRICK = 6
    GLASS = 7
    WOOD = 8
    LEAF = 9
    BARK = 10
    METAL = 11
    SIGN_FACE = 12
    CLOTH = 13
    SKIN = 14
    DARK_PAINT = 15
    LIGHT_PAINT = 16
    RUBBER = 17
    PLATE = 18
    PLASTIC = 19
    ROOF_TILE = 20
    WINDOW = 21
    STONE = 22
    TWIG = 23


@dataclass(frozen=True)
class Reflection:
    """How one kind of surface reflects a laser pulse, as measured on KITTI's scans."""

    # Intensity in [0, 1] that an HDL-64E reports for a near surface that is hit head-on.
    reflectivity: float
    # Standard deviation of the intensity between returns of one body, relative to its mean.
    spread: float
    # Standard deviation of the logarithm of the reflectivity between bodies.
    shade: float
    # Share of the returns with intensity 0: glossy surfaces reflect most of the light elsewhere.
    dark: float = 0.02
    # Share of the pulses that never return, whatever the range.
    drop: float = 0.0
    # Mean height in metres of relief, such as grass, that is too fine to model with triangles.
    rough: float = 0.0
    # Share of the returns that come from a mirrored body and so from farther along the ray.
    ghost: float = 0.0


REFLECTIONS: dict[Surface, Reflection] = {
    Surface.ASPHALT: Reflection(0.30, spread=0.11, shade=0.14, dark=0.004),
    Surface.PAVING: Reflection(0.33, spread=0.09, shade=0.12, dark=0.003),
    Surface.GRASS: Reflection(0.39, spread=0.12, shade=0.10, dark=0.004, rough=0.018),
    Surface.GRAVEL: Reflection(0.33, spread=0.13, shade=0.15, dark=0.01, rough=0.004),
    Surface.ROAD_PAINT: Reflection(0.55, spread=0.20, shade=0.15),
    Surface.PLASTER: Reflection(0.42, spread=0.10, shade=0.25, drop=0.01),
    Surface.BRICK: Reflection(0.38, spread=0.12, shade=0.25, drop=0.01, rough=0.002),
    Surface.GLASS: Reflection(0.10, spread=0.50, shade=0.50, dark=0.75, drop=0.65, ghost=0.04),
    Surface.WOOD: Reflection(0.38, spread=0.13, shade=0.25, rough=0.003),
    Surface.LEAF: Reflection(0.36, spread=0.23, shade=0.17, dark=0.05, drop=0.03),
    Surface.BARK: Reflection(0.37, spread=0.28, shade=0.20, dark=0.05, rough=0.010),
    Surface.METAL: Reflection(0.28, spread=0.26, shade=0.50, dark=0.12, drop=0.03, rough=0.004),
    Surface.SIGN_FACE: Reflection(0.50, spread=0.20, shade=0.40),
    Surface.CLOTH: Reflection(0.46, spread=0.20, shade=0.25, rough=0.006),
    Surface.SKIN: Reflection(0.45, spread=0.20, shade=0.10, dark=0.03),
    Surface.DARK_PAINT: Reflection(
        0.04, spread=0.50, shade=0.90, dark=0.30, drop=0.12, rough=0.002
    ),
    Surface.LIGHT_PAINT: Reflection(
        0.26, spread=0.30, shade=0.45, dark=0.08, drop=0.05, rough=0.002
    ),
    Surface.RUBBER: Reflection(0.08, spread=0.50, shade=0.40, dark=0.40, drop=0.10),
    Surface.PLATE: Reflection(0.95, spread=0.10, shade=0.10, dark=0.0),
    Surface.PLASTIC: Reflection(0.34, spread=0.20, shade=0.40, dark=0.06, drop=0.03),
    Surface.ROOF_TILE: Reflection(0.33, spread=0.13, shade=0.20, drop=0.01, rough=0.003),
    # The window of a house. Unlike a car's, it has curtains and frames that reflect.
    Surface.WINDOW: Reflection(
        0.30, spread=0.30, shade=0.40, dark=0.12, drop=0.25, rough=0.01, ghost=0.02
    ),
    Surface.STONE: Reflection(0.36, spread=0.16, shade=0.25, rough=0.014),
    Surface.TWIG: Reflection(0.28, spread=0.28, shade=0.20, dark=0.08, drop=0.05),
}

# The surface of each class of ground.
GROUND_SURFACES: dict[Label, Surface] = {
    Label.ROAD: Surface.ASPHALT,
    Label.PARKING: Surface.PAVING,
    Label.SIDEWALK: Surface.PAVING,
    Label.OTHER_GROUND: Surface.GRAVEL,
    Label.LANE_MARKING: Surface.ROAD_PAINT,
    Label.TERRAIN: Surface.GRASS,
}


@lru_cache(maxsize=1)
def reflection_table() -> np.ndarray:
    """Return `REFLECTIONS` as an (S, 7) float32 table.

    Rows are the S surfaces by value; columns are the fields of `Reflection` in order.
    """
    rows = [astuple(REFLECTIONS[surface]) for surface in Surface]
    return np.array(rows, dtype=np.float32)


@lru_cache(maxsize=1)
def ground_surface_table() -> np.ndarray:
    """Return the (256,) uint8 surface of each class of ground, indexed by class id.

    Entries of other ids are 0 and have no meaning.
    """
    table = np.zeros(256, dtype=np.uint8)
    for label, surface in GROUND_SURFACES.items():
        table[label] = surface
    return table
