"""The ground of one street: its bends and crossings, and its height and class at any place."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from amvnet.simulation.chance import weighted_choice
from amvnet.simulation.materials import GROUND_SURFACES, REFLECTIONS, Label, Surface
from amvnet.simulation.mesh import Mesh, part
from amvnet.simulation.streets.plans import Island, Roundabout, SideRoad, rounded_union, strip_at
from amvnet.simulation.streets.relief import Relief
from amvnet.simulation.streets.styles import Strip, Style

# Metres: spacing of the two grids of the ground, and how far from the middle line they reach.
FINE_STEP = 0.62
FINE_REACH = 32.0
COARSE_STEP = 4.0
COARSE_REACH = 110.0
# Metres by which the coarse grid is lower, so that the fine one covers it.
COARSE_DROP = 0.3
# Metres on either side of a kerb over which its height changes.
KERB_RAMP = 0.03
# Metres: the parking lane ends this far from a side road, over the second distance.
PARKING_END = 5.0
PARKING_TAPER = 1.5
# Metres at both ends of an island between two parking bays.
BAY_GAP = 2.0


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
        road: distance from the edge of the nearest carriageway; negative on it.
        crossing: distance from the edge of the nearest side road; negative on it.
        branch: index of that side road; -1 if the street itself is nearer.
        kerb: distance from the kerb; negative on the side of the road.
        island: distance from the edge of the nearest island; negative on it.
    """

    x: np.ndarray
    t: np.ndarray
    road: np.ndarray
    crossing: np.ndarray
    branch: np.ndarray
    kerb: np.ndarray
    island: np.ndarray


