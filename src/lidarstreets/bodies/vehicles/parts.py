"""Make the parts that several kinds of vehicles share."""

from collections.abc import Sequence

import numpy as np

from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, join, part
from lidarstreets.solids import box, copies, tube

# Mean distance that a pulse travels behind clear glass before dirt or a reflection ends it, metres.
CLEAR_GLASS_DEPTH = 4.0


def draw_paint(rng: np.random.Generator, light: float) -> Surface:
    """Draw a dark or a light paint; `light` is the chance of a light paint."""
    return Surface.LIGHT_PAINT if rng.random() < light else Surface.DARK_PAINT


def wheels(
    label: Label,
    axles: Sequence[float],
    width: float,
    radius: float,
    thickness: float = 0.22,
) -> Mesh:
    """Return two wheels for each axle.

    Args:
        label: class of the vehicle.
        axles: x of each axle, metres.
        width: distance between the outer sides of the two wheels, metres.
        radius: radius of the wheels, metres.
        thickness: width of a tyre, metres.
    """
    tyres = []
    for x in axles:
        for side in (-1, 1):
            inside = (x, side * (width / 2 - thickness), radius)
            outside = (x, side * (width / 2 + 0.01), radius)
            tyres.append(tube(inside, outside, radius))
    return part(tyres, Surface.RUBBER, label)


def glass(solids: Sequence[np.ndarray], label: Label, clear: bool) -> Mesh:
    """Return convex panes or cabins of glass; pulses pass only glass that is clear."""
    if not clear:
        return part(solids, Surface.GLASS, label)

    outward = [facing_outwards(solid) for solid in solids]
    return part(outward, Surface.GLASS, label, depth=CLEAR_GLASS_DEPTH)


def facing_outwards(solid: np.ndarray) -> np.ndarray:
    """Return a convex solid, (T, 3, 3), whose corners are counter-clockwise seen from outside."""
    sides = np.diff(solid, axis=1)
    normals = np.cross(sides[:, 0], sides[:, 1])
    middle = solid.reshape(-1, 3).mean(axis=0)
    inward = np.einsum("ti,ti->t", solid.mean(axis=1) - middle, normals) < 0

    turned = solid.copy()
    turned[inward] = solid[inward][:, ::-1]
    return turned


def plates_and_lamps(
    label: Label, half: float, width: float, plate_z: float, lamp_z: float
) -> Mesh:
    """Return the bright number plates and lamps of a vehicle that is 2 * `half` metres long."""
    plates = copies(box((0.03, 0.5, 0.11)), x=[-(half + 0.01), half + 0.01], z=plate_z)
    return join(part([plates], Surface.PLATE, label), lamps(half, width, lamp_z, label))


def lamps(half: float, width: float, z: float, label: Label) -> Mesh:
    """Return the four lamps at the corners of a vehicle, `z` metres high."""
    lamp = box((0.05, 0.22, 0.11))
    x = [[-(half - 0.01)], [half - 0.02]]
    four = copies(lamp, x=x, y=[-(width / 2 - 0.2), width / 2 - 0.2], z=z)
    return part([four], Surface.SIGN_FACE, label)
