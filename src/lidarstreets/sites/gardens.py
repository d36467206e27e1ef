"""Fill plots with houses: single houses in gardens, and rows along the sidewalk."""

from dataclasses import replace

import numpy as np

from lidarstreets.bodies import buildings, clutter, furniture, plants, trees
from lidarstreets.bodies.vehicles import cars, two_wheelers
from lidarstreets.materials import Label
from lidarstreets.sites.boundaries import DRIVE_WIDTH, draw_boundary, enclose, line_up
from lidarstreets.sites.land import grow_cover, plant_bushes, plant_thickets
from lidarstreets.sites.site import Plot


def fill_house(plot: Plot) -> None:
    """Put a house in a garden, with a drive and perhaps a hedge, wall or fence around it."""
    rng = plot.rng
    style = plot.style

    width = plot.width * rng.uniform(0.45, 0.75)
    depth = rng.uniform(8, 12)
    setback = rng.uniform(*style.setback)
    x = plot.middle + rng.uniform(-1, 1)

    house = buildings.building(
        rng, width, depth, height=rng.uniform(*style.storeys), flat=rng.random() < 0.15
    )
    turn = rng.normal(scale=0.03) if rng.random() < 0.8 else rng.uniform(-0.5, 0.5)
    distance = plot.front + setback + depth / 2
    plot.put(house, x, distance, plot.facing + turn, margin=width * 0.5)

    drive_x = plot.x + 0.3 if rng.random() < 0.5 else plot.end - 3.3
    _add_drive(plot, drive_x, setback + 5.0)
    if rng.random() < 0.75 * style.fenced:
        enclose(plot, drive_x, setback + rng.uniform(4, 20))
    if rng.random() < 0.5:
        plot.put(clutter.steps(rng), x, plot.front + setback, plot.facing)

    _plant_garden(plot, setback)
    _furnish(plot, setback)


def _plant_garden(plot: Plot, setback: float) -> None:
    """Put plants between the front of the plot and the house, `setback` metres behind it."""
    rng = plot.rng
    green = plot.style.green

    plant_bushes(plot, rng.poisson(4.0 * green), setback)

    for _ in range(rng.poisson(0.6 * green)):
        distance = plot.front + rng.uniform(0.6, setback + 1)
        tree = trees.street_tree(rng, rng.uniform(3, 9), plot.style.region.palms)
        plot.put(tree, plot.random_x(), distance)

    if rng.random() < 0.25 * green:
        overgrown = replace(plot, width=plot.width * 0.7)
        plant_thickets(overgrown, plot.front + rng.uniform(1.8, 3.0))
    if rng.random() < 0.3 * green:
        near = plot.front + rng.uniform(0.1, 1.5)
        grow_cover(plot, near, near + rng.uniform(0.8, 4))
    if rng.random() < 0.25:
        bed = plants.flower_bed(rng, plot.width * rng.uniform(0.2, 0.5))
        plot.put(bed, plot.middle, plot.front + rng.uniform(0.8, 3), margin=plot.width * 0.3)
    if rng.random() < 0.2:
        # Bushes or narrow trees stand in a row in front of the house.
        for x in np.arange(plot.x + plot.width * 0.3, plot.end - plot.width * 0.3, 1.4):
            bush = plants.bush(rng, 0.6) if rng.random() < 0.7 else trees.column(rng, 2.0)
            plot.put(bush, x, plot.front + setback - 0.5)


def _furnish(plot: Plot, setback: float) -> None:
    """Put things that people leave in gardens before the house, and sheds beside it."""
    rng = plot.rng
    front = plot.front

    for _ in range(rng.poisson(1.0)):
        distance = front + rng.uniform(0.3, setback + 1)
        plot.put(clutter.yard_clutter(rng), plot.random_x(), distance, rng.uniform(0, np.pi))
    for _ in range(rng.poisson(0.7)):
        distance = front + rng.uniform(0.4, 1.5)
        plot.put(clutter.clutter(rng), plot.random_x(), distance, plot.facing)
    if rng.random() < 0.15:
        plot.put(buildings.shed(rng), plot.x + 2, front + setback + rng.uniform(0, 10), margin=4)
    if rng.random() < 0.05:
        plot.put(buildings.greenhouse(rng), plot.end - 3, front + setback + 6, margin=5)
    if rng.random() < 0.1:
        distances = (front, front + rng.uniform(1, setback + 1))
        plot.pave((plot.x, plot.end), distances, Label.OTHER_GROUND)


def _add_drive(plot: Plot, x: float, depth: float) -> None:
    """Pave a drive; sometimes put a car on it, and a garage, carport or shed at its end."""
    rng = plot.rng
    front = plot.front

    label = Label.PARKING if rng.random() < 0.2 else Label.SIDEWALK
    plot.pave((x, x + DRIVE_WIDTH), (front, front + depth), label)

    middle_x = x + DRIVE_WIDTH / 2
    if rng.random() < 0.4:
        car = cars.car(rng)
        distance = front + min(3.0, depth / 2)
        plot.put(car, middle_x, distance, plot.side * np.pi / 2, thing=True, margin=3.0)
    if rng.random() < 0.4:
        plot.put(buildings.shed(rng), middle_x, front + depth + 3.0, plot.facing, margin=4.0)


def fill_row(plot: Plot) -> None:
    """Put one to three adjoining houses on a plot, and pave the ground between them and the street.

    The houses take the whole width of the plot.
    """
    rng = plot.rng
    style = plot.style
    front = plot.front

    setback = rng.uniform(*style.setback)
    depth = rng.uniform(9, 14)

    # A single house is one long wall. In a row of two or three, each house steps forward or back.
    houses = int(rng.choice([1, 2, 3], p=[0.6, 0.2, 0.2]))
    height = rng.uniform(*style.storeys)
    is_flat = rng.random() < 0.4
    width = plot.width / houses

    for index in range(houses):
        house = buildings.building(rng, width, depth, height + rng.normal(scale=0.5), is_flat)
        x = plot.x + (index + 0.5) * width
        step = rng.normal(scale=0.5) if houses > 1 else 0.0
        distance = front + max(setback + step, 0.2) + depth / 2
        plot.put(house, x, distance, plot.facing, margin=width * 0.5)

    label = Label.SIDEWALK if rng.random() < 0.75 else Label.OTHER_GROUND
    plot.pave((plot.x, plot.end), (front, front + setback + 0.5), label)
    if setback > 1.2 and rng.random() < 0.4 * style.fenced:
        line_up(plot, draw_boundary(rng), (plot.x, front + 0.2), (plot.end, front + 0.2))
    if rng.random() < 0.4:
        _park_two_wheelers(plot)
    for _ in range(rng.poisson(1.8)):
        distance = front + rng.uniform(-0.3, max(setback, 0.3))
        plot.put(clutter.clutter(rng), plot.random_x(), distance, plot.facing)
    if rng.random() < 0.12:
        for x in np.arange(plot.x, plot.end, rng.uniform(1.2, 2.5)):
            plot.put(furniture.post(rng), x, front - 0.2)


def _park_two_wheelers(plot: Plot) -> None:
    rng = plot.rng

    make = two_wheelers.bicycle if rng.random() < 0.75 else two_wheelers.motorcycle
    for index in range(int(rng.integers(1, 4))):
        two_wheeler = make(rng)
        x = plot.x + plot.width * 0.3 + 0.6 * index
        yaw = np.pi / 2 + rng.normal(scale=0.1)
        plot.put(two_wheeler, x, plot.front - 0.4, yaw, thing=True)
