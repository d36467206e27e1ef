"""Adapt the scans of any sensor to some weights: intensity, frame, height over the ground, rows."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amvnet.config.schema import RangeViewConfig
from amvnet.data.formats.cloud import Cloud, usual_scale
from amvnet.errors import InputError
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.progress import Say, say_nothing
from amvnet.scan import Scan
from amvnet.sensors.frame import STEADY_TILT, Frame, find_frame, median_frame
from amvnet.sensors.intensity import (
    IntensityMap,
    TrainedIntensity,
    are_of_one_range,
    intensity_map,
    quantiles_of,
    trained_intensity,
)
from amvnet.sensors.lidars import SENSORS, Sensor
from amvnet.sensors.measure import SensorGeometry, elevations, measure_lasers

MEASURED = 5  # scans of a recording that are measured; later ones get the median of these
STEADY = 0.4  # metres: if heights in a recording differ by more, each scan gets its own height
SAME_HEIGHT = 0.15  # metres: training moves the sensor up and down by as much
LOWEST = 0.3  # metres: if the origin is lower, it lies on the ground and not at the sensor
HIGHEST = 4.5  # metres: no vehicle carries its sensor higher; the coordinates may be in feet
OUTSIDE = 0.16  # share of points outside a field of view from which on it is too narrow
SAME_ANGLE = 6.0  # degrees: fields of view are alike if both ends differ by less
SAME_BEAMS = 1.4  # factor: numbers of lasers are alike if they differ by less
KEYS = ("beams", "fov_up", "fov_down", "height")  # attributes of a SensorGeometry


@dataclass(frozen=True)
class _Measurement:
    """What was measured of a scan, or of several as their median.

    Attributes:
        frame: of the coordinates.
        lasers: of the sensor, without its height.
        quantiles: of the intensities as they are in the file; None if there are none.
    """

    frame: Frame
    lasers: SensorGeometry
    quantiles: np.ndarray | None


@dataclass
class _Recording:
    """Scans that are assumed to come from one sensor, and what was measured of it.

    Attributes:
        measurements: of the first scans, at most `MEASURED`.
        median: of these.
        is_steady: whether the frames agree.
        is_learnt: whether `measurements` is complete; later scans add nothing to it.
        reported: what the user was told of: usual scans (True), scans of another sensor (False).
    """

    measurements: list[_Measurement] = field(default_factory=list)
    median: _Measurement | None = None
    is_steady: bool = True
    is_learnt: bool = False
    reported: set[bool] = field(default_factory=set)

    def add(self, measurement: _Measurement) -> None:
        """Add what was measured of one of the first scans."""
        self.measurements.append(measurement)
        self.median = _median(self.measurements)
        self.is_steady = _are_steady([measured.frame for measured in self.measurements])
        self.is_learnt |= len(self.measurements) == MEASURED


class ScanAdapter:
    """Turns the contents of scan files into scans as some weights expect them.

    Intensities are brought to the distribution of the training, the axes are turned level, and the
    scan is moved up or down until its sensor is as high over the ground as the one that the weights
    were trained for. `ring` becomes the row of each point in the range image, 0 the lowest, for
    `Segmenter.by_ring`. The row follows the elevation at which the sensor saw the point, before the
    move.

    Args:
        view: the range view of the weights.
        trained_for: the sensor that the weights were trained for, as far as it is known, from
            `trained_sensor`; None if nothing is.
        sensor: what is known of the sensor of the scans; the rest is measured.
        say: is told once for each recording what was assumed.
        intensity: the intensities that the weights were trained with; None means those of the
            named sensor that they were trained for, if they are known.
        as_is: whether they were trained on scans that were not adapted. Scans of the same field of
            view then have their rows as in the training, however many points are outside.
    """

    def __init__(
        self,
        view: RangeViewConfig,
        trained_for: Sensor | None = None,
        sensor: Sensor | None = None,
        say: Say = say_nothing,
        intensity: TrainedIntensity | None = None,
        as_is: bool = False,
    ) -> None:
        self.sensor = sensor or Sensor()
        self._view = view
        self._trained = trained_for or Sensor()
        self._trained_height = self._trained.height
        self._as_is = as_is
        self._trained_intensity = intensity or trained_intensity({}, self._trained.name)
        self._say = say
        self._recordings: dict[str, _Recording] = {}

    def __call__(self, cloud: Cloud, source: str) -> Scan:
        """Return the scan as the weights expect it; its points keep their order and number.

        Args:
            source: name of the bag or folder that the scan is from. Scans of one source are assumed
                to come from one sensor, as long as their intensities have the same range.

        Raises:
            InputError: if no point is usable, or the unit of the coordinates is in doubt.
        """
        recording = self._recordings.setdefault(source, _Recording())
        is_usual, measurement = self._measurement(cloud, recording)
        to_intensity = self._intensity_map(cloud, measurement.quantiles)
        heights = self._heights(measurement.frame)
        is_reported = is_usual in recording.reported
        if recording.is_steady or not is_reported:
            self._check_height(cloud, measurement.frame)

        scan = _to_scan(cloud, measurement.frame.complete(self.sensor), to_intensity)
        seen = _raise_points(scan, heights.to_seen)
        moved = _raise_points(scan, heights.to_trained)

        valid = scan.valid
        geometry = _override(measurement.lasers, self.sensor)
        view = self._row_view(seen.points[valid], geometry)
        if not is_reported:
            recording.reported.add(is_usual)
            self._say(self._report(cloud, measurement.frame, to_intensity, geometry))
        return dataclasses.replace(moved, ring=self._rows(seen, valid, view))

    def learn(self, source: str, first: Sequence[Callable[[], Cloud]]) -> None:
        """Measure the first scans of a source; later scans add no measurements.

        Args:
            first: functions that read these scans; broken scans are left out.
        """
        recording = self._recordings.setdefault(source, _Recording())
        for read in first:
            if not recording.is_learnt:
                with suppress(InputError):
                    cloud = read()
                    recording.add(self._measure(cloud, quantiles_of(cloud.intensity)))
        recording.is_learnt |= recording.median is not None

    def for_sensor(self, sensor: Sensor) -> ScanAdapter:
        """Return an adapter to the same weights for scans of a described sensor."""
        adapter = copy.copy(self)
        adapter.sensor = sensor
        adapter._recordings = {}
        return adapter

    @property
    def trained_intensity(self) -> TrainedIntensity | None:
        """The intensities that scans are brought to; None if they are only scaled."""
        return self._trained_intensity

    def target(self) -> dict[str, float]:
        """Return what weights that are trained on the adapted scans should carry of the sensor.

        The height is that which the scans are moved to. The lasers are those of the scans, but if
        the rows of the range image are lasers, those that decide the rows.
        """
        medians = [recording.median for recording in self._recordings.values()]
        known = [median for median in medians if median is not None]
        lasers: Sensor | SensorGeometry = self._trained
        height = self._trained_height
        if known:
            measured = _median(known)
            height = measured.frame.height if height is None else height
            if self._view.rows != "ring" or _field_of_view(lasers) is None:
                lasers = _override(measured.lasers, self.sensor)

        values = {key: getattr(lasers, key) for key in KEYS} | {"height": height}
        return {key: value for key, value in values.items() if value is not None}

    def _measurement(self, cloud: Cloud, recording: _Recording) -> tuple[bool, _Measurement]:
        """Return the median of the first scans if this scan is like them, else measure it.

        Returns:
            Whether the intensities have the range of the first scans, and the measurement.
        """
        quantiles = quantiles_of(cloud.intensity)
        median = recording.median
        is_usual = median is None or are_of_one_range(quantiles, median.quantiles)
        if not is_usual:
            return False, self._measure(cloud, quantiles)

        if median is None or not recording.is_learnt:
            measured = self._measure(cloud, quantiles)
            recording.add(measured)
            median = recording.median
            assert median is not None
        elif not recording.is_steady:
            measured = self._measure(cloud, quantiles)

        if recording.is_steady:
            return True, median
        return True, dataclasses.replace(measured, quantiles=median.quantiles)

    def _measure(self, cloud: Cloud, quantiles: np.ndarray | None) -> _Measurement:
        """Measure one scan.

        Raises:
            InputError: if the unit of the coordinates is in doubt.
        """
        usable = np.isfinite(cloud.xyz).all(axis=1) & (cloud.xyz != 0).any(axis=1)
        try:
            frame = find_frame(cloud.xyz[usable], self.sensor)
        except InputError as error:
            raise InputError(f"{cloud.name}: {error}") from None

        # All lasers are needed here, in the order of the file.
        scan = _to_scan(cloud, frame.complete(self.sensor))
        seen = _raise_points(scan, self._heights(frame).to_seen)
        valid = scan.valid
        ring = None if scan.ring is None else scan.ring[valid]
        return _Measurement(frame, measure_lasers(seen.points[valid], ring), quantiles)

    def _intensity_map(self, cloud: Cloud, quantiles: np.ndarray | None) -> IntensityMap:
        given_scale = self.sensor.intensity_scale
        scale = given_scale or cloud.full or 1.0
        if given_scale is None and cloud.full is None and quantiles is not None:
            assert cloud.intensity is not None
            scale = usual_scale(quantiles[-1], is_integer=cloud.intensity.dtype.kind in "iu")
        is_given = given_scale is not None
        return intensity_map(quantiles, scale, self._trained_intensity, is_given)

    def _heights(self, frame: Frame) -> _Moves:
        """Return how far to move a scan up."""
        trained = self._trained_height
        given_height = self.sensor.height
        ground = frame.height
        is_higher = given_height is None or given_height >= LOWEST
        if ground is not None and ground < LOWEST and is_higher:
            # The sensor is not at the origin: it is as high as given, or as that of the training.
            above = given_height if given_height is not None else trained
            if above is None:
                return _Moves(is_on_ground=True)
            target = above if trained is None else trained
            return _Moves(ground - above, ground - target, is_on_ground=True)

        height = given_height if given_height is not None else ground
        if height is None or trained is None or abs(height - trained) < SAME_HEIGHT:
            return _Moves()
        return _Moves(to_trained=height - trained)

    def _check_height(self, cloud: Cloud, frame: Frame) -> None:
        """Raise InputError if the ground is too far below the sensor for coordinates in metres."""
        is_given = self.sensor.height is not None or self.sensor.unit is not None
        if not is_given and frame.height is not None and frame.height > HIGHEST:
            raise InputError(
                f"{cloud.name}: expected a sensor at most {HIGHEST:g} m over the ground, found "
                f"{frame.height:.1f}; give --unit ft if these are feet, else --height"
            )

    def _row_view(self, points: np.ndarray, geometry: SensorGeometry) -> RangeViewConfig | None:
        """Return the range view that gives (P, 4) points their rows by elevation.

        It is that of the weights, but with the sensor's field of view if too many points are
        outside. None if the rows are lasers and their elevations are unknown.
        """
        view = self._trained_view(geometry)
        if view is None or (self._as_is and self._has_trained_ends(geometry)):
            return view

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

        ends = _field_of_view(self._trained)
        if ends is None and geometry.beams == view.height:
            ends = _field_of_view(geometry)
        return None if ends is None else _by_elevation(view, ends, view.height - 1)

    def _rows(
        self, scan: Scan, valid: np.ndarray, view: RangeViewConfig | None
    ) -> np.ndarray | None:
        """Return each point's (N,) row in the range image, 0 the lowest; 0 for lost points.

        None if the weights need rings, and neither the scan nor its elevations tell them.
        """
        ring = scan.ring if self._view.rows == "ring" else None
        # Lasers that no data sheet describes need not be evenly spaced.
        is_trusted = ring is not None and self._trained.name not in SENSORS
        if view is None or is_trusted:
            return ring

        batch = PointBatch.of([scan])
        rows = view.height - 1 - RangeView(view).rows(batch).numpy()
        if ring is not None and _agree(ring[valid], rows):
            return ring

        all_rows = np.zeros(len(scan), dtype=np.int64)
        all_rows[valid] = rows
        return all_rows

    def _report(
        self, cloud: Cloud, frame: Frame, to_intensity: IntensityMap, geometry: SensorGeometry
    ) -> str:
        """Return a line on what was assumed, and whether the weights have seen such a sensor."""
        assumed = [cloud.note] if cloud.note else []
        assumed += [
            to_intensity.text,
            *self._describe_frame(frame),
            self._describe_height(frame),
            _describe_lasers(geometry),
        ]
        line = f"{cloud.name}: assumed {', '.join(assumed)}"

        trained = self._trained
        if _field_of_view(trained) is None or self._is_like(trained, geometry):
            return line

        sheet = SENSORS.get(trained.name)
        name = trained.name if sheet and sheet.beams == trained.beams else "a sensor"
        return (
            f"{line}; the weights were trained for {name} ({_describe_lasers(trained)}) "
            "and have seen no such sensor"
        )

    def _describe_frame(self, frame: Frame) -> list[str]:
        """Return what was guessed of the frame, each as a text with its option."""
        texts = []
        if self.sensor.unit is None and frame.unit != "m":
            texts.append(f"--unit {frame.unit}")
        if self.sensor.axes is None and frame.axes != "x-forward":
            texts.append(f"--axes {frame.axes}")
        if frame.pitch or frame.roll:
            texts.append(
                f"a tilt of {frame.tilt:.0f} degrees (levelled, --rotate "
                f"0,{frame.pitch:.1f},{frame.roll:.1f})"
            )
        return texts

    def _describe_height(self, frame: Frame) -> str:
        given_height = self.sensor.height
        if given_height is None and frame.height is None:
            return "no ground to measure the height by (give --height; --axes if z is not up)"

        moves = self._heights(frame)
        if moves.is_on_ground:
            text = f"the ground {-(frame.height or 0):+.2f} m from the origin"
        else:
            height = given_height if given_height is not None else frame.height
            text = f"sensor {height:.2f} m over the ground"
        if moves.to_trained:
            text += f" (moved by {moves.to_trained:+.2f} m to {self._trained_height:.2f} m)"
        return text

    def _is_like(self, trained: Sensor, geometry: SensorGeometry) -> bool:
        """Return whether the sensor is that of the training, or has similar lasers."""
        if self.sensor.name and self.sensor.name == trained.name:
            return True

        if geometry.beams and trained.beams:
            ratio = geometry.beams / trained.beams
            if not 1 / SAME_BEAMS < ratio < SAME_BEAMS:
                return False

        return self._has_trained_ends(geometry)

    def _has_trained_ends(self, geometry: SensorGeometry) -> bool:
        """Return whether a field of view is that of the training, as far as they are known."""
        return _is_near(geometry.fov_up, self._trained.fov_up) and _is_near(
            geometry.fov_down, self._trained.fov_down
        )


@dataclass(frozen=True)
class _Moves:
    """How far a scan is moved up, metres.

    Attributes:
        to_seen: so that the sensor is at the origin.
        to_trained: so that the sensor of the training is.
        is_on_ground: whether the file's origin is on the ground, or below.
    """

    to_seen: float = 0.0
    to_trained: float = 0.0
    is_on_ground: bool = False


def _to_scan(cloud: Cloud, sensor: Sensor, to_intensity: IntensityMap | None = None) -> Scan:
    """Return the scan in the package's axes."""
    intensity = None
    if to_intensity is not None:
        intensity = to_intensity(cloud.intensity, len(cloud.xyz))

    xyz = sensor.to_level(cloud.xyz)
    return dataclasses.replace(cloud, xyz=xyz, intensity=intensity).to_scan(1.0)


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


