"""Add vehicles along a street: parked at its sides, waiting in side roads, and driving."""

from pathlib import Path

import numpy as np

from lidarstreets.bodies import clutter, furniture
from lidarstreets.bodies.vehicles import buses, cars, machines, people, trucks, two_wheelers
from lidarstreets.bodies.vehicles.cars import open_door
from lidarstreets.chance import scaled, weighted_choice
from lidarstreets.materials import Label
from lidarstreets.mesh import Maker, Mesh, join, place
from lidarstreets.sites.site import Site
from lidarstreets.streets.plans import SideRoad
from lidarstreets.tables import read_table

VEHICLE_SHARES = read_table(Path(__file__).with_suffix(".toml"))
VEHICLE_MAKERS: dict[str, Maker] = {
    "car": cars.car,
    "truck": trucks.truck,
    "trailer": machines.trailer,
    "camper": machines.camper,
    "machine": machines.machine,
    "bus": buses.bus,
    "tram": buses.tram,
    "motorcycle": two_wheelers.motorcycle,
    "motorcyclist": two_wheelers.motorcyclist,
}
BUMPER_GAP = 2.0  # smallest distance between two vehicles in a lane, bumper to bumper, metres
LONGEST_ANGLED = 5.8  # length of the longest vehicle that parks at an angle to the street, metres


def choose_vehicle(site: Site, where: str) -> Maker:
    """Draw a kind of vehicle and return its maker; `where` is a table of traffic.toml."""
    shares = scaled(VEHICLE_SHARES[where], site.ground.style.region.vehicles)
    return VEHICLE_MAKERS[weighted_choice(site.rng, shares)]


def length_of(mesh: Mesh) -> float:
    """Return the length of a vehicle in metres."""
    return float(np.ptp(mesh.triangles[..., 0]))


def fill_parking_lane(site: Site, side: int) -> None:
    """Put parked vehicles along one side of the road, if it has a parking lane."""
    style = site.ground.style
    index = int(side > 0)
    if not style.parking[index] or style.is_bus_bay[index]:
        return

    if style.parking_angle[index]:
        _fill_angled(site, side, style.parking_angle[index])
    else:
        _fill_parallel(site, side)


def _fill_parallel(site: Site, side: int) -> None:
    rng = site.rng
    ground = site.ground
    style = ground.style
    width = style.parking[int(side > 0)]

    x = rng.uniform(0, 6)

    while x < ground.length:
        mesh = choose_vehicle(site, "parked")(rng)
        half = length_of(mesh) / 2 + rng.uniform(0.2, 1.0)
        middle = x + half
        if rng.random() < style.parked and _is_bay(site, middle, half):
            is_car = bool((mesh.label == Label.CAR).any())
            if is_car and rng.random() < 0.05:
                mesh = join(mesh, open_door(rng))
            t = side * (style.road / 2 + width / 2 + rng.normal(scale=0.12))
            yaw = along_road(side) + rng.normal(scale=0.03) + np.pi * (rng.random() < 0.12)
            site.put(mesh, middle, t, yaw, thing=True, margin=half + 3.0)
        x = middle + half


def _fill_angled(site: Site, side: int, angle: float) -> None:
    rng = site.rng
    ground = site.ground
    style = ground.style
    depth = style.parking[int(side > 0)]
    pitch = rng.uniform(2.4, 2.9) / np.sin(angle)

    for x in np.arange(rng.uniform(0, 3), ground.length, pitch):
        mesh = choose_vehicle(site, "parked")(rng)
        half = length_of(mesh) / 2
        is_taken = rng.random() < style.parked
        if is_taken and 2 * half < LONGEST_ANGLED and _is_bay(site, x, 1.0):
            t = side * (style.road / 2 + depth / 2 + rng.normal(scale=0.25))
            yaw = along_road(side) + side * (angle + np.pi * (rng.random() < 0.4))
            site.put(mesh, x, t, yaw + rng.normal(scale=0.03), thing=True, margin=7.0)


def _is_bay(site: Site, x: float, half: float) -> bool:
    """Return whether a vehicle that is 2 * `half` metres long has room in the parking lane at x."""
    ground = site.ground
    has_room = ground.is_bay(x - half + 0.3) and ground.is_bay(x + half - 0.3)
    return has_room and ground.is_street(x, half + 2)


def park_anywhere(site: Site, side: int) -> None:
    """Park a few vehicles partly on the sidewalk, on verges and at the edge of the road."""
    rng = site.rng
    ground = site.ground
    style = ground.style
    if style.parking[int(side > 0)] or style.kind in ("fast", "avenue"):
        return

    rate = 0.25 if style.kind in ("motorway", "rural") else 0.9 * min(style.parked, 0.7)

    for start in np.arange(0.0, ground.length, 100.0):
        x = start + rng.uniform(0, 30)
        for _ in range(rng.poisson(rate)):
            mesh = choose_vehicle(site, "parked")(rng)
            half = length_of(mesh) / 2
            x += half + rng.uniform(0.5, 8.0)
            # From the edge of the road to the back of the sidewalk.
            t = side * (style.road / 2 + rng.uniform(0.3, 1.8))
            if style.kind == "motorway":
                t = side * (style.road / 2 + 1.5)
            yaw = along_road(side) + rng.normal(scale=0.05)
            if ground.is_street(x, half + 2):
                site.put(mesh, x, t, yaw, thing=True, margin=half + 1.0)
            x += half


