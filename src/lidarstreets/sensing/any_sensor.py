"""Draw a LiDAR that no maker sells, so that networks learn from sensors of all kinds."""

from dataclasses import replace

import numpy as np

from lidarstreets.chance import weighted_choice
from lidarstreets.sensing.sensors import ANY, LIDAR_MODELS, LidarModel

# Shares of the numbers of lasers.
LASERS = {16: 0.22, 24: 0.03, 32: 0.25, 40: 0.08, 48: 0.04, 64: 0.22, 96: 0.04, 128: 0.12}
MAX_SHOTS = 180_000  # largest number of shots of a rotation
STEPS = (600, 2200)  # fewest and most shots of a laser per rotation
# Shares of the kinds of fields of view, each with the ranges of its upper and lower end in degrees.
VIEWS = {
    "symmetric": ((10, 24), (-24, -10)),
    "wide": ((25, 45), (-45, -25)),
    "road": ((2, 16), (-32, -15)),
}
VIEW_SHARES = {"symmetric": 0.35, "wide": 0.2, "road": 0.45}
# Shares of the ranges of heights over the ground, metres: a robot, a car, a van or a truck.
HEIGHTS = {(0.3, 1.2): 0.4, (1.2, 2.1): 0.45, (2.1, 2.6): 0.15}
# Chance that the lasers are closer together at the horizon, and the range of the exponent.
DENSE_SHARE = 0.35
DENSITY = (1.3, 2.6)
TILT = 1.2  # standard deviation of the pitch and of the roll, degrees
# Shares of what the sensor sees of the vehicle that carries it: nothing, its body, or one sector.
BODIES = {"none": 0.4, "hdl64e": 0.2, "hdl32e": 0.15, "sector": 0.25}


def draw_sensor(rng: np.random.Generator) -> LidarModel:
    """Draw the lasers, the mounting, the noise and the intensities of a LiDAR.

    Its scans have the layout of SemanticKITTI, and no region is its own.
    """
    lasers = weighted_choice(rng, LASERS)
    steps = int(np.exp(rng.uniform(*np.log(STEPS))))
    model = LidarModel(
        name=ANY,
        elevations=_draw_elevations(rng, lasers),
        azimuth_steps=min(steps, MAX_SHOTS // lasers),
        height=float(rng.uniform(*weighted_choice(rng, HEIGHTS))),
        min_range=float(rng.uniform(0.3, 1.3)),
        max_range=float(rng.uniform(60, 200)),
        range_noise=_spread_evenly(rng, 0.003, 0.03),
        range_error=_spread_evenly(rng, 0.003, 0.04),
        reach=_spread_evenly(rng, 120, 560),
        mixed=float(rng.uniform(0.0, 0.08)),
        drop=_spread_evenly(rng, 0.001, 0.08),
        counter_clockwise=bool(rng.random() < 0.5),
        motion_corrected=bool(rng.random() < 0.8),
        pitch=float(rng.normal(scale=TILT)),
        roll=float(rng.normal(scale=TILT)),
        elevation_spread=0.0,
        mounting_spread=0.0,
    )
    return _with_body(_with_intensity(model, rng), rng)


def _draw_elevations(rng: np.random.Generator, lasers: int) -> tuple[float, ...]:
    """Draw elevations in degrees, from the top down, evenly spaced or dense at the horizon."""
    top_range, bottom_range = VIEWS[weighted_choice(rng, VIEW_SHARES)]
    top = rng.uniform(*top_range)
    bottom = rng.uniform(*bottom_range)
    if rng.random() >= DENSE_SHARE:
        return tuple(np.linspace(top, bottom, lasers).tolist())

    # A power of the distance from the horizon brings the lasers near it closer together.
    power = rng.uniform(*DENSITY)
    above = top ** (1 / power)
    below = (-bottom) ** (1 / power)
    places = np.linspace(above, -below, lasers)
    return tuple((np.sign(places) * np.abs(places) ** power).tolist())


def _with_intensity(model: LidarModel, rng: np.random.Generator) -> LidarModel:
    """Return the LiDAR with calibrated, raw or coarse intensities."""
    kind = weighted_choice(rng, {"calibrated": 0.4, "raw": 0.35, "coarse": 0.25})
    return replace(
        model,
        gain=float(rng.uniform(0.7, 1.0)),
        gamma=float(rng.uniform(0.8, 1.2) if kind == "calibrated" else rng.uniform(0.6, 2.6)),
        decimals=1 if kind == "coarse" else int(rng.integers(2, 4)),
        gain_spread=float(rng.uniform(0.02, 0.06) if kind == "calibrated" else rng.uniform(0, 0.2)),
        half_power=_spread_evenly(rng, 0.001, 0.05 if kind == "raw" else 0.004),
        half_range=float(rng.uniform(30, 90)) if rng.random() < 0.5 else np.inf,
        near_loss=float(rng.uniform(0, 0.3)) if kind == "raw" else 0.0,
        intensity_noise=float(rng.uniform(0.5, 1.3)),
    )


def _with_body(model: LidarModel, rng: np.random.Generator) -> LidarModel:
    """Return the LiDAR with the shadow of the vehicle that carries it, if it sees the vehicle."""
    kind = weighted_choice(rng, BODIES)
    if kind == "none":
        return model
    if kind != "sector":
        known = LIDAR_MODELS[kind]
        return replace(model, shadow=known.shadow, own_returns=known.own_returns)

    start = float(rng.uniform(0, 360))
    width = float(rng.uniform(20, 120))
    highest = float(rng.uniform(-20, 5))
    return replace(model, shadow=((start, start + width, -90.0, highest),))


def _spread_evenly(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is evenly distributed between those of two limits."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
