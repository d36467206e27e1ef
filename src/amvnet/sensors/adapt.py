"""Adapt the scans of any sensor to some weights: intensity, height over the ground, rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amvnet.config.schema import RangeViewConfig
from amvnet.data.formats.cloud import Cloud
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.progress import Say, say_nothing
from amvnet.scan import Scan
from amvnet.sensors.lidars import HEIGHTS, SENSORS, Sensor
from amvnet.sensors.measure import SensorGeometry, elevations, measure

MEASURED = 5  # scans of a recording that are measured; later ones get the median of these
STEADY = 0.4  # metres: if heights in a recording differ by more, each scan gets its own height
SAME_HEIGHT = 0.15  # metres: training moves the sensor up and down by as much
LOWEST = 0.3  # metres: if the origin is lower, it lies on the ground and not at the sensor
OUTSIDE = 0.16  # share of points outside a field of view from which on it is too narrow
SAME_ANGLE = 6.0  # degrees: fields of view are alike if both ends differ by less
SAME_BEAMS = 1.4  # factor: numbers of lasers are alike if they differ by less
KEYS = ("beams", "fov_up", "fov_down", "height")  # attributes of a SensorGeometry


@dataclass
class _Recording:
    """Scans that are assumed to come from one sensor, and what was measured of it.

    Attributes:
        measurements: of the first scans, at most `MEASURED`.
        is_steady: whether the measured heights agree.
        is_learnt: whether `measurements` is complete; later scans add nothing to it.
        is_reported: whether the user was told what was assumed.
    """

    measurements: list[SensorGeometry] = field(default_factory=list)
    is_steady: bool = True
    is_learnt: bool = False
    is_reported: bool = False

    def measure(self, scan: Scan, valid: np.ndarray) -> SensorGeometry:
        """Return the median of the first scans if their heights agree, else measure this scan.

        Args:
            valid: (N,) bool, `scan.valid`.
        """
        is_complete = self.is_learnt or len(self.measurements) == MEASURED
        if self.is_steady and is_complete:
            return _median(self.measurements)

        ring = None if scan.ring is None else scan.ring[valid]
        geometry = measure(scan.points[valid], ring)
        if self.is_learnt:
            return geometry

        self.measurements = [*self.measurements, geometry][-MEASURED:]
        heights = _known_values(self.measurements, "height")
        if heights:
            self.is_steady &= max(heights) - min(heights) < STEADY
        return _median(self.measurements) if self.is_steady else geometry


class ScanAdapter:
    """Turns the contents of scan files into scans as some weights expect them.

    Intensities are scaled to [0, 1], the axes are turned level, and the scan is moved up or down
    until its sensor is as high over the ground as the one that the weights were trained for.
    `ring` becomes the row of each point in the range image, 0 the lowest, for `Segmenter.by_ring`.
    The row follows the elevation at which the sensor saw the point, before the move.

    Args:
        view: the range view of the weights.
        trained_for: name of the sensor that the weights were trained for.
        sensor: what is known of the sensor of the scans; the rest is measured.
        say: is told once for each recording what was assumed.
    """

    def __init__(
        self,
        view: RangeViewConfig,
        trained_for: str = "",
        sensor: Sensor | None = None,
        say: Say = say_nothing,
    ) -> None:
        self.sensor = sensor or Sensor()
        self._view = view
        self._trained_sensor = SENSORS.get(trained_for)
        self._trained_height = HEIGHTS.get(trained_for)
        self._say = say
        self._recordings: dict[tuple[str, float | None], _Recording] = {}

    def __call__(self, cloud: Cloud, source: str) -> Scan:
        """Return the scan as the weights expect it; its points keep their order and number.

        Args:
            source: name of the bag or folder that the scan is from. Scans with the same source and
                the same scale of intensity are assumed to come from one sensor.

        Raises:
            InputError: if no point is usable.
        """
        scale = self._intensity_scale(cloud)
        scan = _level(cloud, self.sensor).to_scan(scale)
        valid = scan.valid

        recording = self._recording(source, scale)
        geometry = _override(recording.measure(scan, valid), self.sensor)
        moved = _raise_points(scan, self._rise(geometry))

        # Elevations are those that the sensor saw. If the origin is on the ground, they are right
        # only after the move.
        is_on_ground = geometry.height is not None and geometry.height < LOWEST
        seen = moved if is_on_ground else scan
        view = self._row_view(seen.points[valid], geometry)

        if not recording.is_reported:
            recording.is_reported = True
            self._say(self._report(cloud, scale, geometry))
        return dataclasses.replace(moved, ring=self._rows(seen, valid, view))

    def learn(self, source: str, first: Sequence[Callable[[], Cloud]]) -> None:
        """Measure the first scans of a source; later scans add no measurements.

        Args:
            first: functions that read these scans; broken scans are left out.
        """
        for read in first:
            with suppress(InputError):
                cloud = read()
                scale = self._intensity_scale(cloud)
                scan = _level(cloud, self.sensor).to_scan(scale)
                self._recording(source, scale).measure(scan, scan.valid)

        for (name, _), recording in self._recordings.items():
            if name == source:
                recording.is_learnt = True

    def _intensity_scale(self, cloud: Cloud) -> float | None:
        return self.sensor.intensity_scale or cloud.intensity_scale()

    def _recording(self, source: str, scale: float | None) -> _Recording:
        return self._recordings.setdefault((source, scale), _Recording())

    def _rise(self, geometry: SensorGeometry) -> float:
        """Return how far to move a scan up, metres."""
        if geometry.height is None or self._trained_height is None:
            return 0.0

        rise = geometry.height - self._trained_height
        return 0.0 if abs(rise) < SAME_HEIGHT else rise

    def _row_view(self, points: np.ndarray, geometry: SensorGeometry) -> RangeViewConfig | None:
        """Return the range view that gives (P, 4) points their rows by elevation.

        It is that of the weights, but with the sensor's field of view if too many points are
        outside. None if the rows are lasers and their elevations are unknown.
        """
        view = self._trained_view(geometry)
        if view is None:
            return None

        elevation = elevations(points[:, :3].astype(np.float64))
        is_outside = (elevation > view.fov_up) | (elevation < view.fov_down)
        ends = _field_of_view(geometry)
        if is_outside.mean() < OUTSIDE or ends is None:
            return view
        return _by_elevation(view, ends, view.height)

    def _trained_view(self, geometry: SensorGeometry) -> RangeViewConfig | None:
        """Return the range view of the weights with rows by elevation.

        If the rows are lasers, the highest one gets the first row and the lowest one the last.
        None if their elevations are unknown.
        """
        view = self._view
        if view.rows != "ring":
            return view

        lasers: Sensor | SensorGeometry | None = self._trained_sensor
        if lasers is None and geometry.beams == view.height:
            lasers = geometry
        ends = None if lasers is None else _field_of_view(lasers)
        return None if ends is None else _by_elevation(view, ends, view.height - 1)

    def _rows(
        self, scan: Scan, valid: np.ndarray, view: RangeViewConfig | None
    ) -> np.ndarray | None:
        """Return each point's (N,) row in the range image, 0 the lowest; 0 for lost points.

        None if the weights need rings, and neither the scan nor its elevations tell them.
        """
        ring = scan.ring if self._view.rows == "ring" else None
        is_trusted = ring is not None and self._trained_sensor is None
        if view is None or is_trusted:
            return ring

        batch = PointBatch.of([scan])
        rows = view.height - 1 - RangeView(view).rows(batch).numpy()
        if ring is not None and _agree(ring[valid], rows):
            return ring

        all_rows = np.zeros(len(scan), dtype=np.int64)
        all_rows[valid] = rows
        return all_rows

    def _report(self, cloud: Cloud, scale: float | None, geometry: SensorGeometry) -> str:
        """Return a line on what was assumed, and whether the weights have seen such a sensor."""
        assumed = [
            _describe_intensity(cloud, scale),
            self._describe_height(geometry),
            _describe_lasers(geometry),
        ]
        if cloud.note:
            assumed.insert(0, cloud.note)

        line = f"{cloud.name}: assumed {', '.join(assumed)}"

        trained = self._trained_sensor
        if trained is None or self._is_like(trained, geometry):
            return line

        return (
            f"{line}; the weights were trained for {trained.name} ({_describe_lasers(trained)}) "
            "and have seen no such sensor"
        )

    def _describe_height(self, geometry: SensorGeometry) -> str:
        if geometry.height is None:
            return "no ground to measure the height by (give --height)"

        text = f"sensor {geometry.height:.2f} m over the ground"
        rise = self._rise(geometry)
        if rise:
            text += f" (moved by {rise:+.2f} m to {self._trained_height:.2f} m)"
        return text

    def _is_like(self, trained: Sensor, geometry: SensorGeometry) -> bool:
        """Return whether the sensor is that of the training, or has similar lasers."""
        if self.sensor.name == trained.name:
            return True

        if geometry.beams and trained.beams:
            ratio = geometry.beams / trained.beams
            if not 1 / SAME_BEAMS < ratio < SAME_BEAMS:
                return False

        return _is_near(geometry.fov_up, trained.fov_up) and _is_near(
            geometry.fov_down, trained.fov_down
        )


def _level(cloud: Cloud, sensor: Sensor) -> Cloud:
    """Return the cloud in the package's axes; lost points, at the file's origin, stay lost."""
    if sensor.level:
        return cloud

    xyz = sensor.to_level(cloud.xyz)
    xyz[(cloud.xyz == 0).all(axis=1)] = np.nan
    return dataclasses.replace(cloud, xyz=xyz)


def _raise_points(scan: Scan, rise: float) -> Scan:
    """Return the scan moved up by some metres."""
    if not rise:
        return scan

    offset = np.array([0, 0, rise, 0], np.float32)
    with np.errstate(invalid="ignore"):  # points that are not valid may be any NaN
        return dataclasses.replace(scan, points=scan.points + offset)


def _field_of_view(sensor: Sensor | SensorGeometry) -> tuple[float, float] | None:
    """Return the upper and the lower end, degrees; None if one is unknown or they are swapped."""
    if sensor.fov_up is None or sensor.fov_down is None or sensor.fov_up <= sensor.fov_down:
        return None
    return sensor.fov_up, sensor.fov_down


def _by_elevation(view: RangeViewConfig, ends: tuple[float, float], steps: int) -> RangeViewConfig:
    """Return the view with rows by elevation, for lasers between two elevations.

    Its field of view is wider by half a step at each end, so that the lasers lie inside.

    Args:
        ends: elevations of the highest and the lowest laser, degrees.
        steps: how many steps the elevations between them are divided into.
    """
    top, bottom = ends
    half = (top - bottom) / (2 * steps)
    return dataclasses.replace(view, rows="elevation", fov_up=top + half, fov_down=bottom - half)


def _known_values(measurements: Sequence[SensorGeometry], key: str) -> list[float]:
    """Return the values of one attribute, without those that are unknown."""
    values = [getattr(geometry, key) for geometry in measurements]
    return [value for value in values if value is not None]


def _median(measurements: Sequence[SensorGeometry]) -> SensorGeometry:
    """Return the median of each attribute."""
    medians: dict[str, Any] = {}
    for key in KEYS:
        values = _known_values(measurements, key)
        if values:
            medians[key] = float(np.median(values))

    if "beams" in medians:
        medians["beams"] = round(medians["beams"])
    return SensorGeometry(**medians)


def _override(measured: SensorGeometry, sensor: Sensor) -> SensorGeometry:
    """Return the measurements, replaced by what is known of the sensor."""
    known: dict[str, Any] = {}
    for key in KEYS:
        value = getattr(sensor, key)
        if value is not None:
            known[key] = value

    return dataclasses.replace(measured, **known)


def _agree(ring: np.ndarray, rows: np.ndarray) -> bool:
    """Return whether most ring indices are the row of the point's elevation."""
    return bool(np.median(np.abs(ring - rows)) < 1)


def _is_near(angle: float | None, trained_angle: float | None) -> bool:
    """Return whether two angles in degrees are alike, or one of them is unknown."""
    if angle is None or trained_angle is None:
        return True
    return abs(angle - trained_angle) <= SAME_ANGLE


def _describe_intensity(cloud: Cloud, scale: float | None) -> str:
    if cloud.intensity is None or scale is None:
        return "no intensity"

    return f"intensity 0 to {scale:g}"


def _describe_lasers(sensor: Sensor | SensorGeometry) -> str:
    lasers = "lasers" if sensor.beams is None else f"{sensor.beams} lasers"
    if sensor.fov_up is None or sensor.fov_down is None:
        return lasers if sensor.beams else "field of view not found"

    return f"{lasers} from {sensor.fov_up:+.0f} to {sensor.fov_down:+.0f} degrees"
