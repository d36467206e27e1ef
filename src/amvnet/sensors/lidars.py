"""Describe LiDARs, by name or in a YAML file: lasers, field of view, mounting, units and axes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amvnet.errors import InputError, did_you_mean, errors_of, shown
from lidarstreets import ANY as ANY
from lidarstreets import LIDAR_MODELS, LidarModel, evenly_spaced

# Heights of the sensors over the ground on the cars that recorded KITTI and nuScenes, metres.
# Scans of any sensor are moved to the height of KITTI's.
KNOWN_HEIGHTS = {"hdl64e": 1.73, "hdl32e": 1.84, ANY: 1.73}

# The cars' own bodies in the frame of their scans: the lowest and the highest x, y, z, metres.
# KITTI's scans hardly have a point of its car.
KNOWN_BODIES = {"hdl32e": (-0.71, -1.18, -0.93, 0.71, 2.07, 0.01)}

# The sensors that the built-in weights are trained for, by the name of the weights. The last
# weights also label the scans of any other sensor.
BUILT_IN = {"sim-hdl32e": "hdl32e", "sim-hdl64e": "hdl64e", "sim-any": ANY}
AUTO = "auto"  # stands for the name of the built-in weights that suit the lasers

# Rotations that turn a file's x, y, z into forward, left, up, by the name of the file's axes.
AXES = {
    "x-forward": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),  # x forward, y left, z up: ROS, KITTI
    "y-forward": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),  # x right, y forward, z up: nuScenes
    "z-forward": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),  # x right, y down, z forward: cameras
    "z-down": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),  # x forward, y right, z down: aircraft
    "y-up": ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),  # x right, y up, z backward: computer graphics
}
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}  # length of each unit, metres
Triple = tuple[float, float, float]
Box = tuple[float, float, float, float, float, float]
# Beginnings of the names of a maker's LiDARs.
MAKER_PREFIXES = {
    "velodyne": ("hdl", "vlp", "vls"),
    "ouster": ("os",),
    "hesai": ("pandar", "ot", "qt", "xt"),
    "robosense": ("rs", "ruby", "helios"),
}
MAX_LASERS = 256  # largest number of lasers that are simulated
USUAL_SHOTS = 1800  # number of shots of a laser in a rotation, if nothing says otherwise
KEYS_OF_DATA = ("classes", "scans", "root")  # tell a description of data from one of a sensor
MAX_NUMBER = 1e9  # largest number in the description of a sensor


@dataclass(frozen=True)
class Sensor:
    """What is known about a LiDAR and the frame of its scans. A value of None will be measured.

    Attributes:
        name: the name of the sensor; messages state it.
        fov_up, fov_down: ends of the field of view, degrees above the horizon.
        height: height over the ground, metres.
        intensity_scale: the largest possible intensity.
        unit: the unit of the coordinates, a name in `UNITS`.
        axes: the directions of the axes, a name in `AXES`.
        rotate: yaw, pitch and roll, degrees. Applied after `axes`, they turn the scan level and +x
            forward.
        offset: x, y and z, metres. Added after `rotate`, they bring the sensor to the origin.
        own_body: the lowest x, y, z and the highest x, y, z of the car's own body in the file's
            axes, metres. Its points get no label.
        keep_own: whether the points of the car's own body get labels as others do.

    Raises:
        InputError: if a value is impossible.
    """

    name: str = ""
    beams: int | None = None
    fov_up: float | None = None
    fov_down: float | None = None
    height: float | None = None
    intensity_scale: float | None = None
    unit: str | None = None
    axes: str | None = None
    rotate: Triple | None = None
    offset: Triple | None = None
    own_body: Box | None = None
    keep_own: bool = False

    def __post_init__(self) -> None:
        top = self.fov_up if isinstance(self.fov_up, int | float) else 90
        is_whole = self.beams is None or type(self.beams) is int
        is_below = _is_within(self.fov_down, -90, top) and self.fov_down != top

        self._check("name", isinstance(self.name, str), "a text")
        is_count = is_whole and _is_within(self.beams, 1, MAX_NUMBER)
        self._check("beams", is_count, "a whole number")
        self._check("fov_up", _is_within(self.fov_up, -90, 90), "degrees from -90 to 90")
        self._check("fov_down", is_below, "degrees from -90 to 90, below fov_up")
        self._check("height", _is_within(self.height, 0, 100), "metres from 0 to 100")
        is_scale = _is_within(self.intensity_scale, 0, MAX_NUMBER) and self.intensity_scale != 0
        self._check("intensity_scale", is_scale, "a number above 0")
        self._check("unit", self.unit in (None, *UNITS), f"one of {', '.join(UNITS)}")
        self._check("axes", self.axes in (None, *AXES), f"one of {', '.join(AXES)}")
        self._check("rotate", _are_numbers(self.rotate, 3), "yaw,pitch,roll in degrees, as 90,0,0")
        self._check("offset", _are_numbers(self.offset, 3), "x,y,z in metres, as 0,0,1.2")
        box = self.own_body
        is_box = _are_numbers(box, 6) and (box is None or all(np.less(box[:3], box[3:])))
        corners = "the lowest x,y,z and the highest x,y,z in metres, as -1,-1,-1,1,2,0"
        self._check("own_body", is_box, corners)
        self._check("keep_own", type(self.keep_own) is bool, "true or false")

    def _check(self, key: str, is_valid: bool, expected: str) -> None:
        if not is_valid:
            found = shown(getattr(self, key))
            raise InputError(f"{key}: expected {expected}, found {found}; correct the value")

    @property
    def is_known(self) -> bool:
        """Whether anything is known; `keep_own` is a wish and says nothing of the sensor."""
        return dataclasses.replace(self, keep_own=False) != Sensor()

    @property
    def turn(self) -> NDArray[np.float64]:
        """The (3, 3) rotation from the file's axes to the package's axes: forward, left, up."""
        axes = np.array(AXES[self.axes or "x-forward"], dtype=np.float64)
        return axes if self.rotate is None else rotation_from_degrees(*self.rotate) @ axes

    def to_level(self, xyz: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the points (N, 3) of a file in metres and in the package's axes.

        Unknown values change nothing. If the points are scaled, turned or moved, the result is
        float64, and lost points, which lie at the file's origin, become NaN.
        """
        scale = UNITS[self.unit or "m"]
        turn = self.turn
        offset = np.array(self.offset or (0.0, 0.0, 0.0))
        if scale == 1 and not offset.any() and np.array_equal(turn, np.eye(3)):
            return xyz

        # Numbers that become too large turn infinite, which makes their points invalid.
        with np.errstate(over="ignore", invalid="ignore"):
            level: NDArray[np.floating] = xyz.astype(np.float64) * scale @ turn.T + offset
        level[(xyz == 0).all(axis=1)] = np.nan
        return level

    def to_file(self, rise: float = 0.0) -> NDArray[np.float64]:
        """Return the motion (4, 4) that undoes `to_level` and then a rise by `rise` metres.

        It moves points into the file's frame, in metres whatever the file's unit is.
        """
        motion = np.eye(4)
        motion[:3, :3] = self.turn.T
        x, y, z = self.offset or (0.0, 0.0, 0.0)
        motion[:3, 3] = -self.turn.T @ (x, y, z + rise)
        return motion


