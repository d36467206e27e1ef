"""Normalise the scans of any sensor to what weights expect: axes, height, intensities, rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from amvnet.data.datasets.base import Dataset
from amvnet.data.formats.cloud import Cloud, usual_scale
from amvnet.data.recordings import Recording, ScanFile
from amvnet.errors import InputError, errors_of
from amvnet.progress import Reporter, report_nothing
from amvnet.scan import Scan
from amvnet.sensors.built_in import suited_to
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.frame import MAX_SENSOR_HEIGHT, Frame
from amvnet.sensors.intensity import IntensityMap, fill_intensity, intensity_map
from amvnet.sensors.lasers import SensorGeometry, describe_lasers
from amvnet.sensors.lidars import (
    ANY,
    KNOWN_SENSORS,
    UNITS,
    UNKNOWN_SENSOR,
    Sensor,
    make_sensor,
)
from amvnet.sensors.measure import (
    MEASURED_SCANS,
    Estimate,
    Measured,
    median_of,
    raise_points,
    seen_scan,
)
from amvnet.sensors.own_body import own_points
from amvnet.sensors.rows import find_rows


def normalise(
    cloud: Cloud, estimate: Estimate, sensor: Sensor, expected: Expectation
) -> tuple[Scan, str]:
    """Return a scan as some weights expect it, and what was wrong with its rings.

    The points keep their order and number.

    The scan is levelled and moved to the height of the training's sensor. Points of the car's own
    body are marked (`own_points`). If the weights' rows are lasers and the scan's lasers are known,
    the lasers decide `Scan.row`. Otherwise the elevations decide it, under which the sensor saw the
    points before the move.

    Raises:
        InputError: if no point is usable.
    """
    to_intensity = _intensity_map(cloud, estimate.quantiles, sensor, expected)
    intensity = to_intensity(cloud.intensity, len(cloud.xyz))
    height = expected.sensor.height
    seen, ring_fault = seen_scan(cloud, estimate.frame, sensor, height, intensity)
    seen, _ = fill_intensity(seen, expected.intensity)
    to_sensor, to_trained = estimate.frame.rises(sensor, height)
    moved = raise_points(seen, to_trained - to_sensor)
    complete = estimate.frame.complete(sensor)

    lasers = estimate.lasers.override(sensor)
    row = find_rows(seen, complete, lasers, estimate.density, expected)
    own = own_points(cloud.xyz * UNITS[estimate.frame.unit], cloud.ring, sensor)
    to_file = complete.to_file(to_trained)
    return dataclasses.replace(moved, row=row, own=own, to_file=to_file), ring_fault


def describe(
    cloud: Cloud, estimate: Estimate, sensor: Sensor, expected: Expectation, ring_fault: str
) -> str:
    """Return one line: what is assumed about a scan, and whether the weights know its sensor."""
    lasers = estimate.lasers.override(sensor)
    assumed = [
        cloud.note,
        _intensity_map(cloud, estimate.quantiles, sensor, expected).text,
        _describe_missing(cloud),
        _describe_negative(cloud),
        *_describe_frame(estimate.frame, sensor),
        _describe_height(estimate.frame, sensor, expected.sensor.height),
        ring_fault,
        describe_lasers(lasers),
    ]
    line = f"{cloud.name}: assumed {', '.join(filter(None, assumed))}"

    trained = expected.sensor
    is_named = trained.name == ANY or (bool(sensor.name) and sensor.name == trained.name)
    if expected.lasers.field_of_view is None or is_named or lasers.is_like(expected.lasers):
        return line

    name = trained.name or "a sensor"
    return (
        f"{line}; the weights were trained for {name} ({describe_lasers(expected.lasers)}) "
        f"and have seen no such sensor; {suited_to(lasers)} would fit"
    )


@dataclass(eq=False)
class Normaliser:
    """How recordings are normalised; called with one, it returns the normalised one.

    Attributes:
        expected: the scans that the weights expect. If it is None, scans are only turned by the
            description of the sensor, so that people can look at them.
        sensor: what is known about the scans' sensor; the rest is measured.
        report: called with `Scan.assumed`, once for all recordings of one sensor, and once more if
            a recording has scans from other sensors.
        known: a recording that was measured before, and what was measured of it (`Measured.usual`).
    """

    expected: Expectation | None = None
    sensor: Sensor = UNKNOWN_SENSOR
    report: Reporter = report_nothing
    known: tuple[Recording, Estimate | None] | None = None
    _latest: Recording | None = field(default=None, init=False)  # the one that was measured last
    _measured: list[Measured] = field(default_factory=list, init=False)  # of all so far
    # What was reported: of scans that are only turned, and notes and estimates of others.
    _turned: set[str] = field(default_factory=set, init=False)
    _described: list[tuple[str, Estimate]] = field(default_factory=list, init=False)

    def __call__(self, recording: Recording) -> Normalised:
        """Return the recording with its scans as the weights expect them."""
        return Normalised(recording, self)

    def quiet(self) -> None:
        """Report nothing more."""
        self.report = report_nothing

    def measure(self, recording: Recording) -> Measured:
        """Measure the first scans of a recording, even if another process or run did so."""
        assert self.expected is not None
        measured = Measured(self.sensor, self.expected.sensor.height)
        self._measured.append(measured)
        if self.known is not None and self.known[0] is recording:
            measured.recall(self.known[1])
            return measured

        if self._latest is not None:
            self._latest.kept.clear()
        self._latest = recording
        measured.learn(recording.first(MEASURED_SCANS))
        return measured

    def tell(self, lines: Sequence[str], cloud: Cloud, estimate: Estimate, is_other: bool) -> None:
        """Report what is assumed of a scan if the like was not yet, or it is another sensor's."""
        is_described = any(
            note == cloud.note and estimate.is_near(other) for note, other in self._described
        )
        if not is_described:
            self._described.append((cloud.note, estimate))
        if is_other or not is_described:
            for line in lines:
                self.report(line)

    def tell_turned(self, name: str, assumed: str) -> str:
        """Return the line on a scan that is only turned; report it if the like was not yet."""
        line = f"{name}: assumed {assumed}"
        if assumed not in self._turned:
            self.report(line)
        self._turned.add(assumed)
        return line

    def for_sensor(self, sensor: Sensor) -> Normaliser:
        """Return a normaliser for the same weights and the scans of a described sensor."""
        keep_own = self.sensor.keep_own or sensor.keep_own
        described = dataclasses.replace(sensor, keep_own=keep_own)
        return dataclasses.replace(self, sensor=described)

    def target(self) -> SensorGeometry:
        """Return the geometry of a sensor for weights that are trained on the normalised scans.

        The height is the height to which the scans are moved. The lasers are the scans' lasers. If
        the rows of the range image are rings, they are the lasers that decide the rows instead.
        """
        assert self.expected is not None
        medians = [measured.usual for measured in self._measured if measured.usual is not None]
        lasers = self.expected.lasers
        height = self.expected.sensor.height
        if medians:
            measured = median_of(medians)
            height = measured.frame.height if height is None else height
            if self.expected.view.rows != "ring" or lasers.field_of_view is None:
                lasers = measured.lasers.override(self.sensor)

        return dataclasses.replace(lasers, height=height)