class Ground:
    """Height and class of the ground as functions of the place.

    The middle line of the street is y = f(x), a sum of waves. Street coordinates are x of the
    nearest point of that line and t, the signed distance from it, which is positive to the left of
    the direction of travel, +x. The methods take and return arrays unless they say otherwise.

    Args:
        style: the numbers of the street.
        length: metres along x.
        rng: draws the plan and the relief.
        course: from and to, the x between which the sensor drives.
    """

    def __init__(
        self,
        style: Style,
        length: float,
        rng: np.random.Generator,
        course: tuple[float, float] | None = None,
    ) -> None:
        self.style = style
        self.length = length
        self.course = course or (0.0, length)
        self.patches: list[Patch] = []
        # Stretches (side, from, to) along the street that no plot may use.
        self.reserved: list[tuple[int, float, float]] = []

        self._bends = _draw_bends(style, rng)
        self._relief = Relief(style, rng)
        self.start, self.end = self._draw_ends(rng)
        self.roundabout = self._draw_roundabout(rng)
        self.crossings = self._draw_crossings(rng)
        self.islands = self._draw_islands(rng)
        self.humps = self._draw_humps(rng)
        self.crosswalks = self._draw_crosswalks(rng)

        # Places along the street where the kerb is lowered for drives.
        self._drive_period = rng.uniform(9, 30)
        self._drive_width = rng.uniform(1.5, 4.0)
        self._draw_tints(rng)

    def _draw_ends(self, rng: np.random.Generator) -> tuple[float, float]:
        """Draw where the street begins and ends; most streets do so out of sight."""
        start = -np.inf
        end = np.inf
        if self.style.kind in ("residential", "living", "rural") and rng.random() < 0.25:
            end = self.course[1] + rng.uniform(12, 60)
        if self.style.kind in ("residential", "living") and rng.random() < 0.12:
            start = self.course[0] - rng.uniform(12, 60)
        return start, end

    def _draw_roundabout(self, rng: np.random.Generator) -> Roundabout | None:
        """Draw a roundabout outside of the way of the sensor, or none."""
        if self.style.kind in ("motorway", "living") or rng.random() > 0.12:
            return None

        island = rng.uniform(2.0, 14.0)
        radius = island + rng.uniform(5, 9)
        distance = radius + rng.uniform(8, 35)
        x = self.course[1] + distance if rng.random() < 0.6 else self.course[0] - distance
        if not self.start + radius < x < self.end - radius:
            return None

        chances = {Label.TERRAIN: 0.6, Label.OTHER_GROUND: 0.3, Label.SIDEWALK: 0.1}
        label = weighted_choice(rng, chances)
        return Roundabout(x, float(self.middle(x)), x, radius, island, label)

    def _draw_crossings(self, rng: np.random.Generator) -> list[SideRoad]:
        crossings: list[SideRoad] = []
        if self.style.kind == "motorway":
            return self._draw_ramps(rng)

        x = rng.uniform(10, 140 / self.style.junctions)
        while x < self.length - 20:
            sides = ((-1, 1), (-1,), (1,))[rng.choice(3, p=[0.35, 0.35, 0.3])]
            if self.start + 8 < x < self.end - 8:
                for side in sides:
                    crossings.append(self._draw_side_road(rng, x, side))
            x += (12 + rng.exponential(80)) / self.style.junctions

        if self.roundabout:
            for side in (-1, 1):
                if rng.random() < 0.8:
                    crossings.append(self._draw_side_road(rng, self.roundabout.x, side))
        # A street that ends may end at a road across.
        if np.isfinite(self.end) and rng.random() < 0.6:
            for side in (-1, 1):
                crossings.append(self._draw_side_road(rng, self.end - 3.0, side))
        return crossings

    def _draw_side_road(self, rng: np.random.Generator, x: float, side: int) -> SideRoad:
        """Draw a side road that leaves the street at x."""
        turn = rng.normal(scale=0.15) if rng.random() < 0.5 else rng.uniform(-1.0, 1.0)
        is_drive = rng.random() < 0.2
        width = rng.uniform(2.6, 4.0) if is_drive else rng.uniform(4.5, 9.0)
        is_short = is_drive or rng.random() < 0.3
        length = self.style.road / 2 + rng.uniform(15, 60) if is_short else np.inf
        has_bend = rng.random() < 0.5

        return SideRoad(
            x=x,
            y=float(self.middle(x)),
            street_x=x,
            yaw=float(self.yaw(x) + side * np.pi / 2 + turn),
            side=side,
            width=float(width),
            bend=float(rng.uniform(-1, 1) / 45) if has_bend else 0.0,
            length=float(length),
            turning=float(rng.uniform(5, 9)) if is_short and rng.random() < 0.3 else 0.0,
            corner=float(rng.uniform(1, 3) if is_drive else rng.uniform(2, 12)),
            strips=_draw_side_strips(rng, self.style),
        )

    def _draw_ramps(self, rng: np.random.Generator) -> list[SideRoad]:
        """Draw the ramps of a motorway, which leave it at small angles."""
        ramps = []
        for side in (-1, 1):
            if rng.random() < 0.5:
                x = rng.uniform(20, self.length - 40)
                away = 0.0 if rng.random() < 0.5 else np.pi
                opening = side * rng.uniform(0.08, 0.25) * (1 if away == 0 else -1)
                px, py, yaw = self.pose_at(x, side * (self.style.road / 2 - 2.5))
                ramp = SideRoad(
                    x=px,
                    y=py,
                    street_x=x,
                    yaw=yaw + away + opening,
                    side=side,
                    width=float(rng.uniform(5, 7.5)),
                    corner=1.0,
                    strips=(Strip(float(rng.uniform(0.5, 2.5)), Label.TERRAIN, raised=False),),
                )
                ramps.append(ramp)
        return ramps

    def _draw_islands(self, rng: np.random.Generator) -> list[Island]:
        """Draw the islands in the middle of the road, with gaps at the junctions."""
        style = self.style
        if not style.median:
            return []

        half = style.median / 2 - rng.uniform(0.1, 0.4)
        gaps = [-50.0]
        if style.kind != "motorway":
            for crossing in sorted(self.crossings, key=lambda road: road.street_x):
                if rng.random() < 0.75:
                    gaps.append(crossing.street_x)
        gaps.append(self.length + 50.0)

        islands = []
        for left, right in pairwise(gaps):
            opening = rng.uniform(7, 12)
            start = max(left + opening, self.start + 10)
            stop = min(right - opening, self.end - 10)
            if not style.has_long_median:
                start = max(start, rng.uniform(0, self.length))
                stop = min(stop, start + rng.uniform(5, 15))
            if stop - start > 2 * half:
                islands.append(Island((start, stop), (-half, half), style.median_label))
        return [island for island in islands if not self._meets_roundabout(island)]

    def _meets_roundabout(self, island: Island) -> bool:
        if self.roundabout is None:
            return False

        reach = self.roundabout.radius
        return island.x[0] < self.roundabout.x + reach and island.x[1] > self.roundabout.x - reach

    def _draw_humps(self, rng: np.random.Generator) -> np.ndarray:
        """Draw (H, 2) humps of the road: place along the street, and height in metres."""
        if self.style.kind not in ("living", "residential") or rng.random() > 0.25:
            return np.zeros((0, 2))

        x = np.arange(rng.uniform(0, 40), self.length, rng.uniform(25, 60))
        return np.column_stack([x, np.full(len(x), rng.uniform(0.04, 0.12))])

    def _draw_crosswalks(self, rng: np.random.Generator) -> list[tuple[float, float]]:
        """Draw the zebra crossings: (from, to) along the street."""
        if self.style.kind in ("motorway", "fast") or not self.style.painted:
            return []

        crosswalks = []
        for crossing in self.crossings:
            if rng.random() < 0.4:
                start = crossing.street_x + crossing.width / 2 + rng.uniform(2, 5)
                crosswalks.append((start, start + rng.uniform(2.5, 4.5)))
        return crosswalks

    def _draw_tints(self, rng: np.random.Generator) -> None:
        """Draw how bright each class of ground is in this street."""
        self._tints = 0.9 * rng.standard_normal(256)
        wanted = {Label.ROAD: rng.lognormal(np.log(0.28), 0.17)}
        if rng.random() < 0.12:
            wanted[Label.ROAD] = rng.uniform(0.33, 0.44)  # concrete or cobbles

        # Half of the sidewalks, lots and paved verges are asphalt or as bright as it.
        for label in (Label.SIDEWALK, Label.PARKING, Label.OTHER_GROUND):
            if rng.random() < 0.5:
                wanted[label] = wanted[Label.ROAD] * rng.lognormal(0, 0.06)
            else:
                wanted[label] = rng.lognormal(np.log(0.34), 0.2)
        for label, reflectivity in wanted.items():
            reflection = REFLECTIONS[GROUND_SURFACES[label]]
            ratio = np.log(reflectivity / reflection.reflectivity)
            self._tints[label] = ratio / reflection.shade

        # Random numbers for the repairs of the road and its manholes.
        self._cells = rng.random((64, 64))

    def middle(self, x: np.ndarray | float) -> np.ndarray:
        """Return y of the middle line of the street."""
        y = np.zeros(np.shape(x))
        for amplitude, wavelength, phase in self._bends:
            y = y + amplitude * np.sin(2 * np.pi / wavelength * np.asarray(x) + phase)
        return y

    def yaw(self, x: np.ndarray | float) -> np.ndarray:
        """Return the direction of the street in radians."""
        slope = np.zeros(np.shape(x))
        for amplitude, wavelength, phase in self._bends:
            wave = np.cos(2 * np.pi / wavelength * np.asarray(x) + phase)
            slope = slope + amplitude * 2 * np.pi / wavelength * wave
        return np.arctan(slope)

    def pose_at(self, x: float, t: float) -> tuple[float, float, float]:
        """Return (x, y, yaw) at street coordinates; takes and returns single numbers."""
        yaw = float(self.yaw(x))
        return x - t * np.sin(yaw), float(self.middle(x)) + t * np.cos(yaw), yaw

    def lane_pose(self, x: float, t: float) -> tuple[float, float, float]:
        """Return (x, y, yaw) of a vehicle in the lane at t, which goes round a roundabout."""
        step = 0.5
        swerve = self._swerve(x, t)
        px, py, yaw = self.pose_at(x, swerve)
        return px, py, yaw + float(np.arctan((self._swerve(x + step, t) - swerve) / step))

    def _swerve(self, x: float, t: float) -> float:
        """Return t of a lane next to a roundabout."""
        if self.roundabout is None:
            return t

        reach = self.roundabout.radius + 8.0
        share = min(abs(x - self.roundabout.street_x) / reach, 1.0)
        weight = np.cos(0.5 * np.pi * share) ** 1.5
        side = 1 if t >= 0 else -1
        return float(t + weight * (side * self.roundabout.ring - t))

    def street_coordinates(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the street coordinates of places."""
        # Steps towards the foot of the perpendicular on the middle line.
        foot = x
        for _ in range(2):
            yaw = self.yaw(foot)
            ahead = (x - foot) * np.cos(yaw) + (y - self.middle(foot)) * np.sin(yaw)
            foot = foot + ahead * np.cos(yaw)

        yaw = self.yaw(foot)
        return foot, (y - self.middle(foot)) * np.cos(yaw) - (x - foot) * np.sin(yaw)

    def distance_from_crossings(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance from the nearest side road or roundabout; negative on it."""
        nearest = np.full(np.shape(x), np.inf)
        for crossing in self.crossings:
            nearest = np.minimum(nearest, crossing.distance(x, y))
        if self.roundabout:
            centre = np.hypot(x - self.roundabout.x, y - self.roundabout.y)
            nearest = np.minimum(nearest, centre - self.roundabout.radius)
        return nearest

    def is_street(self, x: float, margin: float = 0.0) -> bool:
        """Return whether the street passes x, `margin` metres or more from its ends."""
        return self.start + margin < x < self.end - margin

    def front(self, side: int) -> float:
        """Return |t| where the plots of one side (-1 right, 1 left) begin."""
        index = int(side > 0)
        return self.kerb_t(side) + sum(strip.width for strip in self.style.strips[index])

    def kerb_t(self, side: int) -> float:
        """Return |t| of the kerb of one side, away from side roads."""
        return self.style.road / 2 + self.style.parking[int(side > 0)]

    def is_bay(self, x: float) -> bool:
        """Return whether the parking lanes are not interrupted by an island at x."""
        return bool(_bay(np.array([x]), self.style.parking_period)[0])

    def height(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """Return the height of the ground at places."""
        x = np.asarray(x, dtype=float)
        y = np.asarray(y, dtype=float)
        return self._height(x, y, self._locate(x, y))

    def _height(self, x: np.ndarray, y: np.ndarray, places: _Places) -> np.ndarray:
        style = self.style
        z = self._relief.hills(x, y)

        # The crown of the road, its humps, and the islands on it.
        z = z - 0.02 * np.minimum(np.abs(places.t), style.road / 2)
        for hump_x, hump_height in self.humps:
            bump = np.clip(1 - ((places.x - hump_x) / 1.8) ** 2, 0, 1)
            z = z + np.where(places.road < 0, hump_height * bump, 0)
        z = z + 0.14 * _ramp(-places.island)

        # The kerb is lower at drives.
        from_drive = np.abs((places.x + 0.3 * self._drive_period) % self._drive_period)
        lowered = 0.2 + 0.8 * np.clip((from_drive - self._drive_width) / 0.8, 0, 1)
        kerb = style.kerb * lowered

        for strips, is_here in self._profiles(places):
            rise = np.zeros(np.shape(x))
            edge = 0.0
            level = 0.0
            for strip in strips:
                next_level = 1.0 if strip.raised else 0.0
                if next_level != level:
                    rise = rise + (next_level - level) * _ramp(places.kerb - edge)
                level = next_level
                edge += strip.width
            z = z + np.where(is_here, kerb * rise, 0)

        # Along side roads, the land begins as far from the kerb as along the street.
        right, left = (sum(strip.width for strip in strips) for strips in style.strips)
        pavement = right + (left - right) * np.clip(0.5 + places.t / 4, 0, 1)
        return z + self._relief.beyond(places.kerb - pavement, places.t, places.x, x, y)

    def _profiles(self, places: _Places) -> list[tuple[tuple[Strip, ...], np.ndarray]]:
        """Return the strips of each road next to the places where it is the nearest."""
        is_street = places.branch < 0
        profiles = [
            (self.style.strips[0], is_street & (places.t < 0)),
            (self.style.strips[1], is_street & (places.t >= 0)),
        ]
        for index, crossing in enumerate(self.crossings):
            profiles.append((crossing.strips, places.branch == index))
        return profiles

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the class ids of the ground at places: (N,) uint16."""
        places = self._locate(x, y)

        # From the plots to the road: each step may overwrite those before it.
        label = np.full(np.shape(x), Label.TERRAIN, dtype=np.uint16)
        off = np.zeros(np.shape(x))
        for strips, is_here in self._profiles(places):
            rows = np.flatnonzero(is_here)
            label[rows], off[rows] = strip_at(strips, places.kerb[rows], Label.TERRAIN)

        plots = np.flatnonzero(off >= 0)
        plot_x = places.x[plots]
        plot_t = places.t[plots]
        for patch in self.patches:
            inside = (plot_x > patch.x[0]) & (plot_x < patch.x[1])
            inside &= (plot_t > patch.t[0]) & (plot_t < patch.t[1])
            label[plots[inside]] = patch.label

        label[(places.kerb < 0) & (places.road >= 0)] = Label.PARKING
        on_road = places.road < 0
        label[on_road] = Label.ROAD
        if self.style.painted:
            label[on_road & self._is_painted(places)] = Label.LANE_MARKING

        for island in self.islands:
            label[island.distance(places.x, places.t) < 0] = island.label
        if self.roundabout:
            centre = np.hypot(x - self.roundabout.x, y - self.roundabout.y)
            label[centre < self.roundabout.island] = self.roundabout.label
        return label

    def _is_painted(self, places: _Places) -> np.ndarray:
        """Return True on lines along lanes and edges, stop lines, arrows and zebra crossings."""
        style = self.style
        t = places.t
        painted = np.abs(places.road + 0.3) < 0.07
        if not style.median:
            painted |= (np.abs(t) < 0.07) & (places.x % 9 < 4)

        centres = sorted(abs(lane) for lane, _ in style.lanes)
        for inner, outer in pairwise(centres):
            if outer - inner > 1:
                line = (inner + outer) / 2
                painted |= (np.abs(np.abs(t) - line) < 0.08) & (places.x % 18 < 6)
        for lane, _ in style.lanes:
            painted |= (np.abs(t - lane) < 0.09) & (places.x % 60 < 3.5)

        painted &= places.crossing > 1
        painted |= (np.abs(places.crossing - 4.5) < 0.2) & (t < 0) & (np.abs(t) < style.road / 2)
        is_stripe = (t % 1.0 < 0.5) & (np.abs(t) < style.road / 2)
        for start, stop in self.crosswalks:
            painted |= is_stripe & (places.x > start) & (places.x < stop)
        return painted

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Return the tint of the ground, as in `Mesh`; it varies from place to place."""
        pattern = np.sin(0.21 * x + 1.3 * np.sin(0.13 * y))
        tint = self._tints[label] + 0.8 * pattern * np.sin(0.33 * y + 0.05 * x)

        # Repairs of the surface, and manholes.
        is_paved = label != Label.TERRAIN
        along, t = self.street_coordinates(x[is_paved], y[is_paved])
        chance = self._cells[(along // 7).astype(int) % 64, (t // 1.6).astype(int) % 64]
        change = np.where(chance < 0.06, -2.5, 0.0) + np.where(chance > 0.96, 2.0, 0.0)
        is_manhole = np.hypot(along % 7 - 3.5, t % 1.6 - 0.8) < 0.33
        tint[is_paved] += change - np.where(is_manhole & (chance % 0.1 < 0.02), 4.0, 0.0)
        return tint

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

        places = self._locate(x, y)
        z = self._height(x, y, places)
        if not drop:
            self._sharpen(x, y, z, places)
        corners = np.stack([x, y, z - drop], axis=-1).astype(np.float32)
        within = np.abs(places.t[:-1, :-1]) < reach

        a = corners[:-1, :-1][within]
        b = corners[1:, :-1][within]
        c = corners[1:, 1:][within]
        d = corners[:-1, 1:][within]
        return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])

    def _sharpen(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, places: _Places) -> None:
        """Move the corners next to a kerb to its two edges, so that it is steep."""
        edge = np.where(np.abs(places.kerb) < np.abs(places.island), places.kerb, places.island)
        slope_x = np.zeros_like(edge)
        slope_y = np.zeros_like(edge)
        slope_x[1:-1] = (edge[2:] - edge[:-2]) / (2 * FINE_STEP)
        slope_y[:, 1:-1] = (edge[:, 2:] - edge[:, :-2]) / (2 * FINE_STEP)

        # Corners between two edges, where the distance has no clear direction, stay.
        square = slope_x**2 + slope_y**2
        near = (np.abs(edge) < 0.8 * FINE_STEP) & (square > 0.8) & (square < 1.2)
        target = np.where(edge[near] < 0, -KERB_RAMP, KERB_RAMP) - edge[near]
        x[near] += target * slope_x[near] / square[near]
        y[near] += target * slope_y[near] / square[near]
        z[near] = self.height(x[near], y[near])

    def _locate(self, x: np.ndarray, y: np.ndarray) -> _Places:
        """Measure where places lie in the street."""
        style = self.style
        along, t = self.street_coordinates(x, y)
        ends = np.maximum(self.start - along, along - self.end)
        road = np.maximum(np.abs(t) - style.road / 2, ends)

        crossing = np.full(np.shape(x), np.inf)
        branch = np.full(np.shape(x), -1)
        distances = []
        for index, side_road in enumerate(self.crossings):
            distance = side_road.distance(x, y)
            distances.append(distance)
            branch = np.where(distance < crossing, index, branch)
            crossing = np.minimum(crossing, distance)

        # The parking lane ends before a side road, and where islands interrupt it.
        lane = np.where(t < 0, style.parking[0], style.parking[1])
        kerb = road
        if lane.any():
            lane = lane * np.clip((crossing - PARKING_END) / PARKING_TAPER, 0, 1)
            kerb = np.maximum(np.abs(t) - style.road / 2, ends) - np.where(
                _bay(along, style.parking_period), lane, 0
            )

        branch[np.minimum(road, kerb) < crossing] = -1
        for side_road, distance in zip(self.crossings, distances, strict=True):
            kerb = rounded_union(kerb, distance, side_road.corner)
            road = rounded_union(road, distance, side_road.corner)

        island = np.full(np.shape(x), np.inf)
        for item in self.islands:
            island = np.minimum(island, item.distance(along, t))
        if self.roundabout:
            centre = np.hypot(x - self.roundabout.x, y - self.roundabout.y)
            crossing = np.minimum(crossing, centre - self.roundabout.radius)
            kerb = rounded_union(kerb, centre - self.roundabout.radius, 6.0)
            road = rounded_union(road, centre - self.roundabout.radius, 6.0)
            island = np.minimum(island, centre - self.roundabout.island)
        return _Places(along, t, road, crossing, branch, kerb, island)


def _draw_bends(style: Style, rng: np.random.Generator) -> np.ndarray:
    """Draw (2, 3) amplitude, wavelength and phase of the two waves of the middle line."""
    steepness = 0.0 if rng.random() < 0.25 else rng.uniform(0.05, 0.35)
    wavelengths = rng.uniform(180, 500, size=2)
    if style.kind in ("residential", "living", "rural") and rng.random() < 0.4:
        wavelengths[1] = rng.uniform(80, 180)
    # No bend is tighter than a radius of about 35 m, or 300 m where traffic is fast.
    tightest = 1 / 300 if style.speed > 1.7 else 1 / 35

    amplitudes = steepness * rng.uniform(0.4, 1.0, size=2) * wavelengths / (2 * np.pi)
    amplitudes = np.minimum(amplitudes, 0.5 * tightest * (wavelengths / (2 * np.pi)) ** 2)
    phases = rng.uniform(0, 2 * np.pi, size=2)
    return np.column_stack([amplitudes, wavelengths, phases])


def _draw_side_strips(rng: np.random.Generator, style: Style) -> tuple[Strip, ...]:
    """Draw what lies along a side road: mostly the same as along the street."""
    if rng.random() < 0.6:
        strips = style.strips[int(rng.integers(2))]
        if all(strip.label != Label.ROAD for strip in strips):
            return strips

    choice = rng.random()
    if choice < 0.65:
        return (Strip(float(rng.uniform(1.0, 3.0)), Label.SIDEWALK),)
    if choice < 0.8:
        return (Strip(float(rng.uniform(0.4, 1.5)), Label.OTHER_GROUND, raised=False),)

    return ()


def _bay(along: np.ndarray, period: float) -> np.ndarray:
    """Return whether parking lanes are not interrupted at places along the street."""
    if not np.isfinite(period):
        return np.ones(np.shape(along), dtype=bool)

    return along % period > BAY_GAP


def _ramp(distance: np.ndarray) -> np.ndarray:
    """Return 0 before a kerb, 1 behind it, and a steep line over the kerb itself."""
    return np.clip((distance + KERB_RAMP) / (2 * KERB_RAMP), 0, 1)
