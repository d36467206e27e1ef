"""Meshes of vehicles and people; x is forward, and all stand on z = 0."""

from collections.abc import Callable

import numpy as np

from amvnet.simulation.mesh import Mesh
from amvnet.simulation.vehicles.buses import bus, tram
from amvnet.simulation.vehicles.cars import car, van
from amvnet.simulation.vehicles.machines import caravan, excavator, machine, trailer
from amvnet.simulation.vehicles.people import people_group, person, sitter
from amvnet.simulation.vehicles.trucks import truck
from amvnet.simulation.vehicles.two_wheelers import (
    bicycle,
    bicyclist,
    motorcycle,
    motorcyclist,
)

# Draws one vehicle or person.
Maker = Callable[[np.random.Generator], Mesh]

__all__ = [
    "Maker",
    "bicycle",
    "bicyclist",
    "bus",
    "car",
    "caravan",
    "excavator",
    "machine",
    "motorcycle",
    "motorcyclist",
    "people_group",
    "person",
    "sitter",
    "trailer",
    "tram",
    "truck",
    "van",
]
