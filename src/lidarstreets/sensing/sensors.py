"""Define the LiDARs that can be simulated; sensors.toml has the numbers of each."""

from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from lidarstreets.errors import SimulationError
from lidarstreets.tables import read_table

ANY = "any"  # stands for a sensor that is drawn for each scan
# Largest difference between the numbers of a device and of its type, in standard deviations.
MAX_DEVIATIONS = 2.5


@dataclass(frozen=True)
class LidarModel:
    """The numbers that describe one LiDAR and the car that carries it."""

    # Elevation of each laser in degrees, from the top down; the points are written in this order.
    elevations: tuple[float, ...]
    # Number of shots of each laser per rotation.
    azimuth_steps: int
    # Height above the ground in metres.
    height: float
    # Name of the type, a key of `LIDAR_MODELS`, or of the description that it is from.
    name: str = ""
    # Ends of the field of view by the data sheet, degrees; by default the outermost lasers.
    fov: tuple[float, float] | None = None
    # Smallest and largest range that the device measures, in metres.
    min_range: float = 0.5
    max_range: float = 100.0
    # Standard deviation of the range in metres.
    range_noise: float = 0.01
    # Each laser has a constant error of its range: standard deviation between lasers, in metres.
    range_error: float = 0.01
    # Range in metres at which half of the returns are lost, for a white surface hit head-on.
    reach: float = 230.0
    # Share of the returns at a depth edge that lie between the two surfaces, 0 to 1.
    mixed: float = 0.045
    # A near surface hit head-on has the intensity `gain * reflectivity ** gamma`, rounded to
    # `decimals` decimals.
    gain: float = 1.0
    gamma: float = 1.0
    decimals: int = 2
    # Spread of the gains between lasers: scale of a Student's t distribution with three degrees
    # of freedom.
    gain_spread: float = 0.1
    # Power at which the device reports half of the reflectivity. A white surface hit head-on at
    # 10 m returns the power 1.
    half_power: float = 0.002
    # Seconds per rotation; the sensor looks ahead in the middle of it.
    rotation_period: float = 0.1
    # Whether the rotation is counter-clockwise seen from above.
    counter_clockwise: bool = False
    # Whether a lost return is written as a point within a metre of the sensor.
    keeps_lost_returns: bool = False
    # Layout of the files, a key of `LAYOUTS`.
    layout: str = "semantickitti"
    # What the car and its racks hide: azimuth from and to, elevation from and to, in degrees.
    shadow: tuple[tuple[float, float, float, float], ...] = ()
    # Unit of the azimuth that the device counts in, degrees; 0 if it is too small to matter.
    azimuth_unit: float = 0.0
    # Where the sensor drives, a key of `REGIONS`; "" draws the region of each street.
    region: str = ""
    # Share of the returns that are lost, whatever they hit, 0 to 1.
    drop: float = 0.01
    # Pairs of a rising elevation in degrees and a height in metres: lasers of this elevation look
    # out at this height over the origin of the coordinates.
    origins: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    # Range in metres at which the device reports half of the reflectivity, whatever the power.
    half_range: float = np.inf
    # Pairs of a rising range in metres and the factor on the brightness of returns at this range.
    response: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    # Brightness below which the upper half of the lasers reports most returns with the intensity 0;
    # 0 is no such limit.
    least_brightness: float = 0.0
    # Mean share of the brightness of near surfaces that the upper half of the lasers loses, because
    # these lasers are focused far away; 0 to 1.
    near_loss: float = 0.0
    # Surfaces that differ from `REFLECTIONS` where this device drove: the name of each, and factors
    # on its reflectivity, the spread of its intensities, its shade and its roughness.
    surfaces: tuple[tuple[str, float, float, float, float], ...] = ()
    # Depth of the car's roof below the sensor in metres, if the shots that the car blocks return
    # from the roof; 0 if they do not return.
    roof: float = 0.0
    # Mean number of returns of a scan that come from the racks and the roof of the car itself.
    own_returns: float = 0.0
    # Factor on the noise of the intensity, `Reflection.spread`.
    intensity_noise: float = 1.0
    # Whether the motion of the sensor during a rotation is removed from the points.
    motion_corrected: bool = True
    # Angles in degrees between the device and the car: nose up, and left side up.
    pitch: float = 0.0
    roll: float = 0.0
    # The other numbers differ between drives. Standard deviation of the height in metres:
    height_spread: float = 0.0
    # Standard deviation of `pitch` and of `roll` in degrees.
    mounting_spread: float = 0.6
    # Standard deviation of the offset that the elevations of all lasers share, in degrees.
    elevation_spread: float = 0.15
    # Standard deviation of the elevation of each laser, in degrees.
    laser_spread: float = 0.04
    # Standard deviation of the logarithms of `range_noise`, `range_error`, `drop` and
    # `gain_spread`. For `gain`, which makers calibrate, it is multiplied by 0.08.
    response_spread: float = 0.35

    @property
    def ends(self) -> tuple[float, float]:
        """The upper and the lower end of the field of view by the data sheet, degrees."""
        return self.fov or (self.elevations[0], self.elevations[-1])

    def at_height(self, height: float) -> "LidarModel":
        """Return the same LiDAR at a height over the ground in metres, the same on each drive."""
        return replace(self, height=height, height_spread=0.0)


