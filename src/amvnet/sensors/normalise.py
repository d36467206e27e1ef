"""Normalise the scans of any sensor to what weights expect: axes, height, intensities, rows."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

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


class Normaliser:
    """Normalise the scans of recordings, each recording by measuring its first scans.

    Args:
        expected: the scans that the weights expect. If it is None, scans are only turned by the
            description of the sensor, so that people can look at them.
        sensor: what is known about the scans' sensor; the rest is measured.
        report: called with `Scan.assumed`, once for all recordings of one sensor, and once more if
            a recording has scans from other sensors.
    """

    def __init__(
        self,
        expected: Expectation | None = None,
        sensor: Sensor | None = None,
        report: Reporter = report_nothing,
    ) -> None:
        self.expected = expected
        self.sensor = sensor or Sensor()
        self._report = report
        self._measured: dict[Recording | str, Measured] = {}
        self._latest: Recording | None = None  # the one that was measured last
        # What was assumed of the usual sensor of each recording, and of its other sensors.
        self._assumed: dict[tuple[Recording | str, bool], str] = {}
        self._turned: set[str] = set()  # what was reported of scans that are only turned
        self._described: list[tuple[str, Estimate]] = []  # notes and estimates in these lines

    def quiet(self) -> None:
        """Report nothing more."""
        self._report = report_nothing

    def scan(self, file: ScanFile) -> Scan:
        """Read a scan as the weights expect it; it keeps the coordinates of its file.

        Raises:
            InputError: if it cannot be read; or as `__call__`.
        """
        if self.expected is not None:
            self.measure(file.recording)  # which may keep this scan in memory
        cloud = file.recording.read(file)
        return dataclasses.replace(self(cloud, file.recording), file_xyz=cloud.xyz)

    def __call__(self, cloud: Cloud, recording: Recording | str) -> Scan:
        """Return a scan as the weights expect it; its points keep their order and number.

        Args:
            recording: the recording, or the name of one in memory.

        Raises:
            InputError: if no point is usable, or the unit of the coordinates is in doubt.
        """
        if self.expected is None:
            return self._turn(cloud, recording)

        source = recording if isinstance(recording, str) else recording.name
        measured = self.measure(recording)
        estimate, is_usual = measured.estimate(cloud)
        self._check_height(cloud, estimate.frame)
        scan, ring_fault = normalise(cloud, estimate, self.sensor, self.expected)

        key = (recording, is_usual)
        is_new = key not in self._assumed
        if is_new or measured.is_mixed:
            line = describe(cloud, estimate, self.sensor, self.expected, ring_fault)
            if measured.is_mixed:
                line += f"; {source} has scans of other sensors, so that each is measured alone"
            if not is_usual:
                line += f"; another sensor or scale of intensity than {source} begins with"
            lines = [line]
            stated = estimate.contradiction(self.sensor)
            if stated:
                lines.append(f"warning: {cloud.name}: you state {stated}; correct the sensor")
            self._assumed[key] = "; ".join(lines)
            is_described = self._is_described(cloud, estimate)
            if (is_new and (not is_usual or measured.is_mixed)) or not is_described:
                for line in lines:
                    self._report(line)
        return dataclasses.replace(scan, assumed=self._assumed[key])

    def _is_described(self, cloud: Cloud, estimate: Estimate) -> bool:
        for note, other in self._described:
            if note == cloud.note and estimate.is_near(other):
                return True
        self._described.append((cloud.note, estimate))
        return False

    def measure(self, recording: Recording | str) -> Measured:
        """Return what is measured of a recording; the first call measures its first scans.

        They are measured even if another process or run normalises them.
        """
        if recording not in self._measured:
            measured = self._begin(recording)
            if isinstance(recording, Recording):
                if self._latest is not None:
                    self._latest.kept.clear()
                self._latest = recording
                measured.learn(recording.first(MEASURED_SCANS))
        return self._measured[recording]

    def recall(self, measured: Mapping[Recording, Estimate | None]) -> None:
        """Normalise the scans of some recordings by estimates that were measured before."""
        for recording, usual in measured.items():
            self._begin(recording).recall(usual)

    def _begin(self, recording: Recording | str) -> Measured:
        assert self.expected is not None
        self._measured[recording] = Measured(self.sensor, self.expected.sensor.height)
        return self._measured[recording]

    def for_sensor(self, sensor: Sensor) -> Normaliser:
        """Return a normaliser for the same weights and the scans of a described sensor."""
        keep_own = self.sensor.keep_own or sensor.keep_own
        described = dataclasses.replace(sensor, keep_own=keep_own)
        return Normaliser(self.expected, described, self._report)

    def target(self) -> SensorGeometry:
        """Return the geometry of a sensor for weights that are trained on the normalised scans.

        The height is the height to which the scans are moved. The lasers are the scans' lasers. If
        the rows of the range image are rings, they are the lasers that decide the rows instead.
        """
        assert self.expected is not None
        usual = [measured.usual for measured in self._measured.values()]
        medians = [estimate for estimate in usual if estimate is not None]
        lasers = self.expected.lasers
        height = self.expected.sensor.height
        if medians:
            measured = median_of(medians)
            height = measured.frame.height if height is None else height
            if self.expected.view.rows != "ring" or lasers.field_of_view is None:
                lasers = measured.lasers.override(self.sensor)

        return dataclasses.replace(lasers, height=height)

    def _check_height(self, cloud: Cloud, frame: Frame) -> None:
        """Check that the ground is not too deep for coordinates in metres."""
        is_known = self.sensor.height is not None or self.sensor.unit is not None
        if not is_known and frame.height is not None and frame.height > MAX_SENSOR_HEIGHT:
            raise InputError(
                f"{cloud.name}: expected a sensor at most {MAX_SENSOR_HEIGHT:g} m over the ground, "
                f"found {frame.height:.1f}; give --unit ft if these are feet, else --height"
            )

    def _turn(self, cloud: Cloud, recording: Recording | str) -> Scan:
        """Return a scan that is only turned, by the description of the sensor."""
        xyz = self.sensor.to_level(cloud.xyz)
        scale = self.sensor.intensity_scale or cloud.intensity_scale()
        scan = dataclasses.replace(cloud, xyz=xyz).to_scan(scale)

        key = (recording, True)
        if key not in self._assumed:
            has_intensity = cloud.intensity is not None and scale is not None
            intensity = f"intensity 0 to {scale:g}" if has_intensity else "no intensity"
            negative = _describe_negative(cloud)
            parts = [cloud.note, intensity, negative, f"axes {self.sensor.axes or 'x-forward'}"]
            assumed = ", ".join(filter(None, parts))
            if assumed not in self._turned:
                self._report(f"{cloud.name}: assumed {assumed}")
            self._turned.add(assumed)
            self._assumed[key] = f"{cloud.name}: assumed {assumed}"
        return dataclasses.replace(scan, to_file=self.sensor.to_file(), assumed=self._assumed[key])


def normalised(
    dataset: Dataset, normaliser: Normaliser, measured: Mapping[Recording, Estimate | None] = {}
) -> Dataset:
    """Return a dataset whose scans are normalised as scan files are.

    The scans of benchmarks stay unchanged, because weights are trained on such scans, unless the
    weights do not know the benchmark's sensor (`Dataset.benchmark_sensor`).

    Args:
        normaliser: normalises the scans. If it knows nothing of the sensor, what the dataset's YAML
            file says of it counts.
        measured: estimates of recordings that were measured before.

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

    normaliser.recall(measured)
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

    if frame.is_on_ground(sensor):
        text = f"the ground {-(frame.height or 0):+.2f} m from the origin"
    else:
        text = f"sensor {height:.2f} m over the ground"
    _, rise = frame.rises(sensor, usual_height)
    if rise:
        text += f" (moved by {rise:+.2f} m to {usual_height:.2f} m)"
    return text
