"""The LiDARs that can be simulated, each a table of numbers."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lidarstreets.errors import SimulationError
from lidarstreets.tables import read_table

# Largest difference between a device and its type, in standard deviations.
MOST_DEVIATIONS = 2.5


@dataclass(frozen=True)
class LidarModel:
    """The numbers that describe one LiDAR and the car that carries it."""

    # Elevation of each laser in degrees, from the top down: points are written in this order.
    elevations: tuple[float, ...]
    # Shots of each laser per rotation.
    azimuth_steps: int
    # Height above the ground in metres.
    height: float
    # Smallest and largest range that is measured, in metres.
    min_range: float
    max_range: float
    # Standard deviation of the range in metres.
    range_noise: float
    # Standard deviation between lasers of the constant error of their range, in metres.
    range_error: float
    # Range in metres at which half of the returns of a white surface hit head-on are lost.
    reach: float
    # Share of the returns at a depth edge that lie between the two surfaces.
    mixed: float
    # A near surface hit head-on has the intensity gain * reflectivity ** gamma, rounded to
    # `decimals`.
    gain: float
    gamma: float
    decimals: int
    # Spread of the gains between lasers: scale of a Student's t distribution with three degrees
    # of freedom.
    gain_spread: float
    # Power at which the device reports half of the reflectivity; 1 is the power of a head-on
    # return from a white surface at 10 m.
    half_power: float
    # Seconds per rotation; the sensor looks ahead in the middle of it.
    rotation_period: float
    # Direction of the rotation, seen from above.
    counter_clockwise: bool
    # True if lost returns are written too, as points within a metre of the sensor.
    keeps_lost_returns: bool
    # Layout of the files: semantickitti or nuscenes.
    layout: str
    # What the car and its racks hide: azimuth from and to, elevation from and to, in degrees.
    shadow: tuple[tuple[float, float, float, float], ...]
    # Share of the returns that are lost, whatever they hit.
    drop: float = 0.01
    # Elevations in degrees, rising, and the heights in metres above the origin of the coordinates
    # from which lasers of these elevations look out.
    origins: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    # Range in metres at which the device reports half of the reflectivity, whatever the power.
    half_range: float = np.inf
    # Ranges in metres, rising, and the factors on the brightness of returns at these ranges.
    response: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    # Brightness below which most returns to the upper half of the lasers have the intensity 0; 0 if
    # there is no such limit.
    least_brightness: float = 0.0
    # Mean share of the brightness of near surfaces that the upper half of the lasers loses: they
    # are focused far away.
    near_loss: float = 0.0
    # Mean number of returns from the racks and the roof of the car itself.
    own_returns: float = 0.0
    # Factor on the noise of the intensity, `Reflection.spread`.
    intensity_noise: float = 1.0
    # True if the motion of the sensor during a rotation is removed from the points.
    motion_corrected: bool = True
    # Angles in degrees between the device and the car: nose up, and left side up.
    pitch: float = 0.0
    roll: float = 0.0
    # How much these numbers differ between drives: standard deviations of the height in metres, of
    # the mounting angles in degrees, of the elevations of all lasers together and of each laser in
    # degrees, and of the logarithms of `range_noise`, `range_error`, `drop` and `gain_spread`;
    # `gain` varies by a twelfth of it, as makers calibrate it.
    height_spread: float = 0.0
    mounting_spread: float = 0.6
    elevation_spread: float = 0.15
    laser_spread: float = 0.04
    response_spread: float = 0.35


_TABLE = read_table(Path(__file__).with_suffix(".toml"))
SENSORS = {name: LidarModel(**row) for name, row in _TABLE.items()}


def sensor_of(name: str) -> LidarModel:
    """Return the sensor of a name.

    Raises:
        SimulationError: if there is none.
    """
    if name not in SENSORS:
        names = ", ".join(SENSORS)
        raise SimulationError(
            f"sensor: expected one of {names}, found {name!r}; choose one of them"
        )
    return SENSORS[name]


def draw_device(sensor: LidarModel, rng: np.random.Generator) -> LidarModel:
    """Return one device of a type of LiDAR as it is mounted on one car.

    Its numbers differ from the type's by at most `MOST_DEVIATIONS` standard deviations. If all
    spreads of a type are 0, its devices are equal to it.
    """

    def draw() -> float:
        return float(np.clip(rng.standard_normal(), -MOST_DEVIATIONS, MOST_DEVIATIONS))

    offset = sensor.elevation_spread * draw()
    deviations = rng.standard_normal(len(sensor.elevations))
    deviations = np.clip(deviations, -MOST_DEVIATIONS, MOST_DEVIATIONS)
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