def fill_side_roads(site: Site) -> None:
    """Put waiting and parked vehicles on side roads, and a light or a sign where each begins."""
    rng = site.rng

    for road in site.ground.plan.crossings:
        distance = site.ground.style.road / 2 + rng.uniform(3.5, 12)
        for _ in range(rng.poisson(0.7)):
            mesh = choose_vehicle(site, "driving")(rng)
            half = length_of(mesh) / 2
            _put_on_side_road(site, road, mesh, distance + half, road.width / 4)
            distance += 2 * half + rng.uniform(1, 8)

        distance = site.ground.style.road / 2 + rng.uniform(8, 20)
        for _ in range(rng.poisson(0.8 * (road.width > 5.5))):
            mesh = choose_vehicle(site, "parked")(rng)
            half = length_of(mesh) / 2
            across = -(road.width / 2 + rng.uniform(-1.0, 0.6))
            _put_on_side_road(site, road, mesh, distance + half, across)
            distance += 2 * half + rng.uniform(0.5, 6)

        make = furniture.traffic_light if rng.random() < 0.3 else furniture.sign
        along = site.ground.style.road / 2 + road.corner * 0.6 + 1.0
        px, py, yaw = road.pose_at(along, -road.side * (road.width / 2 + 1.2))
        site.put_at(make(rng), px, py, yaw + np.pi / 2)


def _put_on_side_road(site: Site, road: SideRoad, mesh: Mesh, along: float, across: float) -> None:
    """Put a vehicle on a side road, facing the street."""
    if along < road.length - 3:
        px, py, yaw = road.pose_at(along, across)
        site.put_at(mesh, px, py, yaw + np.pi + site.rng.normal(scale=0.04), thing=True)


def add_traffic(site: Site, ego_speed: float, ego: tuple[float, float]) -> None:
    """Add vehicles to all lanes. All vehicles in a lane have one speed, so that none hits another.

    Args:
        ego_speed: speed of the car with the sensor, metres per second.
        ego: x and t of the car with the sensor at time 0; no vehicle in its lane starts near it.
    """
    rng = site.rng
    ground = site.ground
    style = ground.style
    where = "motorway" if style.kind == "motorway" else "driving"
    ego_x, ego_t = ego

    for lane, direction in style.lanes:
        is_ego_lane = abs(lane - ego_t) < 1.5
        factor = 1.0 if is_ego_lane else rng.uniform(0.75, 1.35)
        speed = direction * ego_speed * factor
        # Some lanes are full, as in front of a traffic light.
        is_queue = rng.random() < 0.06 and style.kind != "living"
        mean_gap = rng.uniform(1, 8) if is_queue else 90 / max(style.traffic, 0.05)

        clearance = 4.5 if rng.random() < 0.15 else 11.0
        x = rng.uniform(5, 40)
        while True:
            mesh = choose_vehicle(site, where)(rng)
            half = length_of(mesh) / 2
            x += half
            if x > ground.length - half - BUMPER_GAP:
                break

            if not is_ego_lane or abs(x - ego_x) > half + clearance:
                t = lane + rng.normal(scale=0.15)
                site.put_moving(mesh, x, t, speed)
            x += half + BUMPER_GAP + rng.exponential(mean_gap)


def fill_bus_stops(site: Site) -> None:
    """Put a bus stop with a shelter and people, and perhaps a bus, along some streets."""
    rng = site.rng
    ground = site.ground
    style = ground.style
    if style.kind not in ("urban", "avenue", "residential") or rng.random() > 0.13:
        return

    side = int(rng.choice([-1, 1]))
    x = rng.uniform(10, ground.length - 10)
    stand_t = side * (ground.kerb_t(side) + 1.4)
    facing = 0.0 if side > 0 else np.pi
    if not ground.is_street(x, 12):
        return

    if rng.random() < 0.35:
        t = side * (style.road / 2 - (0.9 if not style.parking[int(side > 0)] else -0.8))
        site.put(buses.bus(rng), x, t, along_road(side), thing=True, margin=8.0)
    site.put(clutter.shelter(rng), x, side * (ground.kerb_t(side) + 2.4), facing)

    for _ in range(rng.poisson(2.5)):
        stand_x = x + rng.normal(scale=3.0)
        person = people.person(rng)
        site.put(person, stand_x, stand_t, rng.uniform(0, 2 * np.pi), thing=True)


def car_with_trailer(rng: np.random.Generator) -> list[Mesh]:
    """Return a car and the trailer that it pulls."""
    car = cars.car(rng)
    trailer = machines.trailer(rng)
    gap = float(trailer.triangles[..., 0].max()) - float(car.triangles[..., 0].min())
    return [car, place(trailer, x=-gap + 0.1)]


def along_road(side: int) -> float:
    """Return the yaw, relative to the street, of vehicles on one side of the road."""
    return 0.0 if side < 0 else np.pi
