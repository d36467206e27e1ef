"""LiDARs by name or by a YAML file: lasers, field of view, place on the vehicle, units and axes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from amvnet.errors import InputError

# Metres over the ground on the cars of the data sets that weights are trained for: KITTI's and nuScenes'.
HEIGHTS = {"hdl64e": 1.73, "hdl32e": 1.84}

# Rows: what of a file's x, y, z is forward, left and up.
AXES = {
    "x-forward": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),  # x forward, y left, z up: ROS, KITTI
    "y-forward": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),  # x right, y forward, z up: nuScenes
    "z-forward": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),  # x right, y down, z forward: cameras
    "z-down": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),  # x forward, y right, z down: aircraft
}
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Sensor:
    """What is known of a LiDAR and of the frame of its scans; None is not known, and will be measured.

    Attributes:
        name: for messages.
        beams: lasers.
        fov_up, fov_down: ends of the field of view, degrees above the horizon.
        height: metres over the ground.
        intensity_scale: the largest intensity there can be.
        axes: which way the axes point, a name in `AXES`.
        rotate: yaw, pitch and roll in degrees, after the axes: they turn the scan level, forward being +x.
        offset: metres that are added to x, y and z after that.

    Raises:
        InputError: where a value cannot be.
    """

    name: str = ""
    beams: int | None = None
    fov_up: float | None = None
    fov_down: float | None = None
    height: float | None = None
    intensity_scale: float | None = None
    axes: str = "x-forward"
    rotate: Triple = (0.0, 0.0, 0.0)
    offset: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        up, down = self.fov_up, self.fov_down
        checks = {
            "beams": ("a whole number from 1", self.beams is None or self.beams >= 1),
            "fov_up": ("degrees from -90 to 90", up is None or -90 <= up <= 90),
            "fov_down": (
                "degrees from -90 to 90, below fov_up",
                down is None or -90 <= down < (90 if up is None else up),
            ),
            "height": ("metres from 0 to 100", self.height is None or 0 <= self.height <= 100),
            "intensity_scale": (
                "a number above 0",
                self.intensity_scale is None or 0 < self.intensity_scale < math.inf,
            ),
            "axes": (f"one of {', '.join(AXES)}", self.axes in AXES),
            "rotate": ("yaw,pitch,roll in degrees", all(map(math.isfinite, self.rotate))),
            "offset": ("x,y,z in metres", all(map(math.isfinite, self.offset))),
        }
        for key, (expected, holds) in checks.items():
            if not holds:
                raise InputError(
                    f"{key}: expected {expected}, found {getattr(self, key)!r}; correct the value"
                )

    @property
    def level(self) -> bool:
        """Whether the scans are in the frame that the package works in: x forward, y left, z up."""
        return self == dataclasses.replace(
            self, axes="x-forward", rotate=(0.0, 0.0, 0.0), offset=(0.0, 0.0, 0.0)
        )

    def to_level(self, xyz: np.ndarray) -> np.ndarray:
        """(N, 3) points of a file in that frame; float64 where anything has to be done."""
        if self.level:
            return xyz
        turn = rotation(*self.rotate) @ np.array(AXES[self.axes], dtype=np.float64)
        return xyz.astype(np.float64) @ turn.T + np.array(self.offset)


def rotation(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """(3, 3) the rotation by roll about x, then pitch about y, then yaw about z, in degrees."""
    (a, b, c), (d, e, f) = (
        np.cos(np.radians([yaw, pitch, roll])),
        np.sin(np.radians([yaw, pitch, roll])),
    )
    about_z = np.array([[a, -d, 0], [d, a, 0], [0, 0, 1]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    about_x = np.array([[1, 0, 0], [0, c, -f], [0, f, c]])
    return about_z @ about_y @ about_x


def _sensor(name: str, beams: int, up: float, down: float) -> Sensor:
    return Sensor(name, beams, up, down)


# Lasers and fields of view by the makers' data sheets; where a sensor stands on a vehicle no sheet says.
SENSORS: dict[str, Sensor] = {
    sensor.name: sensor
    for sensor in (
        _sensor("hdl64e", 64, 2.6, -24.0),
        _sensor("hdl32e", 32, 10.67, -30.67),
        _sensor("vlp16", 16, 15, -15),
        _sensor("vlp32c", 32, 15, -25),
        _sensor("vls128", 128, 15, -25),
        _sensor("os0-32", 32, 45, -45),
        _sensor("os0-64", 64, 45, -45),
        _sensor("os0-128", 128, 45, -45),
        _sensor("os1-32", 32, 22.5, -22.5),
        _sensor("os1-64", 64, 22.5, -22.5),
        _sensor("os1-128", 128, 22.5, -22.5),
        _sensor("os2-64", 64, 11.25, -11.25),
        _sensor("os2-128", 128, 11.25, -11.25),
        _sensor("pandar40p", 40, 15, -25),
        _sensor("pandar64", 64, 15, -25),
        _sensor("pandar128", 128, 15, -25),
        _sensor("xt32", 32, 15, -16),
        _sensor("rs16", 16, 15, -15),
        _sensor("rs32", 32, 15, -25),
        _sensor("rs128", 128, 15, -25),
    )
}


def make_sensor(sensor: str | None = None, **options: Any) -> Sensor:
    """A sensor by its name or its YAML file, and options that override what it says.

    Args:
        sensor: a name in `SENSORS`, or a YAML file with the attributes of `Sensor`; None knows nothing.
        options: attributes of `Sensor`; None overrides nothing, `rotate` and `offset` may be texts with commas.

    Raises:
        InputError: where there is no such sensor or file, or a value cannot be.
    """
    known = Sensor() if sensor is None else _named(sensor)
    given = {key: value for key, value in options.items() if value is not None}
    return dataclasses.replace(known, **_converted(given, "--"))


def _named(text: str) -> Sensor:
    path = Path(text)
    if text in SENSORS:
        return SENSORS[text]
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(
            f"expected a sensor of {', '.join(SENSORS)} or a YAML file, found {text!r}; give one of them"
        )
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError, RecursionError):
        raise InputError(
            f"{path}: expected a YAML file that describes a sensor, found none; check it"
        ) from None
    if not isinstance(tree, Mapping):
        raise InputError(
            f"{path}: expected keys such as beams: 16, found none; see docs/own_sensor.md"
        )
    try:
        return Sensor(**{"name": path.stem, **_converted(tree, "")})
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _converted(values: Mapping[Any, Any], mark: str) -> dict[str, Any]:
    """The values in the types of their attributes."""
    kinds = {field.name: _kind(field.name) for field in dataclasses.fields(Sensor)}
    found = {}
    for key, value in values.items():
        if key not in kinds:
            raise InputError(f"expected one of {', '.join(kinds)}, found {key!r}; correct the key")
        try:
            found[key] = kinds[key](value)
        except (ValueError, TypeError, OverflowError):
            shown = f"{mark}{key}".replace("_", "-") if mark else key
            raise InputError(
                f"{shown}: expected {_example(key)}, found {value!r}; correct the value"
            ) from None
    return found


def _kind(key: str) -> Any:
    return {"name": str, "axes": str, "beams": _whole, "rotate": _triple, "offset": _triple}.get(
        key, float
    )


def _example(key: str) -> str:
    return {"rotate": "yaw,pitch,roll such as 90,0,0", "offset": "x,y,z such as 0,0,1.2"}.get(
        key, "a number"
    )


def _whole(value: Any) -> int:
    if int(value) != value:
        raise ValueError
    return int(value)


def _triple(value: Any) -> Triple:
    a, b, c = map(float, value.split(",") if isinstance(value, str) else value)
    return a, b, c
