"""The lie of one street: its bends and crossings, and height and class of the ground anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amvnet.simulation.materials import Label, Surface
from amvnet.simulation.mesh import Mesh, join, part
from amvnet.simulation.styles import Style


@dataclass(frozen=True)
class Crossing:
    """A straight side road: where it meets the street, how far it is turned, its width, on which sides it leaves."""

    x: float
    y: float
    yaw: float
    width: float
    sides: tuple[int, ...]


@dataclass(frozen=True)
class Patch:
    """A rectangle of other ground beside the road, in (x along the street, lateral) coordinates."""

    x: tuple[float, float]
    t: tuple[float, float]
    label: Label


class Ground:
    """Height and class of the ground as functions of the place.

    The street's middle line is y = f(x), a sum of waves; `t` is the signed distance from it, positive to the
    left of the direction of travel, which is +x. All functions take and give arrays.
    """

    def __init__(self, style: Style, length: float, rng: np.random.Generator) -> None:
        self.style = style
        self.length = length
        self.patches: list[Patch] = []
        bend = 0.0 if rng.random() < 0.35 else rng.uniform(0.1, 0.42)
        waves = rng.uniform(180, 500, size=2)
        self._bends = np.column_stack(
            [bend * 0.6 * waves / (2 * np.pi), waves, rng.uniform(0, 6.3, size=2)]
        )
        hills = np.array([rng.uniform(200, 400), rng.uniform(80, 160), rng.uniform(25, 60)])
        rises = np.array([1.0, 0.35, 0.07]) * rng.uniform(0.1, 1.4, size=3)
        turn = rng.uniform(0, np.pi, size=3)
        self._hills = np.column_stack(
            [rises, 6.28 / hills * np.cos(turn), 6.28 / hills * np.sin(turn), turn * 5]
        )
        self._bumps = rng.uniform(0.02, 0.08) * rng.uniform(0.5, 1.0, size=3)
        self.crossings = self._draw_crossings(rng)
        self._tints = rng.standard_normal(256)

    def _draw_crossings(self, rng: np.random.Generator) -> list[Crossing]:
        found: list[Crossing] = []
        x = rng.uniform(40, 140)
        while self.style.kind != "fast" and x < self.length - 20:
            sides = ((-1, 1), (-1,), (1,))[rng.choice(3, p=[0.4, 0.3, 0.3])]
            yaw = float(self.yaw(x) + np.pi / 2 + rng.normal(scale=0.12))
            found.append(Crossing(x, float(self.middle(x)), yaw, rng.uniform(4.5, 8.0), sides))
            x += rng.uniform(60, 160)
        return found

    def middle(self, x: np.ndarray | float) -> np.ndarray:
        """y of the street's middle line."""
        return sum(
            a * np.sin(6.283185 / wave * np.asarray(x) + phase) for a, wave, phase in self._bends
        )

    def yaw(self, x: np.ndarray | float) -> np.ndarray:
        """Direction of the street."""
        slope = sum(
            a * 6.283185 / wave * np.cos(6.283185 / wave * np.asarray(x) + phase)
            for a, wave, phase in self._bends
        )
        return np.arctan(slope)

    def at(self, x: float, t: float) -> tuple[float, float, float]:
        """The place (x, y, yaw) that lies `t` to the left of the middle line at `x`."""
        yaw = float(self.yaw(x))
        return x - t * np.sin(yaw), float(self.middle(x)) + t * np.cos(yaw), yaw

    def along(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Street coordinates of places: x of the nearest point of the middle line, and t."""
        yaw = self.yaw(x)
        near = x + (y - self.middle(x)) * np.sin(yaw) * np.cos(
            yaw
        )  # one step towards the foot of the perpendicular
        yaw = self.yaw(near)
        return near, (y - self.middle(near)) * np.cos(yaw) - (x - near) * np.sin(yaw)

    def beside_crossing(self, x: np.ndarray, y: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Distance from the nearest side road's edge; negative on it."""
        best = np.full(np.shape(x), np.inf)
        for c in self.crossings:
            off = np.abs((y - c.y) * np.cos(c.yaw) - (x - c.x) * np.sin(c.yaw)) - c.width / 2
            there = np.isin(np.sign(t), c.sides) | (np.abs(t) < self.style.road / 2)
            best = np.minimum(best, np.where(there, off, np.inf))
        return best

    def _beyond_kerb(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Street coordinates x and t, distance from the carriageway, from the side roads, and from the kerb."""
        near, t = self.along(x, y)
        road = np.abs(t) - self.style.road / 2
        side = self.beside_crossing(x, y, t)
        lane = np.where(side > 6.0, self._of_side(self.style.parking, t), 0.0)
        return near, t, road, side, np.minimum(road - lane, side)

    @staticmethod
    def _of_side(pair: tuple[float, float], t: np.ndarray) -> np.ndarray:
        return np.where(t < 0, pair[0], pair[1])

    def front(self, side: int) -> float:
        """|t| where the plots of one side (-1 right, 1 left) begin."""
        s, i = self.style, int(side > 0)
        return s.road / 2 + s.parking[i] + s.verge[i] + s.sidewalk[i]

    def height(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """Height of the ground: hills, the road's crown, the kerb, the banks beside the street, bumps off it."""
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        _, t, road, _, kerb = self._beyond_kerb(x, y)
        z = sum(rise * np.sin(kx * x + ky * y + phase) for rise, kx, ky, phase in self._hills)
        z = z - 0.02 * np.minimum(np.abs(t), self.style.road / 2)
        z = z + self.style.kerb * np.clip(kerb / 0.15, 0, 1)
        pavement = self._of_side(self.style.verge, t) + self._of_side(self.style.sidewalk, t)
        plot = np.clip(np.minimum(road, kerb) - pavement, 0, 25)
        z = z + plot * self._of_side(self.style.bank, t)
        a, b, c = self._bumps
        bumps = (
            a * np.sin(1.9 * x + 0.7 * y)
            + b * np.sin(0.6 * x - 1.3 * y)
            + c * np.sin(3.7 * y + 2.9 * x)
        )
        return z + np.clip(plot / 2, 0, 1) * bumps

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Raw class ids of the ground at places. (N,) uint16."""
        near, t, road, side, kerb = self._beyond_kerb(x, y)
        verge, walk = self._of_side(self.style.verge, t), self._of_side(self.style.sidewalk, t)
        label = np.full(np.shape(x), Label.TERRAIN, dtype=np.uint16)
        label[(kerb >= verge) & (kerb < verge + walk)] = Label.SIDEWALK
        off = np.flatnonzero(kerb >= verge + walk)
        for patch in self.patches:
            inside = (near[off] > patch.x[0]) & (near[off] < patch.x[1])
            label[off[inside & (t[off] > patch.t[0]) & (t[off] < patch.t[1])]] = patch.label
        label[(kerb < 0) & (road >= 0)] = Label.PARKING
        label[(road < 0) | (side < 0)] = Label.ROAD
        if self.style.painted:
            label[self._painted(near, t, road) & (side > 1)] = Label.LANE_MARKING
        return label

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """How much brighter the ground is than others of its class, as in `Mesh`; it changes from place to place."""
        return 0.8 * self._tints[label] + 0.8 * np.sin(0.21 * x + 1.3 * np.sin(0.13 * y)) * np.sin(
            0.33 * y + 0.05 * x
        )

    @staticmethod
    def _painted(x: np.ndarray, t: np.ndarray, road: np.ndarray) -> np.ndarray:
        """True on the dashed middle line and on the lines at both edges."""
        return ((np.abs(t) < 0.07) & (x % 9 < 4)) | (np.abs(road + 0.3) < 0.07)

    def mesh(
        self, fine: float = 0.5, near: float = 32.0, coarse: float = 4.0, far: float = 110.0
    ) -> Mesh:
        """The ground as triangles of class 0: a fine grid beside the road, a coarse one a little lower around it."""
        sheets = [self._sheet(fine, near, 0.0), self._sheet(coarse, far, 0.3)]
        return join([part(sheet, Surface.GRASS, 0) for sheet in sheets])

    def _sheet(self, step: float, reach: float, below: float) -> np.ndarray:
        """A square grid as far as `reach` from the middle line. (T, 3, 3)."""
        xs = np.arange(-10.0, self.length + 10.0, step)
        low, high = self.middle(xs).min() - reach, self.middle(xs).max() + reach
        x, y = np.meshgrid(xs, np.arange(low, high, step), indexing="ij")
        grid = np.stack([x, y, self.height(x, y) - below], axis=-1).astype(np.float32)
        a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
        kept = np.abs(self.along(x[:-1, :-1], y[:-1, :-1])[1]) < reach
        return np.concatenate(
            [np.stack(corners, axis=2)[kept] for corners in ((a, b, c), (a, c, d))]
        )
