"""The LiDARs that can be simulated, each a table of numbers."""

from __future__ import annotations

from dataclasses import dataclass

from amvnet.sensors.lidars import HEIGHTS


@dataclass(frozen=True)
class Sensor:
    """A LiDAR as a table of numbers."""

    # Elevation of each laser in degrees, from the top down: the order in which points are written.
    elevations: tuple[float, ...]
    # Shots of each laser per turn.
    azimuth_steps: int
    # Height above the ground in metres.
    height: float
    # Nearest and farthest range that is measured, in metres.
    min_range: float
    max_range: float
    # Standard deviation of the range in metres.
    range_noise: float
    # Share of the returns that are lost whatever they hit.
    drop: float
    # Range in metres at which half the returns of a white, head-on surface are lost.
    reach: float
    # Share of the returns at an edge in depth that lie somewhere between the two surfaces.
    mixed: float
    # Near and head-on, the device reports an intensity of gain * reflectivity ** gamma, with so many decimals.
    gain: float
    gamma: float
    decimals: int
    # How much the lasers' gains differ, of reflectivity: scale of Student's t with three degrees of freedom.
    gain_spread: float
    # Seconds that a turn takes, at whose middle the sensor looks ahead; counter-clockwise seen from above, or not.
    turn: float
    counter_clockwise: bool
    # True where the files hold points as if the sensor had stood still.
    corrected: bool
    # True where a lost return is written all the same, somewhere within a metre of the sensor.
    keeps_lost: bool
    # The layout that its scans are written in: semantickitti or nuscenes.
    layout: str
    # What the own car and its racks hide: azimuth from and to, elevation from and to, in degrees.
    shadow: tuple[tuple[float, float, float, float], ...]


# Degrees, from the top down: medians over points of KITTI's scans, laser by laser.
_HDL64E_ELEVATIONS = (
    2.59, 2.20, 1.96, 1.51, 1.22, 0.81, 0.54, 0.17, -0.18, -0.59, -0.89,
    -1.23, -1.58, -1.89, -2.17, -2.52, -2.84, -3.25, -3.51, -3.92, -4.22, -4.56,
    -4.89, -5.18, -5.54, -5.85, -6.14, -6.41, -6.77, -7.14, -7.38, -7.76, -8.38,
    -8.90, -9.35, -9.74, -10.20, -10.80, -11.30, -11.72, -12.17, -12.60, -13.12, -13.64,
    -14.21, -14.64, -15.14, -15.51, -16.13, -16.66, -17.21, -17.67, -18.16, -18.58, -19.01,
    -19.58, -20.07, -20.71, -21.17, -21.59, -22.01, -22.67, -23.13, -23.64,
)  # fmt: skip
# The shadow is what the car of KITTI hides.
HDL64E = Sensor(
    elevations=_HDL64E_ELEVATIONS,
    azimuth_steps=2180,
    height=HEIGHTS["hdl64e"],
    min_range=1.5,
    max_range=80.0,
    range_noise=0.0085,
    drop=0.01,
    reach=560.0,
    mixed=0.06,
    gain=1.0,
    gamma=1.0,
    decimals=2,
    gain_spread=0.12,
    turn=0.1,
    counter_clockwise=True,
    corrected=True,
    keeps_lost=False,
    layout="semantickitti",
    shadow=(
        (-14, 14, -90, -20.9),
        (-22, 22, -90, -21.9),
        (28, 32, -90, -22.9),
        (132, 142, -90, -19.7),
        (159, 167, -90, -13.0),
        (196, 206, -90, -13.0),
        (160, 208, -90, -18.1),
        (140, 224, -90, -22.4),
        (230, 240, -90, -19.7),
        (284, 304, -22.4, -15.8),
        (328, 332, -90, -21.9),
        (336, 340, -90, -21.9),
    ),
)
# Evenly spaced; noise, intensity and shadow as in nuScenes, whose scans have a row for every shot.
HDL32E = Sensor(
    elevations=tuple(10.67 - i * 4 / 3 for i in range(32)),
    azimuth_steps=1084,
    height=HEIGHTS["hdl32e"],
    min_range=1.0,
    max_range=100.0,
    range_noise=0.005,
    drop=0.01,
    reach=230.0,
    mixed=0.05,
    gain=0.85,
    gamma=2.6,
    decimals=3,
    gain_spread=0.05,
    turn=0.05,
    counter_clockwise=False,
    corrected=True,
    keeps_lost=True,
    layout="nuscenes",
    shadow=(
        (-50, 50, -90, -23.5),
        (-52, 55, -90, -26),
        (-50, 62, -90, -27.5),
        (-60, 85, -90, -29),
        (-80, 90, -90, -30),
        (120, 230, -90, -30),
        (125, 230, -90, -29),
        (132, 222, -90, -27.5),
        (137, 220, -90, -26),
        (146, 213, -90, -23.5),
        (150, 205, -90, -22),
        (160, 195, -90, -21),
        (170, 190, -90, -18),
    ),
)
SENSORS: dict[str, Sensor] = {"hdl64e": HDL64E, "hdl32e": HDL32E}
