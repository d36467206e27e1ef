"""Make meshes of buses and trams."""

import numpy as np

from lidarstreets.bodies.vehicles.parts import glass, plates_and_lamps, wheels
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part, place
from lidarstreets.solids import box, copies, prism


def bus(rng: np.random.Generator) -> Mesh:
    """Return a minibus, a city bus, a coach or an articulated bus."""
    width = rng.uniform(2.3, 2.55)
    height = rng.uniform(2.7, 3.3) if rng.random() < 0.8 else rng.uniform(3.3, 4.0)

    kind = rng.random()
    if kind < 0.35:
        minibus = _minibus if rng.random() < 0.6 else _small_bus
        return minibus(rng, min(height, 2.9))
    if kind < 0.88:
        return _section(rng, rng.uniform(9.5, 13.5), width, height, (-0.26, 0.30))

    front = _section(rng, 9.5, width, 3.0, (-0.15, 0.22))
    rear = _section(rng, 7.5, width, 3.0, (-0.1,))
    bellows = part([box((1.2, width * 0.9, 2.5), (-0.6, 0, 0.4))], Surface.RUBBER, Label.BUS)
    bend = rng.normal(scale=0.1)
    return join(place(front, x=4.75), bellows, place(rear, x=-4.75, yaw=bend))


def _small_bus(rng: np.random.Generator, height: float) -> Mesh:
    return _section(rng, rng.uniform(6.0, 8.5), rng.uniform(2.1, 2.35), height, (-0.28, 0.3))


def _minibus(rng: np.random.Generator, height: float) -> Mesh:
    """Return a van with a bonnet and rows of seats."""
    length = rng.uniform(6.1, 8.5)
    width = rng.uniform(1.95, 2.2)
    bonnet = rng.uniform(0.7, 1.7)
    body = _section(rng, length - bonnet, width, height, (-0.25,))

    half = length / 2
    cabin = half - bonnet
    sill = rng.uniform(1.1, 1.35)
    lower = [
        (cabin, 0.3), (half, 0.3), (half, 0.75), (half - 0.15, sill - 0.2), (cabin, sill)
    ]  # fmt: skip
    screen = [(cabin + 0.01, sill), (half - 0.3, sill - 0.1), (cabin + 0.01, height - 0.4)]

    return join(
        place(body, x=-bonnet / 2),
        part([prism(lower, width * 0.96)], Surface.COATING, Label.BUS),
        glass([prism(screen, width * 0.9)], Label.BUS, bool(rng.random() < 0.5)),
        plates_and_lamps(Label.BUS, half, width, 0.5, 0.6),
        wheels(Label.BUS, (cabin - 0.1,), width, 0.35, 0.25),
    )


def tram(rng: np.random.Generator) -> Mesh:
    """Return a tram of two to four sections; the benchmarks count it as a bus."""
    width = rng.uniform(2.2, 2.65)
    length = rng.uniform(6, 9)
    sections = int(rng.integers(2, 5))

    pieces = []
    for index in range(sections):
        section = _section(rng, length, width, 3.4, ())
        pieces.append(place(section, x=(index - (sections - 1) / 2) * (length + 0.8)))
    total = sections * (length + 0.8)
    bogie_x = np.linspace(-total / 2 + 2, total / 2 - 2, sections + 1)
    bogies = copies(box((2.2, 1.9, 0.5), (0, 0, 0.02)), x=bogie_x)
    bellows_x = (np.arange(1, sections) - sections / 2) * (length + 0.8)
    bellows = copies(box((0.9, width * 0.9, 2.8), (0, 0, 0.45)), x=bellows_x)
    return join(*pieces, part([bogies, bellows], Surface.RUBBER, Label.BUS))


def _section(
    rng: np.random.Generator, length: float, width: float, height: float, axles: tuple[float, ...]
) -> Mesh:
    """Return one rigid section of a bus with a band of windows.

    `axles` are the x of its axles as shares of its length.
    """
    half = length / 2
    sill = rng.uniform(0.9, 1.5)
    lintel = height - rng.uniform(0.3, 0.6)
    floor = rng.uniform(0.2, 0.4)

    lower = box((length, width, sill - floor), (0, 0, floor))
    upper = box((length, width, height - lintel), (0, 0, lintel), top=(0.98, 0.92))
    post_x = np.linspace(-half + 0.1, half - 0.1, int(length / 1.6) + 1)
    posts = copies(box((0.14, width, lintel - sill)), x=post_x, z=sill)
    windows = box((length * 0.985, width * 0.98, lintel - sill - 0.02), (0, 0, sill + 0.01))

    seat_x = np.arange(-half + 1, half - 1.5, 0.85)
    seats = copies(box((0.12, 0.9, 0.75)), x=seat_x[:, None], y=[-0.65, 0.65], z=sill - 0.45)
    machinery = box((length * rng.uniform(0.2, 0.5), width * 0.7, 0.3), (-length * 0.1, 0, height))

    painted = [lower, upper, posts]
    if rng.random() < 0.6:
        painted.append(machinery)

    return join(
        part(painted, Surface.COATING, Label.BUS),
        glass([windows], Label.BUS, bool(rng.random() < 0.5)),
        part([seats], Surface.CLOTH, Label.BUS),
        plates_and_lamps(Label.BUS, half, width, floor + 0.3, floor + 0.3),
        wheels(Label.BUS, [axle * length for axle in axles], width, 0.48, 0.3),
    )
