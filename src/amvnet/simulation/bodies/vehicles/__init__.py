"""Meshes of vehicles and people; x is forward, and all stand on z = 0."""

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

__all__ = [
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
