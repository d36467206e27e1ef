"""Read scans for people to look at: turned level, and otherwise as they are."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

from amvnet.data.formats.cloud import Cloud
from amvnet.progress import Say, say_nothing
from amvnet.scan import Scan
from amvnet.sensors.lidars import Sensor


class PlainAdapter:
    """Turns the contents of scan files into scans without any weights to adapt them to.

    Args:
        sensor: what is known of the sensor; its unit, axes, rotation, offset and scale of intensity
            count.
        say: is told once for each recording what was assumed.
    """

    def __init__(self, sensor: Sensor | None = None, say: Say = say_nothing) -> None:
        self.sensor = sensor or Sensor()
        self._say = say
        self._reported: set[str] = set()

    def __call__(self, cloud: Cloud, source: str) -> Scan:
        """Return the scan, level; its points keep their order and number.

        Args:
            source: name of the bag or folder that the scan is from.

        Raises:
            InputError: if no point is usable.
        """
        xyz = self.sensor.to_level(cloud.xyz)
        scale = self.sensor.intensity_scale or cloud.intensity_scale()
        scan = dataclasses.replace(cloud, xyz=xyz).to_scan(scale)

        if source not in self._reported:
            self._reported.add(source)
            self._say(f"{cloud.name}: assumed {self._describe(cloud, scale)}")
        return scan

    def for_sensor(self, sensor: Sensor) -> PlainAdapter:
        """Return an adapter for scans of a described sensor."""
        return PlainAdapter(sensor, self._say)

    def learn(self, source: str, first: Sequence[Callable[[], Cloud]]) -> None:
        """Do nothing: no scan depends on others."""

    def _describe(self, cloud: Cloud, scale: float | None) -> str:
        intensity = "no intensity"
        if cloud.intensity is not None and scale is not None:
            intensity = f"intensity 0 to {scale:g}"
        assumed = [cloud.note] if cloud.note else []
        assumed += [intensity, f"axes {self.sensor.axes or 'x-forward'}"]
        return ", ".join(assumed)
