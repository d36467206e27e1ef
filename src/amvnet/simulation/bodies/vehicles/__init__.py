"""Meshes of vehicles and people; x is forward, and all stand on z = 0."""

from collections.abc import Callable

import numpy as np

from amvnet.simulation.bodies.vehicles.buses import bus, tram
from amvnet.simulation.bodies.vehicles.cars import car, van
from amvnet.simulation.bodies.vehicles.machines import caravan, excavator, machine, trailer
from amvnet.simulation.bodies.vehicles.people import people_group, person, sitter
from amvnet.simulation.bodies.vehicles.trucks import truck
from amvnet.simulation.bodies.vehicles.two_wheelers import (
    bicycle,
    bicyclist,
    motorcycle,
    motorcyclist,
)
from amvnet.simulation.mesh import Mesh

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
