"""Draw the plans of streets: where they end, their junctions, islands, humps and crosswalks."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarstreets.chance import weighted_choice
from lidarstreets.materials import Label
from lidarstreets.streets.middle_line import MiddleLine
from lidarstreets.streets.plans import Island, Plan, Roundabout, SideRoad
from lidarstreets.streets.styles import Strip, Style

OVERHANG = 50.0  # reach of the islands in the middle beyond the simulated land, metres
TIGHTEST_SIDE_ROAD = 45.0  # smallest radius of the bend of a side road, metres
WIDE_SIDE_ROAD_SHARE = 0.25  # share of the side roads that are as wide as a main road


@dataclass(frozen=True)
class Planner:
    """Draws the plan of one street, part by part.

    Attributes:
        style: the numbers of the street.
        line: the middle line of the street.
        length: length of the land along x, metres.
        course: x where the sensor starts and ends, metres.
        rng: draws everything in the plan.
    """

    style: Style
    line: MiddleLine
    length: float
    course: tuple[float, float]
    rng: np.random.Generator

    def draw(self) -> Plan:
        """Draw the plan of the street."""
        start, end = self._draw_ends()
        roundabout = self._draw_roundabout(start, end)
        crossings = self._draw_crossings(start, end, roundabout)
        islands = self._draw_islands(start, end, crossings)
        if roundabout is not None:
            islands = [island for island in islands if not _meets(island, roundabout)]

        return Plan(
            style=self.style,
            start=start,
            end=end,
            roundabout=roundabout,
            crossings=tuple(crossings),
            islands=tuple(islands),
            humps=self._draw_humps(),
            crosswalks=tuple(self._draw_crosswalks(crossings)),
        )

    def _draw_ends(self) -> tuple[float, float]:
        """Draw x where the street begins and ends; most streets begin and end out of sight."""
        rng = self.rng
        start = -np.inf
        end = np.inf
        if self.style.kind in ("residential", "living", "rural") and rng.random() < 0.25:
            end = self.course[1] + rng.uniform(12, 60)
        if self.style.kind in ("residential", "living") and rng.random() < 0.12:
            start = self.course[0] - rng.uniform(12, 60)
        return start, end

    def _draw_roundabout(self, start: float, end: float) -> Roundabout | None:
        rng = self.rng
        if self.style.kind in ("motorway", "living") or rng.random() > 0.12:
            return None

        island = rng.uniform(2.0, 14.0)
        radius = island + rng.uniform(5, 9)
        distance = radius + rng.uniform(8, 35)
        x = self.course[1] + distance if rng.random() < 0.6 else self.course[0] - distance
        if not start + radius < x < end - radius:
            return None

        chances = {Label.TERRAIN: 0.6, Label.OTHER_GROUND: 0.3, Label.SIDEWALK: 0.1}
        label = weighted_choice(rng, chances)
        y = float(self.line.middle(x))
        return Roundabout(x=x, y=y, street_x=x, radius=radius, island=island, label=label)

    def _draw_crossings(
        self, start: float, end: float, roundabout: Roundabout | None
    ) -> list[SideRoad]:
        if self.style.kind == "motorway":
            return self._draw_ramps()

        rng = self.rng
        crossings = []
        x = rng.uniform(10, 140 / self.style.junctions)

        while x < self.length - 20:
            sides = ((-1, 1), (-1,), (1,))[rng.choice(3, p=[0.35, 0.35, 0.3])]
            if start + 8 < x < end - 8:
                for side in sides:
                    crossings.append(self._draw_side_road(x, side))
            x += (12 + rng.exponential(80)) / self.style.junctions

        if roundabout:
            for side in (-1, 1):
                if rng.random() < 0.8:
                    crossings.append(self._draw_side_road(roundabout.x, side))
        # A street that ends may end at a road that crosses it.
        if np.isfinite(end) and rng.random() < 0.6:
            for side in (-1, 1):
                crossings.append(self._draw_side_road(end - 3.0, side))
        return crossings

    def _draw_side_road(self, x: float, side: int) -> SideRoad:
        rng = self.rng
        turn = rng.normal(scale=0.15) if rng.random() < 0.5 else rng.uniform(-1.0, 1.0)
        is_drive = rng.random() < 0.2
        width = rng.uniform(2.6, 4.0) if is_drive else rng.uniform(4.5, 9.0)
        corner = rng.uniform(1, 3) if is_drive else rng.uniform(2, 12)
        is_wide = not is_drive and rng.random() < WIDE_SIDE_ROAD_SHARE
        if is_wide:
            width = rng.uniform(9.0, 18.0)
            corner = rng.uniform(6, 18)
        is_short = is_drive or (not is_wide and rng.random() < 0.3)
        length = self.style.road / 2 + rng.uniform(15, 60) if is_short else np.inf
        has_bend = rng.random() < 0.5

        return SideRoad(
            x=x,
            y=float(self.line.middle(x)),
            street_x=x,
            yaw=float(self.line.yaw(x) + side * np.pi / 2 + turn),
            side=side,
            width=float(width),
            bend=float(rng.uniform(-1, 1) / TIGHTEST_SIDE_ROAD) if has_bend else 0.0,
            length=float(length),
            turning=float(rng.uniform(5, 9)) if is_short and rng.random() < 0.3 else 0.0,
            corner=float(corner),
            strips=self._draw_side_strips(),
        )

    def _draw_side_strips(self) -> tuple[Strip, ...]:
        """Draw the strips along a side road; most side roads have the strips of the street."""
        rng = self.rng
        if rng.random() < 0.6:
            strips = self.style.strips[int(rng.integers(2))]
            if all(strip.label != Label.ROAD for strip in strips):
                return strips

        choice = rng.random()
        if choice < 0.65:
            return (Strip(float(rng.uniform(1.0, 3.0)), Label.SIDEWALK),)
        if choice < 0.8:
            return (Strip(float(rng.uniform(0.4, 1.5)), Label.OTHER_GROUND, raised=False),)

        return ()

    def _draw_ramps(self) -> list[SideRoad]:
        """Draw the ramps of a motorway, which leave it at small angles."""
        rng = self.rng
        ramps = []
        for side in (-1, 1):
            if rng.random() < 0.5:
                x = rng.uniform(20, self.length - 40)
                away = 0.0 if rng.random() < 0.5 else np.pi
                opening = side * rng.uniform(0.08, 0.25) * (1 if away == 0 else -1)
                px, py, yaw = self.line.pose_at(x, side * (self.style.road / 2 - 2.5))
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

    def _draw_islands(self, start: float, end: float, crossings: list[SideRoad]) -> list[Island]:
        """Draw the islands in the middle of the road, with gaps at the junctions."""
        rng = self.rng
        style = self.style
        if not style.median:
            return []

        half = style.median / 2 - rng.uniform(0.1, 0.4)
        gaps = [-OVERHANG]
        if style.kind != "motorway":
            for crossing in sorted(crossings, key=lambda road: road.street_x):
                if rng.random() < 0.75:
                    gaps.append(crossing.street_x)
        gaps.append(self.length + OVERHANG)

        islands = []
        for left, right in pairwise(gaps):
            opening = rng.uniform(7, 12)
            island_start = max(left + opening, start + 10)
            island_end = min(right - opening, end - 10)
            if not style.has_long_median:
                island_start = max(island_start, rng.uniform(0, self.length))
                island_end = min(island_end, island_start + rng.uniform(5, 15))
            if island_end - island_start > 2 * half:
                x = (island_start, island_end)
                islands.append(Island(x, (-half, half), style.median_label))
        return islands

    def _draw_humps(self) -> np.ndarray:
        """Draw the H humps of the road: (H, 2) x along the street and height, metres."""
        rng = self.rng
        if self.style.kind not in ("living", "residential") or rng.random() > 0.25:
            return np.zeros((0, 2))

        x = np.arange(rng.uniform(0, 40), self.length, rng.uniform(25, 60))
        return np.column_stack([x, np.full(len(x), rng.uniform(0.04, 0.12))])

    def _draw_crosswalks(self, crossings: list[SideRoad]) -> list[tuple[float, float]]:
        """Draw the zebra crossings next to side roads: x from and to along the street, metres."""
        rng = self.rng
        if self.style.kind in ("motorway", "fast") or not self.style.painted:
            return []

        crosswalks = []
        for crossing in crossings:
            if rng.random() < 0.4:
                start = crossing.street_x + crossing.width / 2 + rng.uniform(2, 5)
                crosswalks.append((start, start + rng.uniform(2.5, 4.5)))
        return crosswalks


def _meets(island: Island, roundabout: Roundabout) -> bool:
    """Return whether an island reaches into a roundabout."""
    reach = roundabout.radius
    return island.x[0] < roundabout.x + reach and island.x[1] > roundabout.x - reach
