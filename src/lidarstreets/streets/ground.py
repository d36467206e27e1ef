"""Compute the height, the class and the brightness of the ground of a street at any place."""

import numpy as np
from numpy.typing import NDArray

from lidarstreets.materials import Label, Surface
from lidarstreets.mesh import Mesh, part
from lidarstreets.solids import quads
from lidarstreets.streets.appearance import GroundBrightness, is_painted
from lidarstreets.streets.middle_line import MiddleLine, draw_bends
from lidarstreets.streets.places import Places, is_bay, locate
from lidarstreets.streets.planning import Planner
from lidarstreets.streets.plans import Patch, strip_at
from lidarstreets.streets.relief import Relief
from lidarstreets.streets.styles import Strip, Style, width_of

# Spacing of the fine and the coarse grid of the ground, and their reach from the middle line of the
# street, metres.
FINE_STEP = 0.62
FINE_REACH = 32.0
COARSE_STEP = 4.0
COARSE_REACH = 110.0
COARSE_DROP = 0.3  # depth of the coarse grid below the fine grid, which covers it, metres
OVERHANG = 10.0  # reach of the grids beyond the ends of the land, metres
KERB_RAMP = 0.03  # half the width over which the ground rises at a kerb, metres
CROWN_SLOPE = 0.02  # slope from the edge of a road to its crown, rise over run
ISLAND_HEIGHT = 0.14  # height of an island over the road, metres
HUMP_REACH = 1.8  # half the length of a hump along the street, metres
DRIVE_KERB = 0.2  # height of the kerb at a drive as a share of its height elsewhere
DRIVE_RAMP = 0.8  # length along the street over which the kerb sinks to a drive, metres
SWERVE = 8.0  # distance before the ring of a roundabout at which vehicles leave their lane, metres
# Largest share of taken places in a parking lane that the benchmarks count as road.
RARELY_PARKED_SHARE = 0.3


