"""The ground of one street: its bends and crossings, and its height and class at any place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amvnet.simulation.materials import Label, Surface
from amvnet.simulation.mesh import Mesh, part
from amvnet.simulation.styles import Style

# 2 pi, rounded: the exact value would change the streets of every seed.
_TURN = 6.283185
_COARSE_TURN = 6.28

# Metres: spacing of the two grids of the ground, and how far from the middle line they reach.
FINE_STEP = 0.5
FINE_REACH = 32.0
COARSE_STEP = 4.0
COARSE_REACH = 110.0
# Metres by which the coarse grid is lower, so that the fine one covers it.
COARSE_DROP = 0.3


@dataclass(frozen=True)
class Crossing:
    """A straight side road.

    Attributes:
        x, y: where it meets the middle line of the street.
        yaw: its direction in radians.
        width: metres.
        sides: the sides on which it leaves the street, -1 right and 1 left.
    """

    x: float
    y: float
    yaw: float
    width: float
    sides: tuple[int, ...]


@dataclass(frozen=True)
class Patch:
    """A rectangle of other ground off the road, in street coordinates.

    Attributes:
        x: from and to, along the street.
        t: from and to, across the street.
        label: class of the ground.
    """

    x: tuple[float, float]
    t: tuple[float, float]
    label: Label


@dataclass(frozen=True)
class _Places:
    """Where places lie in a street; all arrays have one shape, distances are in metres.

    Attributes:
        x, t: street coordinates.
        road: distance from the edge of the carriageway; negative on it.
        crossing: distance from the edge of the nearest side road; negative on it.
        kerb: distance from the kerb; negative on the side of the road.
    """

    x: np.ndarray
    t: np.ndarray
    road: np.ndarray
    crossing: np.ndarray
    kerb: np.ndarray


class Ground:
    """Height and class of the ground as functions of the place.

    The middle line of the street is y = f(x), a sum of waves. Street coordinates are x of the
    nearest point of that line and t, the signed distance from it, which is positive to the left of
    the direction of travel, +x. The methods take and return arrays unless they say otherwise.
    """

    def __init__(self, style: Style, length: float, rng: np.random.Generator) -> None:
        self.style = style
        self.length = length
        self.patches: list[Patch] = []

        # Bends: amplitude, wavelength and phase of two waves of the middle line.
        bend = 0.0 if rng.random() < 0.35 else rng.uniform(0.1, 0.42)
        wavelengths = rng.uniform(180, 500, size=2)
        amplitudes = bend * 0.6 * wavelengths / (2 * np.pi)
        phases = rng.uniform(0, 6.3, size=2)
        self._bends = np.column_stack([amplitudes, wavelengths, phases])

        # Hills: amplitude, wave vector and phase of three waves, from long to short.
        wavelengths = np.array([rng.uniform(200, 400), rng.uniform(80, 160), rng.uniform(25, 60)])
        amplitudes = np.array([1.0, 0.35, 0.07]) * rng.uniform(0.1, 1.4, size=3)
        direction = rng.uniform(0, np.pi, size=3)
        wave_x = _COARSE_TURN / wavelengths * np.cos(direction)
        wave_y = _COARSE_TURN / wavelengths * np.sin(direction)
        self._hills = np.column_stack([amplitudes, wave_x, wave_y, direction * 5])

        self._bumps = rng.uniform(0.02, 0.08) * rng.uniform(0.5, 1.0, size=3)
        self.crossings = self._draw_crossings(rng)
        self._tints = rng.standard_normal(256)

    def _draw_crossings(self, rng: np.random.Generator) -> list[Crossing]:
        crossings: list[Crossing] = []

        x = rng.uniform(40, 140)
        while self.style.kind != "fast" and x < self.length - 20:
            sides = ((-1, 1), (-1,), (1,))[rng.choice(3, p=[0.4, 0.3, 0.3])]
            yaw = float(self.yaw(x) + np.pi / 2 + rng.normal(scale=0.12))
            width = rng.uniform(4.5, 8.0)
            crossings.append(Crossing(x, float(self.middle(x)), yaw, width, sides))

            x += rng.uniform(60, 160)
        return crossings

    def middle(self, x: np.ndarray | float) -> np.ndarray:
        """Return y of the middle line of the street."""
        y = np.zeros(np.shape(x))
        for amplitude, wavelength, phase in self._bends:
            y = y + amplitude * np.sin(_TURN / wavelength * np.asarray(x) + phase)
        return y

    def yaw(self, x: np.ndarray | float) -> np.ndarray:
        """Return the direction of the street in radians."""
        slope = np.zeros(np.shape(x))
        for amplitude, wavelength, phase in self._bends:
            wave = np.cos(_TURN / wavelength * np.asarray(x) + phase)
            slope = slope + amplitude * _TURN / wavelength * wave
        return np.arctan(slope)

    def pose_at(self, x: float, t: float) -> tuple[float, float, float]:
        """Return (x, y, yaw) at street coordinates; takes and returns single numbers."""
        yaw = float(self.yaw(x))
        return x - t * np.sin(yaw), float(self.middle(x)) + t * np.cos(yaw), yaw

    def street_coordinates(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the street coordinates of places."""
        # One step towards the foot of the perpendicular on the middle line.
        yaw = self.yaw(x)
        foot = x + (y - self.middle(x)) * np.sin(yaw) * np.cos(yaw)

        yaw = self.yaw(foot)
        return foot, (y - self.middle(foot)) * np.cos(yaw) - (x - foot) * np.sin(yaw)

    def distance_from_crossings(self, x: np.ndarray, y: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the distance from the edge of the nearest side road; negative on it."""
        nearest = np.full(np.shape(x), np.inf)
        for crossing in self.crossings:
            across = (y - crossing.y) * np.cos(crossing.yaw)
            along = (x - crossing.x) * np.sin(crossing.yaw)
            distance = np.abs(across - along) - crossing.width / 2

            on_its_sides = np.isin(np.sign(t), crossing.sides) | (np.abs(t) < self.style.road / 2)
            nearest = np.minimum(nearest, np.where(on_its_sides, distance, np.inf))
        return nearest

    def front(self, side: int) -> float:
        """Return |t| where the plots of one side (-1 right, 1 left) begin."""
        style = self.style
        index = int(side > 0)
        return style.road / 2 + style.parking[index] + style.verge[index] + style.sidewalk[index]

    def height(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """Return the height of the ground at places."""
        x = np.asarray(x, dtype=float)
        y = np.asarray(y, dtype=float)
        places = self._locate(x, y)

        z = np.zeros(np.shape(x))
        for amplitude, wave_x, wave_y, phase in self._hills:
            z = z + amplitude * np.sin(wave_x * x + wave_y * y + phase)

        # The crown of the road, the kerb, and the banks that begin behind the sidewalk.
        z = z - 0.02 * np.minimum(np.abs(places.t), self.style.road / 2)
        z = z + self.style.kerb * np.clip(places.kerb / 0.15, 0, 1)
        pavement = _of_side(self.style.verge, places.t) + _of_side(self.style.sidewalk, places.t)
        off_pavement = np.clip(np.minimum(places.road, places.kerb) - pavement, 0, 25)
        z = z + off_pavement * _of_side(self.style.bank, places.t)

        # Bumps, on the plots only.
        a, b, c = self._bumps
        bumps = a * np.sin(1.9 * x + 0.7 * y) + b * np.sin(0.6 * x - 1.3 * y)
        bumps = bumps + c * np.sin(3.7 * y + 2.9 * x)
        return z + np.clip(off_pavement / 2, 0, 1) * bumps

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the class ids of the ground at places: (N,) uint16."""
        places = self._locate(x, y)
        kerb = places.kerb
        verge = _of_side(self.style.verge, places.t)
        sidewalk = _of_side(self.style.sidewalk, places.t)

        # From the plots to the road: each step may overwrite those before it.
        label = np.full(np.shape(x), Label.TERRAIN, dtype=np.uint16)
        label[(kerb >= verge) & (kerb < verge + sidewalk)] = Label.SIDEWALK

        plots = np.flatnonzero(kerb >= verge + sidewalk)
        plot_x = places.x[plots]
        plot_t = places.t[plots]
        for patch in self.patches:
            inside = (plot_x > patch.x[0]) & (plot_x < patch.x[1])
            inside &= (plot_t > patch.t[0]) & (plot_t < patch.t[1])
            label[plots[inside]] = patch.label

        label[(kerb < 0) & (places.road >= 0)] = Label.PARKING
        label[(places.road < 0) | (places.crossing < 0)] = Label.ROAD
        if self.style.painted:
            label[_is_painted(places) & (places.crossing > 1)] = Label.LANE_MARKING
        return label

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Return the tint of the ground, as in `Mesh`; it varies from place to place."""
        pattern = np.sin(0.21 * x + 1.3 * np.sin(0.13 * y))
        return 0.8 * self._tints[label] + 0.8 * pattern * np.sin(0.33 * y + 0.05 * x)

    def mesh(self) -> Mesh:
        """Return the ground as triangles of class 0: a fine grid over a coarse one."""
        fine = self._grid(FINE_STEP, FINE_REACH, 0.0)
        coarse = self._grid(COARSE_STEP, COARSE_REACH, COARSE_DROP)
        return part([fine, coarse], Surface.GRASS, 0)

    def _grid(self, step: float, reach: float, drop: float) -> np.ndarray:
        """Return the (T, 3, 3) triangles of a square grid up to `reach` from the middle line."""
        xs = np.arange(-10.0, self.length + 10.0, step)
        lowest_y = self.middle(xs).min() - reach
        highest_y = self.middle(xs).max() + reach
        x, y = np.meshgrid(xs, np.arange(lowest_y, highest_y, step), indexing="ij")
        corners = np.stack([x, y, self.height(x, y) - drop], axis=-1).astype(np.float32)

        _, t = self.street_coordinates(x[:-1, :-1], y[:-1, :-1])
        within = np.abs(t) < reach

        a = corners[:-1, :-1][within]
        b = corners[1:, :-1][within]
        c = corners[1:, 1:][within]
        d = corners[:-1, 1:][within]
        return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])

    def _locate(self, x: np.ndarray, y: np.ndarray) -> _Places:
        """Measure where places lie in the street."""
        along, t = self.street_coordinates(x, y)
        road = np.abs(t) - self.style.road / 2
        crossing = self.distance_from_crossings(x, y, t)

        # The parking lane ends before a side road.
        lane = np.where(crossing > 6.0, _of_side(self.style.parking, t), 0.0)
        kerb = np.minimum(road - lane, crossing)
        return _Places(along, t, road, crossing, kerb)


def _of_side(pair: tuple[float, float], t: np.ndarray) -> np.ndarray:
    """Return the value of a (right, left) pair that holds at each t."""
    return np.where(t < 0, pair[0], pair[1])


def _is_painted(places: _Places) -> np.ndarray:
    """Return True on the dashed middle line and on the lines at both edges of the carriageway."""
    middle_line = (np.abs(places.t) < 0.07) & (places.x % 9 < 4)
    edge_line = np.abs(places.road + 0.3) < 0.07
    return middle_line | edge_line