class Normalised(Recording):
    """A recording as some weights expect it; a `Normaliser` makes it."""

    def __init__(self, recording: Recording, normaliser: Normaliser) -> None:
        super().__init__(recording.name, recording.scans, recording.kept)
        self._recording = recording
        self.normaliser = normaliser
        # What was assumed of the usual sensor, and of other sensors.
        self._assumed: dict[bool, str] = {}

    @cached_property
    def measured(self) -> Measured:
        """What is measured of the sensor, once, on the first scans."""
        return self.normaliser.measure(self._recording)

    def scan(self, file: ScanFile) -> Scan:
        """Read a scan as the weights expect it; it keeps the coordinates of its file.

        Raises:
            InputError: if it cannot be read; or as `to_scan`.
        """
        if self.normaliser.expected is not None:
            self.measured  # noqa: B018  # which may keep this scan in memory
        return super().scan(file)

    def to_scan(self, cloud: Cloud) -> Scan:
        """Return a scan as the weights expect it; its points keep their order and number.

        Raises:
            InputError: if no point is usable, or the unit of the coordinates is in doubt.
        """
        expected = self.normaliser.expected
        sensor = self.normaliser.sensor
        if expected is None:
            return self._turn(cloud, sensor)

        estimate, is_usual = self.measured.estimate(cloud)
        _check_height(cloud, estimate.frame, sensor)
        scan, ring_fault = normalise(cloud, estimate, sensor, expected)

        is_new = is_usual not in self._assumed
        is_mixed = self.measured.is_mixed
        if is_new or is_mixed:
            line = describe(cloud, estimate, sensor, expected, ring_fault)
            if is_mixed:
                line += f"; {self.name} has scans of other sensors, so that each is measured alone"
            if not is_usual:
                line += f"; another sensor or scale of intensity than {self.name} begins with"
            lines = [line]
            stated = estimate.contradiction(sensor)
            if stated:
                lines.append(f"warning: {cloud.name}: you state {stated}; correct the sensor")
            self._assumed[is_usual] = "; ".join(lines)
            is_other = is_new and (not is_usual or is_mixed)
            self.normaliser.tell(lines, cloud, estimate, is_other)
        return dataclasses.replace(scan, assumed=self._assumed[is_usual])

    def _turn(self, cloud: Cloud, sensor: Sensor) -> Scan:
        """Return a scan that is only turned, by the description of the sensor."""
        xyz = sensor.to_level(cloud.xyz)
        scale = sensor.intensity_scale or cloud.intensity_scale()
        scan = dataclasses.replace(cloud, xyz=xyz).to_scan(scale)

        if not self._assumed:
            has_intensity = cloud.intensity is not None and scale is not None
            intensity = f"intensity 0 to {scale:g}" if has_intensity else "no intensity"
            negative = _describe_negative(cloud)
            parts = [cloud.note, intensity, negative, f"axes {sensor.axes or 'x-forward'}"]
            assumed = ", ".join(filter(None, parts))
            self._assumed[True] = self.normaliser.tell_turned(cloud.name, assumed)
        return dataclasses.replace(scan, to_file=sensor.to_file(), assumed=self._assumed[True])