def evenly_spaced(lasers: int, top: float, bottom: float) -> tuple[float, ...]:
    """Return the elevations of lasers that are evenly spaced between two ends, degrees."""
    return tuple(np.linspace(top, bottom, lasers).round(6).tolist())


def _model(name: str, row: dict[str, Any]) -> LidarModel:
    """Return a LiDAR of the table; `lasers` are runs of evenly spaced lasers."""
    runs = row.pop("lasers", ())
    if runs:
        row["elevations"] = tuple(chain.from_iterable(evenly_spaced(*run) for run in runs))
    return LidarModel(name=name, **row)


_TABLE = read_table(Path(__file__).with_suffix(".toml"))
LIDAR_MODELS = {name: _model(name, row) for name, row in _TABLE.items()}


def sensor_of(name: LidarModel | str) -> LidarModel:
    """Return the LiDAR with a name, or the LiDAR that is given instead of a name.

    Raises:
        SimulationError: if `LIDAR_MODELS` has no such name.
    """
    if isinstance(name, LidarModel):
        return name
    if name not in LIDAR_MODELS:
        names = ", ".join(LIDAR_MODELS)
        raise SimulationError(
            f"sensor: expected one of {names}, found {name!r}; choose one of them"
        )
    return LIDAR_MODELS[name]


def draw_device(sensor: LidarModel, rng: np.random.Generator) -> LidarModel:
    """Draw one device of a type of LiDAR, mounted on one car.

    The numbers of the device differ from the numbers of its type by at most `MAX_DEVIATIONS`
    standard deviations. If all spreads of a type are 0, its devices equal the type.
    """

    def draw() -> float:
        return float(np.clip(rng.standard_normal(), -MAX_DEVIATIONS, MAX_DEVIATIONS))

    offset = sensor.elevation_spread * draw()
    deviations = rng.standard_normal(len(sensor.elevations))
    deviations = np.clip(deviations, -MAX_DEVIATIONS, MAX_DEVIATIONS)
    elevations = np.array(sensor.elevations) + offset + sensor.laser_spread * deviations

    return replace(
        sensor,
        elevations=tuple(np.sort(elevations)[::-1].tolist()),  # neighbours may change places
        height=sensor.height + sensor.height_spread * draw(),
        pitch=sensor.pitch + sensor.mounting_spread * draw(),
        roll=sensor.roll + sensor.mounting_spread * draw(),
        range_noise=sensor.range_noise * float(np.exp(sensor.response_spread * draw())),
        drop=sensor.drop * float(np.exp(sensor.response_spread * draw())),
        gain=sensor.gain * float(np.exp(0.08 * sensor.response_spread * draw())),
        gain_spread=sensor.gain_spread * float(np.exp(sensor.response_spread * draw())),
        range_error=sensor.range_error * float(np.exp(sensor.response_spread * draw())),
    )
