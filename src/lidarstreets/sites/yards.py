"""Fill plots with paved yards: car parks, petrol stations, garages and industrial yards."""

import numpy as np

from lidarstreets.bodies import buildings, clutter, furniture, trees
from lidarstreets.bodies.vehicles import cars, trucks
from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label
from lidarstreets.sites.boundaries import draw_boundary, line_up
from lidarstreets.sites.site import Plot
from lidarstreets.sites.traffic import choose_vehicle


def fill_yard(plot: Plot) -> None:
    """Make a plot a car park, a row of garages, a petrol station or an industrial yard."""
    fillers = {_car_park: 0.58, _garage_row: 0.14, _petrol_station: 0.10, _industrial_yard: 0.18}
    weighted_choice(plot.rng, fillers)(plot)


def _car_park(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    plot.pave((plot.x + 1, plot.end - 1), (front + 0.5, front + 20), Label.PARKING)

    chance = plot.style.parked + 0.2

    for row in (4.0, 14.5):
        for x in np.arange(plot.x + 3, plot.end - 3, 2.8):
            make = choose_vehicle(plot.site, "car park")
            is_taken = rng.random() < chance
            has_room = make is not trucks.truck or row > 10  # trucks are too long for the front
            if is_taken and has_room:
                yaw = rng.choice([-1, 1]) * np.pi / 2 + rng.normal(scale=0.03)
                plot.put(make(rng), x, front + row, yaw, thing=True, margin=3.0)

    for distance in (front + 0.3, front + 20.5):
        if rng.random() < 0.5:
            line_up(plot, draw_boundary(rng), (plot.x, distance), (plot.end, distance))
    for x in np.arange(plot.x + 4, plot.end, rng.uniform(8, 14)):
        if rng.random() < 0.4:
            plot.put(trees.random_tree(rng, rng.uniform(3, 7)), x, front + 9.2)


def _garage_row(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    distance = front + rng.uniform(6, 14)
    plot.pave((plot.x, plot.end), (front, distance), Label.PARKING)
    row = buildings.garages(rng, int(plot.width / 3.4))
    plot.put(row, plot.middle, distance + 3, plot.facing, margin=plot.width / 2)

    for _ in range(rng.poisson(1.5)):
        car = cars.car(rng)
        yaw = rng.uniform(0, 6)
        plot.put(car, plot.random_x(), front + rng.uniform(2, 5), yaw, thing=True, margin=3.0)
    for _ in range(rng.poisson(1)):
        plot.put(clutter.clutter(rng), plot.random_x(), front + rng.uniform(0.5, 5))


def _petrol_station(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    label = Label.PARKING if rng.random() < 0.5 else Label.OTHER_GROUND
    plot.pave((plot.x, plot.end), (front, front + 22), label)
    plot.put(buildings.canopy(rng), plot.middle, front + 8, plot.facing, margin=8.0)
    for x in (-4, 0, 4):
        plot.put(clutter.cabinet(rng), plot.middle + x, front + 8, np.pi / 2, margin=3.0)
    shop = buildings.building(rng, plot.width * 0.5, 8, 3.5, flat=True)
    plot.put(shop, plot.middle, front + 20, plot.facing, margin=9.0)
    car = cars.car(rng)
    plot.put(car, plot.middle + 2, front + 8, np.pi / 2, thing=True, margin=3.0)
    plot.put(furniture.sign(rng), plot.x + 1, front + 0.5)


def _industrial_yard(plot: Plot) -> None:
    rng = plot.rng
    front = plot.front

    label = Label.PARKING if rng.random() < 0.4 else Label.OTHER_GROUND
    plot.pave((plot.x, plot.end), (front, front + 16), label)
    hall = buildings.hall(rng, plot.width * 0.8, 14, rng.uniform(4, 9))
    plot.put(hall, plot.middle, front + rng.uniform(18, 24), plot.facing, margin=plot.width * 0.4)

    for _ in range(rng.poisson(4)):
        thing = clutter.yard_clutter(rng) if rng.random() < 0.6 else clutter.clutter(rng)
        plot.put(thing, plot.random_x(), front + rng.uniform(1, 13), rng.uniform(0, 6))

    for _ in range(rng.poisson(1.5)):
        make = choose_vehicle(plot.site, "car park")
        yaw = rng.choice([-1, 1]) * np.pi / 2
        plot.put(make(rng), plot.random_x(), front + 9, yaw, thing=True, margin=7.0)
    if rng.random() < 0.3:
        for x in plot.x + np.arange(3) * 1.5:
            plot.put(furniture.flag_pole(rng), x, front + 1.2)
    if rng.random() < 0.7:
        boundary = draw_boundary(rng, "open")
        line_up(plot, boundary, (plot.x, front + 0.5), (plot.end, front + 0.5))
