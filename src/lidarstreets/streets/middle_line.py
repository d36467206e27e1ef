"""Define the middle line of a street, and the coordinates along and across it."""

import numpy as np

from lidarstreets.streets.styles import Style

TIGHTEST_BEND = 35.0  # smallest radius of a bend, metres
TIGHTEST_FAST_BEND = 300.0  # smallest radius of a bend in a fast street, metres
FAST_STREET = 1.7  # speed factor, `Style.speed`, above which a street is fast


class MiddleLine:
    """The middle line of a street: y = f(x), a sum of W waves.

    The street coordinates of a place are x and t, both in metres. x is the x of the nearest point
    of the line. t is the signed distance from that point: it is positive on the left, seen in the
    direction of travel, +x.

    Args:
        bends: (W, 3) amplitude in metres, wavelength in metres and phase in radians of each wave.
    """

    def __init__(self, bends: np.ndarray) -> None:
        self._bends = bends

    def middle(self, x: np.ndarray | float) -> np.ndarray:
        """Return y of the middle line at x, metres, in the shape of x."""
        y = np.zeros(np.shape(x))
        for amplitude, wavelength, phase in self._bends:
            y = y + amplitude * np.sin(2 * np.pi / wavelength * np.asarray(x) + phase)
        return y

    def yaw(self, x: np.ndarray | float) -> np.ndarray:
        """Return the direction of the middle line at x, radians, in the shape of x."""
        slope = np.zeros(np.shape(x))
        for amplitude, wavelength, phase in self._bends:
            wave = np.cos(2 * np.pi / wavelength * np.asarray(x) + phase)
            slope = slope + amplitude * 2 * np.pi / wavelength * wave
        return np.arctan(slope)

    def pose_at(self, x: float, t: float) -> tuple[float, float, float]:
        """Return (x, y, yaw) of the street at street coordinates x, t, in metres and radians."""
        yaw = float(self.yaw(x))
        return x - t * np.sin(yaw), float(self.middle(x)) + t * np.cos(yaw), yaw

    def street_coordinates(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the street coordinates (x, t) of the places x, y; all arrays have one shape."""
        # Step twice towards the foot of the perpendicular on the middle line.
        foot = x
        for _ in range(2):
            yaw = self.yaw(foot)
            ahead = (x - foot) * np.cos(yaw) + (y - self.middle(foot)) * np.sin(yaw)
            foot = foot + ahead * np.cos(yaw)

        yaw = self.yaw(foot)
        return foot, (y - self.middle(foot)) * np.cos(yaw) - (x - foot) * np.sin(yaw)


def draw_bends(style: Style, rng: np.random.Generator) -> np.ndarray:
    """Draw the two waves of a middle line: (2, 3), as `MiddleLine` takes them."""
    steepness = 0.0 if rng.random() < 0.25 else rng.uniform(0.05, 0.35)
    wavelengths = rng.uniform(180, 500, size=2)
    if style.kind in ("residential", "living", "rural") and rng.random() < 0.4:
        wavelengths[1] = rng.uniform(80, 180)
    largest_curvature = 1 / (TIGHTEST_FAST_BEND if style.speed > FAST_STREET else TIGHTEST_BEND)

    amplitudes = steepness * rng.uniform(0.4, 1.0, size=2) * wavelengths / (2 * np.pi)
    largest = 0.5 * largest_curvature * (wavelengths / (2 * np.pi)) ** 2
    amplitudes = np.minimum(amplitudes, largest)
    phases = rng.uniform(0, 2 * np.pi, size=2)
    return np.column_stack([amplitudes, wavelengths, phases])
