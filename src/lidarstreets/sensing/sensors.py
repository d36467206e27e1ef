"""The LiDARs that can be simulated, each a table of numbers."""

from dataclasses import dataclass, replace

import numpy as np

from lidarstreets.errors import SimulationError

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
    # Range in metres at which the device reports half of the reflectivity, whatever the power.
    half_range: float = np.inf
    # Ranges in metres, rising, and the factors on the brightness of returns at these ranges.
    response: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    # Brightness below which most returns have the intensity 0; 0 if there is no such limit.
    least_brightness: float = 0.0
    # Mean share of the brightness of near surfaces that the upper half of the lasers loses: they
    # are focused far away.
    near_loss: float = 0.0
    # Mean number of returns from the racks and the roof of the car itself.
    own_returns: float = 0.0
    # True if the motion of the sensor during a rotation is removed from the points.
    motion_corrected: bool = True
    # Angles in degrees between the device and the car: nose up, and left side up.
    pitch: float = 0.0
    roll: float = 0.0
    # How much these numbers differ between drives: standard deviations of the height in metres, of
    # the mounting angles in degrees, of the elevations of all lasers together and of each laser in
    # degrees, and of the logarithms of `range_noise`, `drop` and `gain_spread`; `gain` varies
    # by a quarter of it.
    height_spread: float = 0.0
    mounting_spread: float = 0.6
    elevation_spread: float = 0.15
    laser_spread: float = 0.04
    response_spread: float = 0.35


# Degrees, from the top down: medians over the points of KITTI's scans, laser by laser.
_HDL64E_ELEVATIONS = (
    2.59, 2.20, 1.96, 1.51, 1.22, 0.81, 0.54, 0.17, -0.18, -0.59, -0.89,
    -1.23, -1.58, -1.89, -2.17, -2.52, -2.84, -3.25, -3.51, -3.92, -4.22, -4.56,
    -4.89, -5.18, -5.54, -5.85, -6.14, -6.41, -6.77, -7.14, -7.38, -7.76, -8.38,
    -8.90, -9.35, -9.74, -10.20, -10.80, -11.30, -11.72, -12.17, -12.60, -13.12, -13.64,
    -14.21, -14.64, -15.14, -15.51, -16.13, -16.66, -17.21, -17.67, -18.16, -18.58, -19.01,
    -19.58, -20.07, -20.71, -21.17, -21.59, -22.01, -22.67, -23.13, -23.64,
)  # fmt: skip

_HDL64E_SHADOW = (
    (-14, 14, -90, -20.9), (-22, 22, -90, -21.9), (28, 32, -90, -22.9), (132, 142, -90, -19.7),
    (159, 167, -90, -13.0), (196, 206, -90, -13.0), (160, 208, -90, -18.1),
    (140, 224, -90, -22.4), (230, 240, -90, -19.7), (284, 304, -22.4, -15.8),
    (328, 332, -90, -21.9), (336, 340, -90, -21.9),
)  # fmt: skip

# The shadow is of KITTI's car.
HDL64E = LidarModel(
    elevations=_HDL64E_ELEVATIONS,
    azimuth_steps=2180,
    height=1.73,
    min_range=1.3,
    max_range=80.0,
    range_noise=0.0085,
    reach=560.0,
    mixed=0.06,
    gain=1.0,
    gamma=1.0,
    decimals=2,
    gain_spread=0.12,
    half_power=0.0038,
    rotation_period=0.1,
    counter_clockwise=True,
    keeps_lost_returns=False,
    layout="semantickitti",
    height_spread=0.06,
    shadow=_HDL64E_SHADOW,
    half_range=44.0,
    least_brightness=0.14,
    near_loss=0.2,
    own_returns=27.0,
)

_HDL32E_SHADOW = (
    (-50, 50, -90, -23.5), (-52, 55, -90, -26), (-50, 62, -90, -27.5), (-60, 85, -90, -29),
    (-80, 90, -90, -30), (120, 230, -90, -30), (125, 230, -90, -29), (132, 222, -90, -27.5),
    (137, 220, -90, -26), (146, 213, -90, -23.5), (150, 205, -90, -22), (160, 195, -90, -21),
    (170, 190, -90, -18),
)  # fmt: skip

# The lasers are evenly spaced. Noise, intensity and shadow are as in nuScenes, whose scans have a
# point for every shot.
HDL32E = LidarModel(
    elevations=tuple(10.67 - i * 4 / 3 for i in range(32)),
    azimuth_steps=1084,
    height=1.84,
    min_range=1.0,
    max_range=100.0,
    range_noise=0.005,
    reach=230.0,
    mixed=0.05,
    gain=0.85,
    gamma=2.6,
    decimals=3,
    gain_spread=0.05,
    half_power=0.002,
    rotation_period=0.05,
    counter_clockwise=False,
    keeps_lost_returns=True,
    layout="nuscenes",
    height_spread=0.10,
    response=((3.5, 1.08), (7, 1.1), (12, 0.84), (19, 0.79), (31, 0.97), (52, 1.14)),
    shadow=_HDL32E_SHADOW,
)

SENSORS: dict[str, LidarModel] = {"hdl64e": HDL64E, "hdl32e": HDL32E}


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
    # From the top down, as neighbours may have changed places.
    ordered = np.sort(elevations)[::-1]

    return replace(
        sensor,
        elevations=tuple(ordered.tolist()),
        height=sensor.height + sensor.height_spread * draw(),
        pitch=sensor.pitch + sensor.mounting_spread * draw(),
        roll=sensor.roll + sensor.mounting_spread * draw(),
        range_noise=sensor.range_noise * float(np.exp(sensor.response_spread * draw())),
        drop=sensor.drop * float(np.exp(sensor.response_spread * draw())),
        gain=sensor.gain * float(np.exp(0.25 * sensor.response_spread * draw())),
        gain_spread=sensor.gain_spread * float(np.exp(sensor.response_spread * draw())),
    )
