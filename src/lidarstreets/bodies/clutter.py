"""Make meshes of what SemanticKITTI leaves without a class: bins, benches, shelters and more.

They are labelled other-object or other-structure. SemanticKITTI counts both as unlabelled.
"""

import numpy as np

from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Maker, Mesh, join, part
from lidarstreets.solids import box, copies, hull, moved, planks, tube

BELOW_GROUND = 0.3  # depth of objects below the ground, so that a slope leaves no gap, metres


def _object(solids: list[np.ndarray], surface: Surface, rng: np.random.Generator) -> Mesh:
    """Return solids as one mesh with the class other-object and a random brightness."""
    return part(solids, surface, Label.OTHER_OBJECT, tint=rng.normal(scale=0.6))


def _structure(solids: list[np.ndarray], surface: Surface, rng: np.random.Generator) -> Mesh:
    """Return solids as one mesh with the class other-structure and a random brightness."""
    return part(solids, surface, Label.OTHER_STRUCTURE, tint=rng.normal(scale=0.6))


def bins(rng: np.random.Generator) -> Mesh:
    """Return a row of wheelie bins, or one large bin."""
    if rng.random() < 0.25:
        size = (rng.uniform(1.2, 1.5), 1.0, rng.uniform(1.1, 1.5))
        return _object([box(size, (0, 0, 0.1), top=(1.05, 1.2))], Surface.PLASTIC, rng)

    count = int(rng.choice([1, 2, 3, 5], p=[0.4, 0.3, 0.2, 0.1]))

    meshes = []
    for index in range(count):
        body = box((0.5, 0.6, rng.uniform(0.85, 1.0)), (0, 0, 0.05), top=(1.15, 1.2))
        lid = box((0.58, 0.72, 0.08), (0, 0, 1.0))
        at = (0.68 * (index - count / 2) + 0.3, rng.normal(scale=0.05), 0)
        yaw = rng.normal(scale=0.1)
        meshes.append(_object([moved(body, at, yaw), moved(lid, at, yaw)], Surface.PLASTIC, rng))
    return join(*meshes)


def cabinet(rng: np.random.Generator) -> Mesh:
    """Return an electrical cabinet, or a small transformer house."""
    if rng.random() < 0.1:
        size = (rng.uniform(2, 3), rng.uniform(1.6, 2.4), rng.uniform(1.5, 2.3))
        return _structure([box(size, (0, 0, -0.05))], Surface.PLASTER, rng)
    size = (rng.uniform(0.4, 1.8), rng.uniform(0.25, 0.5), rng.uniform(0.7, 1.6) + BELOW_GROUND)
    return _object([box(size, (0, 0, -BELOW_GROUND))], Surface.PLASTER, rng)


def bench(rng: np.random.Generator) -> Mesh:
    """Return a bench, perhaps with a table in front of it."""
    seat = box((1.7, 0.45, 0.06), (0, 0, 0.42))
    back = planks(0, 1.7, np.array([0.55, 0.75]), np.array([0.68, 0.9]), 0.22)
    feet = copies(box((0.08, 0.4, 0.42)), x=[-0.7, 0.7])
    solids = [seat, back, feet]
    if rng.random() < 0.3:
        solids.append(box((1.7, 0.8, 0.06), (0, -0.9, 0.72)))
        solids.append(copies(box((0.08, 0.6, 0.72)), x=[-0.6, 0.6], y=-0.9))
    return _object(solids, Surface.WOOD, rng)


def column(rng: np.random.Generator) -> Mesh:
    """Return an advertising column, a lit poster or a phone box."""
    if rng.random() < 0.4:
        height = rng.uniform(2.4, 3.4)
        solids = [tube((0, 0, -BELOW_GROUND), (0, 0, height), rng.uniform(0.5, 0.7), sides=12)]
        return _object(solids, Surface.PLASTER, rng)
    if rng.random() < 0.5:
        poster = box((0.25, rng.uniform(1.2, 2.8), 1.9), (0, 0, 0.7))
        return _object([poster, box((0.12, 0.4, 0.8))], Surface.GLASS, rng)
    return _object([box((0.95, 0.95, 2.3), (0, 0, -0.05))], Surface.PLASTIC, rng)


