"""Define the classes of a simulated street, and how each kind of surface reflects a pulse."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from enum import IntEnum

import numpy as np


class Label(IntEnum):
    """A class of a simulated street.

    Each value is a raw SemanticKITTI id. Values from 300 are classes that only nuScenes has. In the
    table below, the category of nuScenes-lidarseg follows the value. The raw SemanticKITTI id comes
    last, unless it is the value.

    Attributes:
        category: category of nuScenes-lidarseg, which counts riders as part of their vehicle.
        raw: raw SemanticKITTI id.
    """

    OUTLIER = 1, "noise"
    CAR = 10, "vehicle.car"
    BICYCLE = 11, "vehicle.bicycle"
    BUS = 13, "vehicle.bus.rigid"
    MOTORCYCLE = 15, "vehicle.motorcycle"
    TRUCK = 18, "vehicle.truck"
    OTHER_VEHICLE = 20, "vehicle.trailer"
    PERSON = 30, "human.pedestrian.adult"
    BICYCLIST = 31, "vehicle.bicycle"
    MOTORCYCLIST = 32, "vehicle.motorcycle"
    ROAD = 40, "flat.driveable_surface"
    PARKING = 44, "flat.driveable_surface"
    SIDEWALK = 48, "flat.sidewalk"
    OTHER_GROUND = 49, "flat.other"
    BUILDING = 50, "static.manmade"
    FENCE = 51, "static.manmade"
    OTHER_STRUCTURE = 52, "static.manmade"
    LANE_MARKING = 60, "flat.driveable_surface"
    VEGETATION = 70, "static.vegetation"
    TRUNK = 71, "static.vegetation"
    TERRAIN = 72, "flat.terrain"
    POLE = 80, "static.manmade"
    TRAFFIC_SIGN = 81, "static.manmade"
    OTHER_OBJECT = 99, "static.other"
    BARRIER = 300, "movable_object.barrier", 52
    TRAFFIC_CONE = 301, "movable_object.trafficcone", 99
    CONSTRUCTION_VEHICLE = 302, "vehicle.construction", 20
    TRAILER = 303, "vehicle.trailer", 20
    CAMPER = 304, "vehicle.truck", 20
    SEMI_TRAILER = 305, "vehicle.trailer", 18
    MOVING_SEMI_TRAILER = 306, "vehicle.trailer", 258

    category: str
    raw: int

    def __new__(cls, value: int, category: str, raw: int | None = None) -> Label:
        """Make a label whose raw id is its value, unless `raw` is given."""
        label = int.__new__(cls, value)
        label._value_ = value
        label.category = category
        label.raw = value if raw is None else raw
        return label


# Ids of moving bodies by class; except for semi-trailers, they are raw SemanticKITTI ids. Other
# classes have no such id.
MOVING = {
    Label.CAR: 252,
    Label.BICYCLIST: 253,
    Label.PERSON: 254,
    Label.MOTORCYCLIST: 255,
    Label.BUS: 257,
    Label.TRUCK: 258,
    Label.SEMI_TRAILER: Label.MOVING_SEMI_TRAILER,
    Label.OTHER_VEHICLE: 259,
}


@dataclass(frozen=True)
class Reflection:
    """How one kind of surface reflects a laser pulse, as measured on KITTI's scans.

    Attributes:
        reflectivity: intensity in [0, 1] that an HDL-64E reports for a near surface hit head-on.
        spread: how much the intensities of one body differ, relative to their mean: the scale of a
            Student's t distribution with three degrees of freedom.
        shade: standard deviation of the logarithm of the reflectivity between bodies.
        dark: share of dark returns in [0, 1]. They come in patches: glossy surfaces reflect most
            light elsewhere.
        drop: share of the pulses in [0, 1] that never return, whatever the range.
        rough: standard deviation in metres of the height of relief, such as grass, that is too
            fine for triangles. It differs from place to place; this is the median.
        ghost: share of the returns in [0, 1] that come from a mirrored body, and so seem to lie
            farther along the ray.
    """

    reflectivity: float
    spread: float
    shade: float
    dark: float = 0.02
    drop: float = 0.0
    rough: float = 0.0
    ghost: float = 0.0


class Surface(IntEnum):
    """A kind of surface. Its value is its row in `REFLECTIONS`."""

    ASPHALT = Reflection(0.28, spread=0.09, shade=0.14, dark=0.04, rough=0.0004)
    PAVING = Reflection(0.32, spread=0.08, shade=0.12, dark=0.02, rough=0.0006)
    GRASS = Reflection(0.37, spread=0.12, shade=0.06, dark=0.001, rough=0.009)
    GRAVEL = Reflection(0.33, spread=0.13, shade=0.15, dark=0.01, rough=0.003)
    ROAD_PAINT = Reflection(0.55, spread=0.20, shade=0.15)
    PLASTER = Reflection(0.49, spread=0.10, shade=0.20, dark=0.04, drop=0.001)
    BRICK = Reflection(0.39, spread=0.12, shade=0.20, drop=0.001, rough=0.002)
    GLASS = Reflection(0.10, spread=0.50, shade=0.50, dark=0.75, drop=0.65, ghost=0.04)
    WOOD = Reflection(0.38, spread=0.11, shade=0.25, rough=0.003)
    LEAF = Reflection(0.38, spread=0.16, shade=0.17, dark=0.006, drop=0.003)
    BARK = Reflection(0.39, spread=0.23, shade=0.20, dark=0.01, rough=0.013)
    METAL = Reflection(0.33, spread=0.26, shade=0.40, dark=0.15, drop=0.006, rough=0.004)
    SIGN_FACE = Reflection(0.50, spread=0.13, shade=0.40)
    CLOTH = Reflection(0.46, spread=0.20, shade=0.25, rough=0.005)
    SKIN = Reflection(0.45, spread=0.20, shade=0.10, dark=0.03)
    # The paint of cars, which reflects most of a pulse elsewhere, whatever its colour.
    DARK_PAINT = Reflection(0.13, spread=0.25, shade=0.50, dark=0.75, drop=0.08, rough=0.003)
    LIGHT_PAINT = Reflection(0.34, spread=0.15, shade=0.40, dark=0.50, drop=0.05, rough=0.003)
    # The coating of load boxes, caravans and machines.
    COATING = Reflection(0.42, spread=0.15, shade=0.25, dark=0.05, drop=0.006, rough=0.003)
    # The tubes, rims and spokes of a bicycle.
    CYCLE = Reflection(0.42, spread=0.6, shade=0.4, dark=0.08, drop=0.05)
    RUBBER = Reflection(0.08, spread=0.50, shade=0.40, dark=0.40, drop=0.05)
    PLATE = Reflection(0.95, spread=0.10, shade=0.10, dark=0.0)
    PLASTIC = Reflection(0.34, spread=0.20, shade=0.40, dark=0.06, drop=0.006)
    ROOF_TILE = Reflection(0.33, spread=0.13, shade=0.20, drop=0.001, rough=0.003)
    # The windows of houses: unlike the windows of cars, they have curtains and frames that reflect.
    WINDOW = Reflection(0.30, spread=0.30, shade=0.40, dark=0.12, drop=0.03, rough=0.01, ghost=0.02)
    STONE = Reflection(0.36, spread=0.16, shade=0.25, rough=0.013)
    TWIG = Reflection(0.30, spread=0.26, shade=0.20, dark=0.03, drop=0.008)
    # The painted or galvanised steel of poles.
    MAST = Reflection(0.30, spread=0.45, shade=0.40, dark=0.15, drop=0.006, rough=0.004)

    reflection: Reflection

    def __new__(cls, reflection: Reflection) -> Surface:
        """Make a surface whose value is its row in tables of all surfaces."""
        row = len(cls.__members__)
        surface = int.__new__(cls, row)
        surface._value_ = row
        surface.reflection = reflection
        return surface


# Reflections as one (S, 7) table: a row for each surface, a column for each field of `Reflection`.
REFLECTIONS = np.array([astuple(surface.reflection) for surface in Surface], dtype=np.float32)

# Kind of surface of each class of ground.
GROUND_SURFACES = {
    Label.ROAD: Surface.ASPHALT,
    Label.PARKING: Surface.PAVING,
    Label.SIDEWALK: Surface.PAVING,
    Label.OTHER_GROUND: Surface.GRAVEL,
    Label.LANE_MARKING: Surface.ROAD_PAINT,
    Label.TERRAIN: Surface.GRASS,
    Label.VEGETATION: Surface.LEAF,
}
