"""Draw the relief of the land that a street lies in."""

import numpy as np
from numpy.typing import NDArray

from lidarstreets.streets.styles import Style

FARTHEST_RISE = 30.0  # distance behind the pavement beyond which the land no longer rises, metres
STEEPEST = 0.12  # largest mean slope along and across a street, rise over run


class Relief:
    """The hills, banks and bumps of the land; methods take and return arrays of one shape."""

    def __init__(self, style: Style, rng: np.random.Generator) -> None:
        self._banks = style.bank
        slopes = rng.normal(scale=0.03, size=2) if rng.random() < 0.6 else np.zeros(2)
        slopes = slopes * style.region.slopes
        self._slope = np.clip(slopes * np.array([1.0, 0.4]), -STEEPEST, STEEPEST)

        # The hills are three waves, from long to short.
        wavelengths = np.array([rng.uniform(200, 400), rng.uniform(80, 160), rng.uniform(25, 60)])
        amplitudes = np.array([1.2, 0.4, 0.07]) * rng.uniform(0.1, 1.4, size=3)
        direction = rng.uniform(0, np.pi, size=3)
        self._hills = _stack_waves(amplitudes, wavelengths, direction, direction * 5)

        # The bumps are six waves, from 14 m to 1.3 m long.
        count = 6
        wavelengths = np.geomspace(14, 1.3, count) * rng.uniform(0.8, 1.2, size=count)
        amplitudes = rng.lognormal(np.log(0.035), 0.55) * np.geomspace(1.8, 0.5, count)
        direction = rng.uniform(0, np.pi, size=count)
        phase = rng.uniform(0, 2 * np.pi, size=count)
        self._bumps = _stack_waves(amplitudes, wavelengths, direction, phase)
        self._modulation = rng.uniform(0, 2 * np.pi, size=4)

    def hills(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of the hills, which roads follow, at the places x, y; metres."""
        z = self._slope[0] * x + self._slope[1] * np.clip(y, -60, 60)
        height: NDArray[np.float64] = z + _waves(self._hills, x, y)
        return height

    def beyond(
        self,
        off: NDArray[np.float64],
        t: NDArray[np.float64],
        along: NDArray[np.float64],
        x: NDArray[np.float64],
        y: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Return the height of the land over the hills: banks, ditches and bumps; metres.

        Args:
            off: distances from the outer edge of the pavement; there is no relief below 0.
            t: street coordinates of the places across the street.
            along: street coordinates of the places along the street.
            x, y: the places.
        """
        off = np.clip(off, 0, FARTHEST_RISE)
        z = np.zeros(np.shape(off))

        for side, bank in enumerate(self._banks):
            # The two sides meet on the road, or behind its end.
            weight = np.clip(0.5 + (t if side else -t) / 4, 0, 1)
            # Along the street, the bank is between a third of its height and all of it.
            share = 0.67 + 0.33 * np.sin(0.03 * along + self._modulation[side])
            step = np.clip((off - bank.start) / bank.width, 0, 1)
            rise = bank.rise * share * step * step * (3 - 2 * step)
            trench = bank.ditch * np.exp(-(((off - 1.6) / 0.7) ** 2)) * np.clip(off / 0.3, 0, 1)
            z = z + weight * (bank.slope * off + rise - trench)

        # Some places are smooth, others are rough.
        patchy = np.sin(0.11 * x + self._modulation[2]) * np.sin(0.13 * y + self._modulation[3])
        bumps = _waves(self._bumps, x, y) * (1 + 0.8 * patchy)
        height: NDArray[np.float64] = z + np.clip(off / 1.5, 0, 1) * bumps
        return height


def _stack_waves(
    amplitudes: NDArray[np.float64],
    wavelengths: NDArray[np.float64],
    direction: NDArray[np.float64],
    phase: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return waves as rows of amplitude, wave vector (x, y) and phase: (W, 4)."""
    wave_x = 2 * np.pi / wavelengths * np.cos(direction)
    wave_y = 2 * np.pi / wavelengths * np.sin(direction)
    return np.column_stack([amplitudes, wave_x, wave_y, phase])


def _waves(
    waves: NDArray[np.float64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the sum of (W, 4) waves at the places x, y; see `_stack_waves`."""
    z = np.zeros(np.shape(x))
    for amplitude, wave_x, wave_y, phase in waves:
        z = z + amplitude * np.sin(wave_x * x + wave_y * y + phase)
    return z