def planter(rng: np.random.Generator) -> Mesh:
    """Return a tub with a plant."""
    size = (rng.uniform(0.5, 2.0), rng.uniform(0.4, 0.9), rng.uniform(0.35, 0.7))
    tub = _object([box(size, top=(1.15, 1.15))], Surface.PLASTER, rng)
    radii = (size[0] * 0.45, size[1] * 0.45, rng.uniform(0.2, 0.6))
    leaves = hull(rng, (0, 0, size[2]), radii, fine=False)
    return join(tub, part([leaves], Surface.LEAF, Label.VEGETATION, 0.1))


def heap(rng: np.random.Generator) -> Mesh:
    """Return a pile of earth, rubble, logs or pallets."""
    kind = rng.random()
    if kind < 0.4:
        size = rng.uniform(0.6, 3.0, size=2)
        mound = hull(rng, (0, 0, -0.1), (size[0], size[1], rng.uniform(0.4, 1.6)), fine=False)
        mound[..., 2] = np.maximum(mound[..., 2], -BELOW_GROUND)
        surface = Surface.GRAVEL if rng.random() < 0.5 else Surface.STONE
        return _object([mound], surface, rng)
    if kind < 0.7:
        length = rng.uniform(1.0, 4.0)
        log = tube((-length / 2, 0, 0), (length / 2, 0, 0), rng.uniform(0.08, 0.2), sides=6)
        logs = []
        for row in range(int(rng.integers(2, 6))):
            y = np.arange(6 - row) * 0.33 + 0.16 * row
            logs.append(copies(log, x=rng.normal(scale=0.08), y=y, z=0.15 + 0.29 * row))
        return _object(logs, Surface.BARK, rng)

    layers = np.arange(int(rng.integers(2, 12))) * 0.145
    return _object([copies(box((1.2, 0.8, 0.11)), z=layers)], Surface.WOOD, rng)


def container(rng: np.random.Generator) -> Mesh:
    """Return a bottle bank, a skip or a site container."""
    kind = rng.random()
    if kind < 0.5:
        domes = []
        for index in range(int(rng.integers(1, 4))):
            dome = box((1.4, 1.3, 1.6), (index * 1.7, 0, 0), top=(0.7, 0.7))
            domes.append(_object([dome], Surface.PLASTIC, rng))
        return join(*domes)
    if kind < 0.75:
        return _object([box((3.4, 1.8, 1.3), top=(1.3, 1.0))], Surface.METAL, rng)
    size = (rng.uniform(3, 6.1), 2.4, 2.5)
    return _structure([box(size, (0, 0, -0.05))], Surface.METAL, rng)


def bike_rack(rng: np.random.Generator) -> Mesh:
    """Return a row of hoops to which bicycles are locked."""
    hoop = np.concatenate(
        [
            tube((0, -0.35, 0), (0, -0.35, 0.8), 0.025, sides=4, closed=False),
            tube((0, 0.35, 0), (0, 0.35, 0.8), 0.025, sides=4, closed=False),
            tube((0, -0.35, 0.8), (0, 0.35, 0.8), 0.025, sides=4, closed=False),
        ]
    )
    return _object([copies(hoop, x=np.arange(int(rng.integers(2, 8))) * 0.8)], Surface.METAL, rng)


def structure(rng: np.random.Generator) -> Mesh:
    """Return something large without a class: a pergola, a billboard, a ramp or a scaffold."""
    kind = rng.random()
    length = rng.uniform(2.5, 7.0)
    height = rng.uniform(1.8, 3.5)

    if kind < 0.3:
        y = np.array([-0.5, 0.5]) * rng.uniform(1.5, 3.5)
        x = np.linspace(-length / 2, length / 2, 4)
        posts = box((0.12, 0.12, height + BELOW_GROUND), (0, 0, -BELOW_GROUND))
        beam = box((0.08, y[1] - y[0] + 0.6, 0.14), (0, 0, height))
        return _structure(
            [copies(posts, x=x[:, None], y=y), copies(beam, x=np.append(x, x + 0.4))],
            Surface.WOOD,
            rng,
        )
    if kind < 0.5:
        board = box((length, 0.1, rng.uniform(1.2, 2.8)), (0, 0, rng.uniform(0.1, 1.0)))
        posts = copies(box((0.12, 0.12, height)), x=np.array([-0.4, 0.4]) * length, y=0.12)
        return join(
            _structure([board], Surface.PLASTER, rng), _structure([posts], Surface.METAL, rng)
        )
    if kind < 0.7:
        ramp = box(
            (length, 1.6, 1.1 + BELOW_GROUND),
            (0, 0, -BELOW_GROUND),
            top=(rng.uniform(0.3, 1.0), 1.0),
        )
        rail = planks(0, length, np.array([1.5, 1.95]), np.array([1.55, 2.0]), -0.75)
        return _structure([ramp, rail], Surface.PLASTER, rng)
    if kind < 0.85:
        x = np.linspace(-length / 2, length / 2, max(2, round(length / 2)))
        pole = tube((0, 0, 0), (0, 0, 6), 0.025, sides=4, closed=False)
        decks = copies(box((length, 0.7, 0.08)), z=[2.0, 4.0])
        rails = planks(0, length, np.array([1.0, 3.0]), np.array([1.05, 3.05]))
        poles = copies(pole, x=x[:, None], y=[-0.35, 0.35])
        return _structure([poles, decks, rails], Surface.METAL, rng)

    block = box((length, rng.uniform(1.0, 3.0), height + BELOW_GROUND), (0, 0, -BELOW_GROUND))
    return _structure([block], Surface.PLASTER, rng)


