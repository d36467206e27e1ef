"""Makes the scans of any sensor such as the weights know them: intensity, height over the ground, rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from amvnet.config.schema import RangeViewConfig
from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.progress import Say, say_nothing
from amvnet.scan import Scan
from amvnet.sensors.lidars import HEIGHTS, SENSORS, Sensor
from amvnet.sensors.measure import Measured, elevations, measure

MEASURED = 5  # scans of a source that are measured; then their median stays
STEADY = (
    0.4  # metres: where heights of a source differ by more, each of its scans counts for itself
)
SAME_HEIGHT = 0.15  # metres that do not matter: training moves the sensor by as much
LOWEST = 0.3  # metres: a lower origin is a place on the ground, not the sensor
OUTSIDE = 0.16  # share of the points out of the weights' field of view from which on it is widened to the scan's
SAME_ANGLE = 6.0  # degrees: fields of view that differ by less at both ends are alike
SAME_BEAMS = 1.4  # factor: numbers of lasers that differ by less are alike
KEYS = ("beams", "fov_up", "fov_down", "height")  # what can be measured, or given


@dataclass
class _Source:
    """Scans that are of one sensor: what was measured of the first ones, and whether they agree."""

    found: list[Measured] = field(default_factory=list)
    steady: bool = True
    learnt: bool = False
    said: bool = False


class ScanAdapter:
    """Turns what scan files hold into scans for some weights.

    Intensities are brought to [0, 1], the axes turned level, and the scan is moved up or down so that its sensor is
    as high over the ground as the one the weights were trained for. `ring` becomes the row of the range image that a
    point's laser has, 0 the lowest, for `Segmenter.by_ring`: by the elevation as the sensor saw it, before the move.

    Args:
        weights: what the scans are for.
        given: what is known of the sensor; the rest is measured.
        say: told what was assumed, once for each source of scans.
    """

    def __init__(
        self,
        view: RangeViewConfig,
        trained_for: str = "",
        given: Sensor | None = None,
        say: Say = say_nothing,
    ) -> None:
        self.given = given or Sensor()
        self._say = say
        self.trained = SENSORS.get(trained_for)
        self.height = HEIGHTS.get(trained_for)
        self._view = view
        self._sources: dict[tuple[str, float | None], _Source] = {}

    def __call__(self, cloud: Cloud, source: str) -> Scan:
        """The scan for the weights; its points keep their order and number.

        Args:
            source: name of what the scan is one of, such as a bag or a folder: scans of one source with the same
                kind of intensity are taken for one sensor's.

        Raises:
            InputError: where no point is usable.
        """
        scale = self.given.intensity_scale or cloud.intensity_scale()
        scan = _level(cloud, self.given).to_scan(scale)
        valid = scan.valid
        known = self._sources.setdefault((source, scale), _Source())
        found = self._settled(known, scan, valid)
        sensor = _known(self.given, found)
        moved = _raised(scan, self._rise(sensor))
        seen = (
            moved if sensor.height is not None and sensor.height < LOWEST else scan
        )  # from where the sensor is
        wide = self._widened(seen.points[valid], sensor)
        if not known.said:
            known.said = True
            self._say(self._words(cloud, scale, sensor))
        return dataclasses.replace(moved, ring=self._rows(seen, valid, wide))

    def learn(self, source: str, first: Sequence[Callable[[], Cloud]]) -> None:
        """Measure the first scans of a source: all of it then have their median, or, where they differ, each its own.

        Args:
            first: how they are read; those that are broken are left out.
        """
        for read in first:
            with suppress(InputError):
                cloud = read()
                scale = self.given.intensity_scale or cloud.intensity_scale()
                scan = _level(cloud, self.given).to_scan(scale)
                self._settled(
                    self._sources.setdefault((source, scale), _Source()), scan, scan.valid
                )
        for (name, _), known in self._sources.items():
            known.learnt |= name == source

    def _settled(self, known: _Source, scan: Scan, valid: np.ndarray) -> Measured:
        """What counts as measured for a scan: the median of the first ones of its source, where these agree."""
        if known.steady and (known.learnt or len(known.found) == MEASURED):
            return _median(known.found)
        ring = None if scan.ring is None else scan.ring[valid]
        found = measure(scan.points[valid], ring)
        if known.learnt:
            return found
        known.found = [*known.found, found][-MEASURED:]
        heights = [m.height for m in known.found if m.height is not None]
        known.steady &= not heights or max(heights) - min(heights) < STEADY
        return _median(known.found) if known.steady else found

    def _rise(self, sensor: Measured) -> float:
        """Metres to move a scan up."""
        if (
            self.height is None
            or sensor.height is None
            or abs(sensor.height - self.height) < SAME_HEIGHT
        ):
            return 0.0
        return sensor.height - self.height

    def _widened(self, points: np.ndarray, sensor: Measured) -> RangeViewConfig | None:
        """The range view with rows by elevation: as trained, or wider where the scan is; None where that is unknown."""
        view = self._view
        if view.rows == "ring":
            known = self.trained or (sensor if sensor.beams == view.height else None)
            if (
                known is None
                or known.fov_up is None
                or known.fov_down is None
                or known.fov_up <= known.fov_down
            ):
                return None
            view = _by_elevation(view, known.fov_up, known.fov_down, view.height - 1)
        elevation = elevations(points[:, :3].astype(np.float64))
        outside = ((elevation > view.fov_up) | (elevation < view.fov_down)).mean()
        if (
            outside < OUTSIDE
            or sensor.fov_up is None
            or sensor.fov_down is None
            or sensor.fov_up <= sensor.fov_down
        ):
            return view
        return _by_elevation(view, sensor.fov_up, sensor.fov_down, view.height)

    def _rows(
        self, scan: Scan, valid: np.ndarray, view: RangeViewConfig | None
    ) -> np.ndarray | None:
        """(N,) row of the range image of each point, 0 the lowest; 0 for lost points."""
        own = scan.ring if self._view.rows == "ring" else None
        if view is None or (own is not None and self.trained is None):
            return own
        rows = view.height - 1 - RangeView(view).rows(PointBatch.of([scan])).numpy()
        if own is not None and _agree(own[valid], rows):
            return own
        out = np.zeros(len(scan), dtype=np.int64)
        out[valid] = rows
        return out

    def _words(self, cloud: Cloud, scale: float | None, sensor: Measured) -> str:
        """What was assumed, and what it means for the weights."""
        taken = [_intensity_words(cloud, scale), self._height_words(sensor), _lasers_words(sensor)]
        line = f"{cloud.name}: assumed {', '.join(filter(None, [cloud.note, *taken]))}"
        if not self._unseen(sensor) or self.trained is None:
            return line
        known = _lasers_words(self.trained)
        return f"{line}; the weights were trained for {self.trained.name} ({known}) and have seen no such sensor"

    def _height_words(self, sensor: Measured) -> str:
        if sensor.height is None:
            return "no ground to measure the height by (give --height)"
        rise = self._rise(sensor)
        moved = f" (moved by {rise:+.2f} m to {self.height:.2f} m)" if rise else ""
        return f"sensor {sensor.height:.2f} m over the ground{moved}"

    def _unseen(self, sensor: Measured) -> bool:
        known = self.trained
        if known is None or self.given.name == known.name:
            return False
        ratio = 1.0 if not (sensor.beams and known.beams) else sensor.beams / known.beams
        ends = ((sensor.fov_up, known.fov_up), (sensor.fov_down, known.fov_down))
        apart = any(a is not None and b is not None and abs(a - b) > SAME_ANGLE for a, b in ends)
        return apart or not 1 / SAME_BEAMS < ratio < SAME_BEAMS


def _level(cloud: Cloud, given: Sensor) -> Cloud:
    """The cloud in the package's axes; lost points, which are at the file's origin, stay lost."""
    if given.level:
        return cloud
    xyz = given.to_level(cloud.xyz)
    xyz[(cloud.xyz == 0).all(axis=1)] = np.nan
    return dataclasses.replace(cloud, xyz=xyz)


def _by_elevation(view: RangeViewConfig, top: float, bottom: float, steps: int) -> RangeViewConfig:
    """The view with rows by elevation, the lasers `top` and `bottom` half a step of `steps` within its ends."""
    half = (top - bottom) / (2 * steps)
    return dataclasses.replace(view, rows="elevation", fov_up=top + half, fov_down=bottom - half)


def _raised(scan: Scan, rise: float) -> Scan:
    return (
        dataclasses.replace(scan, points=scan.points + np.array([0, 0, rise, 0], np.float32))
        if rise
        else scan
    )


def _median(found: list[Measured]) -> Measured:
    """The median of each thing that was measured."""
    values: dict[str, float | None] = {}
    for key in KEYS:
        known = [getattr(m, key) for m in found if getattr(m, key) is not None]
        values[key] = float(np.median(known)) if known else None
    beams = values.pop("beams")
    return Measured(None if beams is None else round(beams), **values)


def _known(given: Sensor, found: Measured) -> Measured:
    """What is given, and where it is not, what was measured."""
    stated = {key: getattr(given, key) for key in KEYS}
    return dataclasses.replace(
        found, **{key: value for key, value in stated.items() if value is not None}
    )


def _agree(ring: np.ndarray, rows: np.ndarray) -> bool:
    """Whether indices of lasers are those that the weights know: most points have the row of their elevation."""
    return bool(np.median(np.abs(ring - rows)) < 1)


def _intensity_words(cloud: Cloud, scale: float | None) -> str:
    return (
        "no intensity" if cloud.intensity is None or scale is None else f"intensity 0 to {scale:g}"
    )


def _lasers_words(sensor: Sensor | Measured) -> str:
    lasers = "lasers" if sensor.beams is None else f"{sensor.beams} lasers"
    if sensor.fov_up is None or sensor.fov_down is None:
        return lasers if sensor.beams else "field of view not found"
    return f"{lasers} from {sensor.fov_up:+.0f} to {sensor.fov_down:+.0f} degrees"
