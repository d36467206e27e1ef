"""What networks expect of a scan: its sensor, its rows, its intensities. It needs only NumPy."""

from __future__ import annotations

import dataclasses
import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from amvnet.config.bounds import check_text
from amvnet.config.nested import to_dict
from amvnet.config.schema import RangeViewConfig
from amvnet.errors import InputError, shown
from amvnet.scan import Scan
from amvnet.sensors.intensity import (
    SIMULATED_QUANTILES,
    TrainedIntensity,
    check_intensity,
    fill_intensity,
    match_scan,
)
from amvnet.sensors.lasers import MEASURES, SensorGeometry, lasers_by_order, order_rings
from amvnet.sensors.lidars import ANY, KNOWN_HEIGHTS, KNOWN_SENSORS, Sensor


@dataclass(frozen=True)
class Expectation:
    """The scans that the networks of some weights expect.

    A training decides it, and the weights carry it. All that segments scans prepares them by it.

    Attributes:
        view: the range view of the weights: what decides the rows, and how near the points of the
            car's own body are.
        sensor: the height, the lasers and the field of view of the training's sensor. It has a name
            if a data sheet describes it.
        intensity: the intensities of the training, or None if these are unknown.
        as_is: whether the scans of the training were not normalised. Scans with the same field of
            view then keep the training's rows, however many points lie outside it.
    """

    view: RangeViewConfig = field(default_factory=RangeViewConfig)
    sensor: Sensor = field(default_factory=Sensor)
    intensity: TrainedIntensity | None = None
    as_is: bool = False

    @classmethod
    def of_sensor(cls, name: str) -> Expectation:
        """Return what networks expect that will be trained for a sensor."""
        quantiles = SIMULATED_QUANTILES.get(name)
        intensity = None if quantiles is None else TrainedIntensity(quantiles)
        return cls(sensor=trained_sensor(name, SensorGeometry()), intensity=intensity)

    @property
    def lasers(self) -> SensorGeometry:
        """The geometry of the sensor that the weights were trained for."""
        return SensorGeometry().override(self.sensor)

    def prepare(self, scan: Scan) -> Scan:
        """Return a scan of N points as the networks take it, with the points in the same order.

        Missing intensities are filled in. Rings that do not ascend with the elevations are put in
        order or left out. A warning says so.
        If the rows of the range image are lasers, the lasers of a scan without rings are recovered
        from the order of its points. A few intensities outside [0, 1] are clipped. If the training
        matched the intensities of each scan to a distribution, so does this.

        Raises:
            InputError: if more than a few intensities are out of range.
        """
        scan, missing = fill_intensity(scan, self.intensity)
        if missing:
            warnings.warn(f"the scan has {missing}", stacklevel=2)
        if self.view.rows != "elevation" and scan.row is None:  # else the rows are known
            scan, fault = order_rings(scan)
            if fault:
                warnings.warn(f"the scan has {fault}", stacklevel=2)
        if self.view.rows == "laser" and scan.ring is None:
            ring = lasers_by_order(scan.points, self.view.height)
            scan = dataclasses.replace(scan, ring=ring)
        trained = self.intensity
        if trained is None or trained.are_fractions:
            scan = check_intensity(scan)
        return match_scan(scan, trained.quantiles) if trained and trained.is_matched else scan

    def to_dict(self) -> dict[str, Any]:
        """Return all but the view, which files hold with the sizes of the networks, for JSON."""
        return {
            "sensor": {key: getattr(self.sensor, key) for key in ("name", *MEASURES)},
            "intensity": None if self.intensity is None else to_dict(self.intensity),
            "as_is": self.as_is,
        }

    @classmethod
    def from_dict(cls, values: Any, view: RangeViewConfig) -> Expectation:
        """Return the expectation that a file holds as `to_dict` returned it.

        Raises:
            InputError: if a value is missing or impossible.
        """
        try:
            sensor = Sensor(**values["sensor"])
            intensity = values["intensity"]
            flags = [values["as_is"]]
            if intensity is not None:
                flags += [intensity["is_optional"], intensity["is_matched"]]
                intensity = TrainedIntensity(tuple(intensity["quantiles"]), *flags[1:])
            if not all(type(flag) is bool for flag in flags):
                raise TypeError
        except (TypeError, KeyError):
            raise InputError(
                "expected what the networks expect of a scan (sensor, intensity, as_is), found "
                f"{shown(values)}; train or export again"
            ) from None
        check_text("name", sensor.name)
        return cls(view, sensor, intensity, values["as_is"])


def trained_sensor(name: str, measured: SensorGeometry) -> Sensor:
    """Return the sensor of a training: what was measured of it, else what its data sheet says.

    It has the name of the data sheet only if the number of its lasers is that of the sheet, or the
    name `ANY` if the training has shown sensors of all kinds.
    """
    sheet = Sensor(name=name) if name == ANY else KNOWN_SENSORS.get(name, Sensor())
    height = KNOWN_HEIGHTS.get(name)
    sensor = dataclasses.replace(sheet, height=height)

    measures = measured.known()
    if measures and not measured.has_ends_of(SensorGeometry().override(sheet)):
        measures.setdefault("beams", None)  # it is not the sensor of the data sheet
    with suppress(InputError):  # of scans that show no possible sensor
        sensor = dataclasses.replace(sensor, **measures)
    if name == ANY or sensor.beams == sheet.beams:
        return sensor
    return dataclasses.replace(sensor, name="")