def _is_within(value: Any, low: float, high: float) -> bool:
    return value is None or (isinstance(value, int | float) and low <= value <= high)


def _are_numbers(values: Any, count: int) -> bool:
    """Return whether values are unknown, or so many finite numbers."""
    if values is None:
        return True
    return isinstance(values, tuple) and len(values) == count and all(map(math.isfinite, values))


UNKNOWN_SENSOR = Sensor()


def rotation_from_degrees(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Return the (3, 3) rotation by roll about x, then pitch about y, then yaw about z."""
    angles = np.radians([yaw, pitch, roll])
    cos_yaw, cos_pitch, cos_roll = np.cos(angles)
    sin_yaw, sin_pitch, sin_roll = np.sin(angles)

    about_z = np.array([[cos_yaw, -sin_yaw, 0], [sin_yaw, cos_yaw, 0], [0, 0, 1]])
    about_y = np.array([[cos_pitch, 0, sin_pitch], [0, 1, 0], [-sin_pitch, 0, cos_pitch]])
    about_x = np.array([[1, 0, 0], [0, cos_roll, -sin_roll], [0, sin_roll, cos_roll]])
    rotation: NDArray[np.float64] = about_z @ about_y @ about_x
    return rotation


# The data sheets do not say how a sensor is mounted on a vehicle.
KNOWN_SENSORS = {
    name: Sensor(name, len(model.elevations), *model.ends) for name, model in LIDAR_MODELS.items()
}


def simulated_lidar(sensor: Sensor) -> LidarModel:
    """Return the LiDAR that simulates a sensor.

    A known sensor has the lasers of its data sheet. The lasers of others are evenly spaced. What
    `Sensor` does not say is as usual.

    Raises:
        InputError: if the number of lasers, an end of the field of view or the height is unknown,
            or there are more than `MAX_LASERS` lasers.
    """
    known = LIDAR_MODELS.get(sensor.name)
    if known is not None and dataclasses.replace(sensor, height=None) == KNOWN_SENSORS[known.name]:
        return known if sensor.height is None else known.at_height(sensor.height)

    beams, top, bottom, height = sensor.beams, sensor.fov_up, sensor.fov_down, sensor.height
    if beams is None or top is None or bottom is None or height is None:
        numbers = {"beams": beams, "fov_up": top, "fov_down": bottom, "height": height}
        missing = [key for key, value in numbers.items() if value is None]
        raise InputError(
            f"{sensor.name or 'sensor'}: expected {', '.join(numbers)} to simulate the sensor, "
            f"found no {' and no '.join(missing)}; state {' and '.join(missing)}"
        )
    if beams > MAX_LASERS:
        raise InputError(
            f"{sensor.name}: expected at most {MAX_LASERS} beams to simulate, found {beams}; "
            "correct the number"
        )
    return LidarModel(evenly_spaced(beams, top, bottom), USUAL_SHOTS, height, sensor.name)


def make_sensor(sensor: str | Mapping[Any, Any] | None = None, **options: Any) -> Sensor:
    """Return a sensor with some attributes overridden.

    Args:
        sensor: a name in `KNOWN_SENSORS`; attributes of `Sensor`, in which `name` stands for what
            is known by it; or a YAML file with such attributes. By default the sensor is unknown.
        options: attributes of `Sensor`, which take precedence unless they are None. `rotate`,
            `offset` and `own_body` may be texts of numbers separated by commas.

    Raises:
        InputError: if there is no such sensor, file or attribute, or a value is impossible.
    """
    changes = {key: value for key, value in options.items() if value is not None}
    base = Sensor()
    if isinstance(sensor, Mapping):
        changes = {**sensor, **changes}
        if "name" in sensor:
            base = _read_sensor(str(changes.pop("name")))
    elif sensor is not None:
        base = _read_sensor(str(sensor))

    for key in changes:
        if key not in vars(base):
            raise InputError(
                f"expected one of {', '.join(vars(base))}, found {shown(key)}; correct the key"
            )
    for key in {"rotate", "offset", "own_body"} & set(changes):
        changes[key] = _to_numbers(changes[key])
    return dataclasses.replace(base, **changes)


def _read_sensor(text: str) -> Sensor:
    if text in KNOWN_SENSORS:
        return KNOWN_SENSORS[text]

    path = Path(text)
    if path.suffix not in (".yaml", ".yml"):
        models = _models_of(text)
        if len(models) > 1:
            raise InputError(
                f"expected the model of a LiDAR, found {shown(text)}; name one of "
                f"{', '.join(models)}, or give a YAML file"
            )
        raise InputError(
            f"expected a sensor of {', '.join(KNOWN_SENSORS)} or a YAML file, found {shown(text)}"
            f"{did_you_mean(text, KNOWN_SENSORS, 'give one of them')}"
        )

    from amvnet.config.yaml_files import read_yaml  # here, because onnx_runner needs no PyYAML

    tree = read_yaml(path, "a description of a sensor")
    if not isinstance(tree, Mapping):
        raise InputError(
            f"{path}: expected keys such as beams: 16, found none; see docs/own_sensor.md"
        )
    if of_data := [key for key in KEYS_OF_DATA if key in tree]:
        raise InputError(
            f"{path}: expected a description of a sensor, found one of data "
            f"({', '.join(of_data)}); give it as DATA or INPUT"
        )
    with errors_of(path):
        described = make_sensor(tree)
    return described if described.name else dataclasses.replace(described, name=path.stem)


def _models_of(text: str) -> list[str]:
    """Return the known LiDARs of a maker, or the known LiDARs whose names begin with the text."""
    beginnings = MAKER_PREFIXES.get(text.lower(), (text.lower(),))
    return [name for name in KNOWN_SENSORS if text and name.startswith(beginnings)]


def _to_numbers(value: Any) -> Any:
    """Return the numbers in a list or a text as a tuple; return anything else unchanged."""
    try:
        return tuple(map(float, value.split(",") if isinstance(value, str) else value))
    except (TypeError, ValueError, OverflowError):
        return value