class Ground(MiddleLine):
    """The ground of one street: its plan, and its height, class and brightness at any place.

    Lengths are in metres. Unless a method says otherwise, it takes and returns arrays of one shape.

    Args:
        length: length of the land along x.
        rng: draws the plan, the relief and the brightness.
        course: x where the sensor starts and ends; by default it drives along the whole street.
    """

    def __init__(
        self,
        style: Style,
        length: float,
        rng: np.random.Generator,
        course: tuple[float, float] | None = None,
    ) -> None:
        super().__init__(draw_bends(style, rng))
        self.style = style
        self.length = length
        self.patches: list[Patch] = []
        # Stretches of the street that no plot may use: side, and x from and to.
        self.reserved: list[tuple[int, float, float]] = []

        self._relief = Relief(style, rng)
        self.plan = Planner(style, self, length, course or (0.0, length), rng).draw()
        # The kerb is lowered at drives: distance from drive to drive along the street, and width.
        self._drive_period = rng.uniform(9, 30)
        self._drive_width = rng.uniform(1.5, 4.0)
        self._brightness = GroundBrightness(rng)

    def lane_pose(self, x: float, t: float) -> tuple[float, float, float]:
        """Return (x, y, yaw) of a vehicle at x in the lane at t, which goes round a roundabout.

        Takes and returns single numbers in metres and radians.
        """
        step = 0.5
        swerve = self._swerve(x, t)
        px, py, yaw = self.pose_at(x, swerve)
        return px, py, yaw + float(np.arctan((self._swerve(x + step, t) - swerve) / step))

    def _swerve(self, x: float, t: float) -> float:
        """Return t at x of the lane whose t is `t` away from roundabouts."""
        if self.plan.roundabout is None:
            return t

        roundabout = self.plan.roundabout
        share = min(abs(x - roundabout.street_x) / (roundabout.radius + SWERVE), 1.0)
        weight = np.cos(0.5 * np.pi * share) ** 1.5
        side = 1 if t >= 0 else -1
        return float(t + weight * (side * roundabout.ring - t))

    def distance_from_crossings(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the distance of places x, y from the nearest side road or roundabout.

        It is negative on the road.
        """
        nearest = np.full(np.shape(x), np.inf)
        for crossing in self.plan.crossings:
            nearest = np.minimum(nearest, crossing.distance(x, y))
        if self.plan.roundabout:
            nearest = np.minimum(nearest, self.plan.roundabout.distance(x, y))
        return nearest

    def is_street(self, x: float, margin: float = 0.0) -> bool:
        """Return whether x is on the street, more than `margin` metres from its ends."""
        return self.plan.start + margin < x < self.plan.end - margin

    def front(self, side: int) -> float:
        """Return |t| where the plots of one side begin; side -1 is right, 1 is left."""
        return self.kerb_t(side) + width_of(self.style.strips[int(side > 0)])

    def kerb_t(self, side: int) -> float:
        """Return |t| of the kerb of one side away from side roads; side -1 is right, 1 is left."""
        return self.style.road / 2 + self.style.parking[int(side > 0)]

    def is_bay(self, x: float) -> bool:
        """Return whether no island interrupts the parking lanes at x."""
        return bool(is_bay(np.array([x]), self.style.parking_period)[0])

    def height(self, x: np.ndarray | float, y: np.ndarray | float) -> np.ndarray:
        """Return the height of the ground at the places x, y."""
        x = np.asarray(x, dtype=float)
        y = np.asarray(y, dtype=float)
        return self._height(x, y, locate(self, self.plan, x, y))

    def _height(
        self, x: NDArray[np.float64], y: NDArray[np.float64], places: Places
    ) -> NDArray[np.float64]:
        """Return the height of the ground at x, y; `places` says where these lie in the street."""
        style = self.style
        z = self._relief.hills(x, y)

        # The crown of the road, its humps, and the islands on it.
        z = z - CROWN_SLOPE * np.minimum(np.abs(places.t), style.road / 2)
        for hump_x, hump_height in self.plan.humps:
            bump = np.clip(1 - ((places.x - hump_x) / HUMP_REACH) ** 2, 0, 1)
            z = z + np.where(places.road < 0, hump_height * bump, 0)
        z = z + ISLAND_HEIGHT * _ramp(-places.island)

        # The kerb is lower at drives.
        from_drive = (places.x + 0.3 * self._drive_period) % self._drive_period
        beyond_drive = np.clip((from_drive - self._drive_width) / DRIVE_RAMP, 0, 1)
        kerb = style.kerb * (DRIVE_KERB + (1 - DRIVE_KERB) * beyond_drive)

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

        # The land begins as far from the kerb along side roads as along the street.
        right = width_of(style.strips[0])
        left = width_of(style.strips[1])
        pavement = right + (left - right) * np.clip(0.5 + places.t / 4, 0, 1)
        height: NDArray[np.float64] = z + self._relief.beyond(
            places.kerb - pavement, places.t, places.x, x, y
        )
        return height

    def _profiles(self, places: Places) -> list[tuple[tuple[Strip, ...], np.ndarray]]:
        """Return the strips along each road, and which places are nearest to this road."""
        is_street = places.branch < 0
        profiles = [
            (self.style.strips[0], is_street & (places.t < 0)),
            (self.style.strips[1], is_street & (places.t >= 0)),
        ]
        for index, crossing in enumerate(self.plan.crossings):
            profiles.append((crossing.strips, places.branch == index))
        return profiles

    def label(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the class ids of the ground at the (N,) places x, y: (N,) uint16."""
        places = locate(self, self.plan, x, y)

        # Classify from the plots to the road: each step may overwrite earlier steps.
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

        # Where few cars park, the benchmarks label the lane at the kerb as road.
        right, left = self.style.is_bus_bay
        is_used = ~np.where(places.t < 0, right, left) & (self.style.parked > RARELY_PARKED_SHARE)
        at_kerb = (places.kerb < 0) & (places.road >= 0)
        label[at_kerb] = np.where(is_used[at_kerb], Label.PARKING, Label.ROAD)
        on_road = places.road < 0
        label[on_road] = Label.ROAD
        if self.style.painted:
            label[on_road & is_painted(self.plan, places)] = Label.LANE_MARKING

        for island in self.plan.islands:
            label[island.distance(places.x, places.t) < 0] = island.label
        if self.plan.roundabout:
            on_island = self.plan.roundabout.island_distance(x, y) < 0
            label[on_island] = self.plan.roundabout.label
        return label

    def tint(self, x: np.ndarray, y: np.ndarray, label: np.ndarray) -> np.ndarray:
        """Return the tints of the ground at the (N,) places x, y, as in `Mesh`: (N,)."""
        tint = self._brightness.terrain_tint(x, y, label)
        is_paved = (label != Label.TERRAIN) & (label != Label.VEGETATION)
        along, t = self.street_coordinates(x[is_paved], y[is_paved])
        tint[is_paved] += self._brightness.repairs(along, t)
        return tint

    def mesh(self) -> Mesh:
        """Return the ground as triangles of class 0: a fine grid over a coarse grid."""
        fine = self._grid(FINE_STEP, FINE_REACH, 0.0)
        coarse = self._grid(COARSE_STEP, COARSE_REACH, COARSE_DROP)
        return part([fine, coarse], Surface.GRASS, 0)

    def _grid(self, step: float, reach: float, drop: float) -> np.ndarray:
        """Return the (T, 3, 3) triangles of a square grid, `drop` metres below the ground.

        It has the spacing `step` and reaches `reach` metres from the middle line.
        """
        xs = np.arange(-OVERHANG, self.length + OVERHANG, step)
        lowest_y = self.middle(xs).min() - reach
        highest_y = self.middle(xs).max() + reach
        x, y = np.meshgrid(xs, np.arange(lowest_y, highest_y, step), indexing="ij")

        places = locate(self, self.plan, x, y)
        z = self._height(x, y, places)
        if not drop:
            self._sharpen(x, y, z, places)
        corners = np.stack([x, y, z - drop], axis=-1).astype(np.float32)
        within = np.abs(places.t[:-1, :-1]) < reach

        a = corners[:-1, :-1][within]
        b = corners[1:, :-1][within]
        c = corners[1:, 1:][within]
        d = corners[:-1, 1:][within]
        return quads(a, b, c, d)

    def _sharpen(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, places: Places) -> None:
        """Move the corners next to a kerb to the two edges of the kerb, so that it is steep."""
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


def _ramp(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return 0 on the road, 1 behind the kerb, and a steep ramp over the kerb itself."""
    return np.clip((distance + KERB_RAMP) / (2 * KERB_RAMP), 0, 1)