# Shares of the objects at the edge of a street, and of objects in gardens and yards.
_STREET: dict[Maker, float] = {
    bins: 0.36,
    cabinet: 0.22,
    bench: 0.08,
    column: 0.06,
    planter: 0.07,
    container: 0.05,
    structure: 0.04,
    bike_rack: 0.05,
}
_YARD: dict[Maker, float] = {
    bins: 0.20,
    bench: 0.10,
    planter: 0.10,
    heap: 0.20,
    container: 0.05,
    structure: 0.14,
}


def clutter(rng: np.random.Generator) -> Mesh:
    """Return an object that stands at the edge of a street."""
    return weighted_choice(rng, _STREET)(rng)


def yard_clutter(rng: np.random.Generator) -> Mesh:
    """Return an object that stands in a garden or a yard."""
    return weighted_choice(rng, _YARD)(rng)


def shelter(rng: np.random.Generator) -> Mesh:
    """Return the shelter of a bus stop, open towards -y."""
    length = rng.uniform(2.5, 4.5)
    posts = copies(box((0.1, 0.1, 2.3)), x=[[-length / 2], [length / 2]], y=[-0.6, 0.6])
    roof = box((length + 0.3, 1.6, 0.12), (0, 0, 2.3))
    seat = box((length, 0.4, 0.1), (0, 0.4, 0.5))
    pane = box((length, 0.03, 1.9), (0, 0.6, 0.3))

    surface = Surface.GLASS if rng.random() < 0.6 else Surface.WOOD

    return join(
        part([posts, roof, seat], Surface.METAL, Label.OTHER_STRUCTURE),
        part([pane], surface, Label.OTHER_STRUCTURE),
    )


def steps(rng: np.random.Generator) -> Mesh:
    """Return the steps in front of a door, perhaps with a rail."""
    count = int(rng.integers(2, 6))
    width = rng.uniform(1.2, 2.5)
    slabs = []
    for step in range(count):
        treads = count - step  # number of treads that rest on this slab, its own included
        slabs.append(box((width, 0.3 * treads, 0.17), (0, -0.15 * treads, 0.17 * step)))

    parts = [part(slabs, Surface.PAVING, Label.OTHER_STRUCTURE)]
    if rng.random() < 0.4:
        x = rng.choice([-1, 1]) * width / 2
        rail = tube((x, -0.3 * count, 0.9), (x, 0, 0.9 + 0.17 * count), 0.03, sides=4)
        foot = tube((x, -0.3 * count, 0), (x, -0.3 * count, 0.9), 0.03, sides=4)
        parts.append(part([rail, foot], Surface.METAL, Label.OTHER_STRUCTURE))
    return join(*parts)


def bridge(rng: np.random.Generator, width: float) -> Mesh:
    """Return the abutments and the deck of a bridge, which spans `width` metres along y."""
    depth = rng.uniform(4, 14)
    height = rng.uniform(4.6, 5.8)
    wall = box((depth, 1.0, height + 1), (0, 0, -1))
    walls = copies(wall, y=[-width / 2 - 0.5, width / 2 + 0.5])
    deck = box((depth, width + 30, 1.0), (0, 0, height))
    return _structure([walls, deck], Surface.PLASTER, rng)