def _are_steady(frames: Sequence[Frame]) -> bool:
    """Return whether the scans of a recording were recorded in one frame, at one height."""
    if len({(frame.unit, frame.axes) for frame in frames}) > 1:
        return False
    heights = [frame.height for frame in frames if frame.height is not None]
    if heights and max(heights) - min(heights) >= STEADY:
        return False
    turns = np.array([(frame.pitch, frame.roll) for frame in frames])
    return bool((np.ptp(turns, axis=0) < STEADY_TILT).all())


def _median(measurements: Sequence[_Measurement]) -> _Measurement:
    """Return the median of each value that is known."""
    medians: dict[str, Any] = {}
    for key in KEYS:
        values = [getattr(measured.lasers, key) for measured in measurements]
        known = [value for value in values if value is not None]
        if known:
            medians[key] = float(np.median(known))
    if "beams" in medians:
        medians["beams"] = round(medians["beams"])

    frame = median_frame([measured.frame for measured in measurements])
    quantiles = [measured.quantiles for measured in measurements]
    present = [values for values in quantiles if values is not None]
    pooled = np.median(present, axis=0) if 2 * len(present) > len(quantiles) else None
    return _Measurement(frame, SensorGeometry(**medians), pooled)


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


def _describe_lasers(sensor: Sensor | SensorGeometry) -> str:
    lasers = "lasers" if sensor.beams is None else f"{sensor.beams} lasers"
    if sensor.fov_up is None or sensor.fov_down is None:
        return lasers if sensor.beams else "field of view not found"

    return f"{lasers} from {sensor.fov_up:+.0f} to {sensor.fov_down:+.0f} degrees"
