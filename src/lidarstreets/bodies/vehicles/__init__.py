"""Meshes of vehicles and people; x is forward, and all stand on z = 0."""

from lidarstreets.bodies.vehicles.buses import bus, tram
from lidarstreets.bodies.vehicles.cars import car, van
from lidarstreets.bodies.vehicles.machines import caravan, excavator, machine, trailer
from lidarstreets.bodies.vehicles.people import people_group, person, sitter
from lidarstreets.bodies.vehicles.trucks import truck
from lidarstreets.bodies.vehicles.two_wheelers import (
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