def _check_height(cloud: Cloud, frame: Frame, sensor: Sensor) -> None:
    """Check that the ground is not too deep for coordinates in metres."""
    is_known = sensor.height is not None or sensor.unit is not None
    if not is_known and frame.height is not None and frame.height > MAX_SENSOR_HEIGHT:
        raise InputError(
            f"{cloud.name}: expected a sensor at most {MAX_SENSOR_HEIGHT:g} m over the ground, "
            f"found {frame.height:.1f}; give --unit ft if these are feet, else --height"
        )


def normalised(dataset: Dataset, normaliser: Normaliser) -> Dataset:
    """Return a dataset whose scans are normalised as scan files are.

    The scans of benchmarks stay unchanged, because weights are trained on such scans, unless the
    weights do not know the benchmark's sensor (`Dataset.benchmark_sensor`).

    Args:
        normaliser: normalises the scans. If it knows nothing of the sensor, what the dataset's YAML
            file says of it counts.

    Raises:
        InputError: if the YAML file describes an impossible sensor.
    """
    if dataset.benchmark_sensor:
        lasers = SensorGeometry().override(KNOWN_SENSORS[dataset.benchmark_sensor])
        if normaliser.expected is None or normaliser.expected.lasers.is_like(lasers):
            return dataset
        normaliser = normaliser.for_sensor(Sensor(unit="m"))
    elif dataset.described_sensor is not None and not normaliser.sensor.is_known:
        normaliser = normaliser.for_sensor(described_sensor(dataset))
    return dataset.normalised_by(normaliser)


def described_sensor(dataset: Dataset) -> Sensor:
    """Return what a dataset's YAML file says of the sensor.

    Raises:
        InputError: if there is no such sensor.
    """
    with errors_of(f"{dataset.spec}: sensor"):
        return make_sensor(dataset.described_sensor)


def _intensity_map(
    cloud: Cloud, quantiles: np.ndarray | None, sensor: Sensor, expected: Expectation
) -> IntensityMap:
    """Return the map from the intensities of a scan to intensities like the training's."""
    known_scale = sensor.intensity_scale
    scale = known_scale or 1.0
    if known_scale is None and quantiles is not None:
        assert cloud.intensity is not None
        scale = usual_scale(quantiles[-1], is_integer=cloud.intensity.dtype.kind in "iu")
    is_given = known_scale is not None
    return intensity_map(quantiles, scale, expected.intensity, is_given=is_given)


def _describe_frame(frame: Frame, sensor: Sensor) -> list[str]:
    """Return in words what was found about the frame, with the option that states each."""
    texts = []
    if sensor.unit is None and frame.unit != "m":
        texts.append(f"--unit {frame.unit}")
    if sensor.axes is None and frame.axes != "x-forward":
        texts.append(f"--axes {frame.axes}")
    if frame.pitch or frame.roll:
        texts.append(
            f"a tilt of {frame.tilt:.0f} degrees (levelled, --rotate "
            f"0,{frame.pitch:.1f},{frame.roll:.1f})"
        )
    return texts


def _describe_missing(cloud: Cloud) -> str:
    """Return in words how many points have no intensity although others have; empty if none."""
    measured = cloud.measured_intensity()
    count = np.count_nonzero(cloud.is_placed)
    if measured is None or len(measured) == count:
        return ""
    return f"no intensity in {count - len(measured):,} of {count:,} points (the median instead)"


def _describe_negative(cloud: Cloud) -> str:
    """Return how many points have an intensity below 0, which counts as 0; empty for none."""
    measured = cloud.measured_intensity()
    if measured is None or measured.min() >= 0 or measured.max() < 0:
        return ""
    count = np.count_nonzero(measured < 0)
    return f"intensity {measured.min():g} in {count:,} of {len(measured):,} points (0 instead)"


def _describe_height(frame: Frame, sensor: Sensor, usual_height: float | None) -> str:
    """Return in words the height of the sensor, and how far its scans are moved up or down."""
    height = sensor.height if sensor.height is not None else frame.height
    if height is None:
        return "no ground to measure the height by (give --height; --axes if z is not up)"

    text = f"sensor {height:.2f} m over the ground"
    notes = []
    _, rise = frame.rises(sensor, usual_height)
    if rise:
        notes.append(f"moved by {rise:+.2f} m to {usual_height:.2f} m")
    if frame.is_on_ground(sensor):
        place = f"the ground at {-(frame.height or 0):+.2f} m, so the origin is not the sensor"
        text = place if sensor.height is None else f"{text}, {place}"
        if sensor.offset is None:
            notes.append("--offset 0,0,-Z if the sensor is Z m over the origin")
    return f"{text} ({'; '.join(notes)})" if notes else text
