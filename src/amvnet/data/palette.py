"""The colours of all drawings: those of the classes, and of points that are marked.

Label files carry the official colours, some of which cannot be told apart in a picture.
"""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np

Color = tuple[int, int, int]  # RGB in 0..255

WRONG: Color = (255, 64, 54)
UNCERTAIN: Color = (255, 150, 180)  # unlike the colours of all classes of both benchmarks
GREYS = ((80, 90, 110), (128, 136, 148), (200, 200, 200))  # of points without a class or a mark

LEAST = 20.0  # distance of two colours in CIELAB from which they can be told apart
LIGHTNESS = (55, 80)  # of replacements in CIELAB: they show on black and on white
STEP = 15  # between the values of a channel that replacements may have

# From linear sRGB to CIE XYZ, relative to white (D65).
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = TO_XYZ.sum(axis=1)


@cache
def class_colors(colors: tuple[Color, ...]) -> tuple[Color, ...]:
    """Return the colours of classes in drawings, given the (K + 1) colours of a taxonomy.

    A colour that is like that of an earlier class, or of uncertain points, is replaced by the one
    that is the most unlike all others. The first colour, of points without a class, stays.
    """
    official = to_lab(np.array([*colors[1:], UNCERTAIN, WRONG, *GREYS]))
    candidates = np.array(list(product(range(0, 256, STEP), repeat=3)))
    lab = to_lab(candidates)
    is_visible = (lab[:, 0] > LIGHTNESS[0]) & (lab[:, 0] < LIGHTNESS[1])
    candidates, lab = candidates[is_visible], lab[is_visible]

    drawn = list(colors)
    taken = to_lab(np.array([UNCERTAIN]))
    for index, own in enumerate(official[: len(colors) - 1], start=1):
        if np.linalg.norm(taken - own, axis=1).min() < LEAST:
            others = np.concatenate([official, taken])
            distances = np.linalg.norm(lab[:, None] - others, axis=2).min(axis=1)
            best = distances.argmax()
            red, green, blue = candidates[best].tolist()
            drawn[index] = (red, green, blue)
            own = lab[best]
        taken = np.concatenate([taken, [own]])
    return tuple(drawn)


def to_lab(colors: np.ndarray) -> np.ndarray:
    """Return (N, 3) CIELAB values of (N, 3) RGB values in 0..255."""
    encoded = colors / 255
    linear = np.where(encoded > 0.04045, ((encoded + 0.055) / 1.055) ** 2.4, encoded / 12.92)
    ratio = linear @ TO_XYZ.T / WHITE
    x, y, z = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16 / 116).T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)
