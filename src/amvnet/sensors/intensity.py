"""Bring intensities to the range and the distribution that some weights know.

Sensors and tools write intensities as fractions or as integers of 8 or 16 bits. Some calibrate
them. All decisions rest on quantiles, so that a few outliers change nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amvnet.data.formats.cloud import MAX_MISSING_SHARE, WILD_SHARE, as_fractions
from amvnet.errors import InputError, shown
from amvnet.scan import Scan

# The quantiles at these probabilities describe a distribution of intensities. They leave out a
# thousandth at each end: outliers, and the few retroreflectors that decide the maximum of a scan.
PROBABILITIES = (0.001, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999)
MEDIAN_INDEX = PROBABILITIES.index(0.5)  # index of the median among the quantiles
BRIGHT_INDEX = PROBABILITIES.index(0.9)  # index of the bright quantile
DARKEST_INTENSITY = 0.004  # one step of 8 bits: factors between darker intensities mean nothing
# Largest factor between the medians, and between the bright quantiles, of two like distributions.
ALIKE_FACTOR = 2.0
# Largest such factor of two scans whose intensities have one range.
ONE_RANGE_FACTOR = 8.0
# Intensities are constant if 98 % of them differ by at most this share of their median.
CONSTANT_SHARE = 0.01

# Quantiles to which training brings the intensities of simulated scans. Weights without quantiles
# of their own use these.
SIMULATED_QUANTILES = {
    "hdl64e": (0.0, 0.0, 0.07, 0.133, 0.232, 0.311, 0.396, 0.492, 0.565, 0.755, 0.986),
    "hdl32e": (0.0, 0.0, 0.005, 0.007, 0.011, 0.039, 0.066, 0.11, 0.17, 0.265, 0.792),
}
MAX_INTENSITY = 1e9  # limit of a quantile in a file; no device writes larger intensities
NO_INTENSITY = (0.0,) * len(PROBABILITIES)  # the quantiles of training scans without intensities


@dataclass(frozen=True)
class TrainedIntensity:
    """The intensities that some networks were trained with.

    Attributes:
        quantiles: the quantiles at `PROBABILITIES` of the training scans' intensities in [0, 1].
        is_optional: whether the networks learnt to label scans whose intensities are all zero.
        is_matched: whether the intensities of each scan are brought to this distribution. Networks
            trained on simulated scans need this: no real sensor has the simulated distribution.

    Raises:
        InputError: if no intensities have these quantiles.
    """

    quantiles: tuple[float, ...]
    is_optional: bool = False
    is_matched: bool = False

    def __post_init__(self) -> None:
        is_without = self.quantiles == NO_INTENSITY and not self.is_matched
        if not is_without and not are_quantiles(self.quantiles):
            raise InputError(
                f"expected {len(PROBABILITIES)} quantiles of the intensities, ascending and not "
                f"all equal, found {shown(list(self.quantiles))}; train or export again"
            )

    @property
    def are_fractions(self) -> bool:
        """Whether the intensities lie in [0, 1].

        If not, the networks were trained with a larger range and take intensities in that range.
        """
        return self.quantiles[-1] <= 1

    def filler(self, count: int) -> np.ndarray:
        """Return (count,) float32 intensities for a scan that has none.

        Networks that learnt to do without intensities get zeros. Other networks would take a
        constant for a material, so they get seeded random draws from the training's distribution.
        """
        if self.is_optional:
            return np.zeros(count, np.float32)
        draws = np.random.default_rng(0).random(count)
        return np.interp(draws, PROBABILITIES, self.quantiles).astype(np.float32)


def simulated_quantiles(sensor: str) -> tuple[float, ...]:
    """Return the quantiles of a simulated sensor; those of an HDL-64E if it has none of its own."""
    return SIMULATED_QUANTILES.get(sensor, SIMULATED_QUANTILES["hdl64e"])


def match_scan(scan: Scan, trained: Sequence[float]) -> Scan:
    """Return a scan whose intensities have the quantiles of a training; constant ones stay."""
    valid = scan.valid
    intensity = scan.points[valid, 3]
    quantiles = quantiles_of(intensity)
    if quantiles is None or is_constant(quantiles):
        return scan

    points = scan.points.copy()
    levels, becomes = matching(quantiles, trained)
    points[valid, 3] = np.interp(intensity, levels, becomes)
    return dataclasses.replace(scan, points=points)


def matching(quantiles: np.ndarray, trained: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the Q distinct quantiles of some scans, and the intensities that they become.

    Linear interpolation maps the intensities between two quantiles. Equal quantiles, of many zeros
    for example, become the mean of the training's quantiles at their probabilities.

    Returns:
        (Q,) distinct quantiles, ascending, and (Q,) intensities in [0, 1].
    """
    levels, index = np.unique(quantiles, return_inverse=True)
    becomes = np.bincount(index, weights=trained) / np.bincount(index)
    return levels, np.clip(becomes, 0, 1)


def are_quantiles(values: Sequence[float]) -> bool:
    """Return whether values may be the quantiles of intensities that are not all equal."""
    if len(values) != len(PROBABILITIES):
        return False
    are_numbers = all(type(value) in (int, float) for value in values)
    if not are_numbers or not all(0 <= value < MAX_INTENSITY for value in values):
        return False  # NaN fails this check as well
    is_increasing = bool((np.diff(values) >= 0).all())
    return is_increasing and not is_constant(values)


def quantiles_of(intensity: np.ndarray | None) -> np.ndarray | None:
    """Return the quantiles of intensities (N,) at `PROBABILITIES`, or None if there are none.

    Intensities that are not finite do not count.
    """
    if intensity is None:
        return None
    finite = intensity[np.isfinite(intensity)]
    if not len(finite):
        return None

    # NumPy's quantiles are four times as fast on sorted values.
    ascending = np.sort(finite).astype(np.float64)
    return np.quantile(ascending, PROBABILITIES)


def mean_quantiles(scans: Sequence[Scan]) -> tuple[float, ...]:
    """Return the mean quantiles of the intensities of some scans; empty if no scan has any."""
    quantiles = [quantiles_of(scan.points[scan.valid, 3]) for scan in scans]
    known = [values for values in quantiles if values is not None]
    return tuple(np.mean(known, axis=0).round(4).tolist()) if known else ()


def is_constant(quantiles: np.ndarray | Sequence[float]) -> bool:
    """Return whether nearly all intensities are equal, so that they say nothing."""
    low = quantiles[PROBABILITIES.index(0.01)]
    high = quantiles[PROBABILITIES.index(0.99)]
    return bool(high - low <= CONSTANT_SHARE * abs(quantiles[MEDIAN_INDEX]))


def are_of_one_range(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    """Return whether intensities with these quantiles (None: no intensities) have one range."""
    if a is None or b is None:
        return a is None and b is None
    if is_constant(a) or is_constant(b):
        return is_constant(a) and is_constant(b)
    return _are_alike(a, b, factor=ONE_RANGE_FACTOR, least=DARKEST_INTENSITY * max(a[-1], b[-1]))


def _are_alike(
    a: np.ndarray | Sequence[float], b: np.ndarray | Sequence[float], factor: float, least: float
) -> bool:
    """Return whether the medians, and the bright quantiles, differ by at most `factor`.

    Smaller quantiles count as `least`.
    """
    for index in (MEDIAN_INDEX, BRIGHT_INDEX):
        low, high = sorted((max(a[index], least), max(b[index], least)))
        if high > factor * low:
            return False
    return True


@dataclass(frozen=True)
class IntensityMap:
    """How the intensities of some scans become intensities that some weights know.

    Attributes:
        scale: the divisor of the intensities, or None if they are matched or filled in.
        matched: what `matching` returns, or None if the intensities are not matched.
        trained: fills in missing intensities. If it is None, they become zeros.
    """

    text: str
    scale: float | None = None
    matched: tuple[np.ndarray, np.ndarray] | None = None
    trained: TrainedIntensity | None = None

    def __call__(self, intensity: np.ndarray | None, count: int) -> np.ndarray:
        """Return the mapped intensities of a scan: (count,) in [0, 1]. NaN stays NaN."""
        with np.errstate(over="ignore", invalid="ignore"):
            if intensity is not None and self.scale is not None:
                return as_fractions(intensity, self.scale)
            if intensity is not None and self.matched is not None:
                mapped = np.interp(intensity, *self.matched)
                return np.where(np.isfinite(intensity), mapped, np.nan)
        return np.zeros(count) if self.trained is None else self.trained.filler(count)


def intensity_map(
    quantiles: np.ndarray | None,
    scale: float,
    trained: TrainedIntensity | None,
    is_given: bool = False,
) -> IntensityMap:
    """Decide how to map the intensities of some scans.

    The intensities are divided by their scale. If their distribution then differs from the
    training's, it is matched by its quantiles instead, unless the user gave the scale.

    Args:
        quantiles: the quantiles of the raw intensities at `PROBABILITIES`, or None if there are no
            intensities.
    """
    if quantiles is None:
        return IntensityMap(f"no intensity ({describe_filler(trained)})", trained=trained)

    linear = IntensityMap(f"intensity 0 to {scale:g}", scale)
    if is_given:
        return linear
    if is_constant(quantiles):
        median = f"{quantiles[MEDIAN_INDEX]:g}"
        text = f"intensity {median} everywhere, so none ({describe_filler(trained)})"
        return IntensityMap(text, trained=trained)
    if trained is not None and trained.is_matched:  # the segmenter matches them, scan by scan
        return dataclasses.replace(linear, text=f"{linear.text}, spread as in the training")
    if trained is None or _are_alike(
        quantiles / scale, trained.quantiles, factor=ALIKE_FACTOR, least=DARKEST_INTENSITY
    ):
        return linear

    text = (
        f"intensity 0 to {scale:g}, spread as in the training: half of it was below "
        f"{quantiles[MEDIAN_INDEX] / scale:.2g}, now {trained.quantiles[MEDIAN_INDEX]:.2g} "
        f"(--intensity-scale {scale:g} keeps it)"
    )
    return IntensityMap(text, matched=matching(quantiles, trained.quantiles))


def describe_filler(trained: TrainedIntensity | None) -> str:
    """Return in words what replaces missing intensities."""
    if trained is None:
        return "0 instead"
    if trained.is_optional:
        return "0 instead, as in a part of the training"
    return "drawn at random as in the training; the labels will be much worse"


def fill_intensity(scan: Scan, trained: TrainedIntensity | None) -> tuple[Scan, str]:
    """Return a scan whose points all have an intensity, and which ones were missing.

    A few missing intensities become the median of the others. If more than `MAX_MISSING_SHARE` are
    missing, the scan becomes one without intensities: real ones among many zeros would mislead.

    Returns:
        The scan, and in words what was missing and what replaces it; empty if nothing was missing.
    """
    is_finite = np.isfinite(scan.points[:, 3])
    if is_finite.all():
        return scan, ""
    valid = scan.valid
    is_missing = valid & ~is_finite
    missing = np.count_nonzero(is_missing)
    if not missing:
        return scan, ""

    points = scan.points.copy()
    if missing > MAX_MISSING_SHARE * np.count_nonzero(valid):
        points[:, 3] = 0 if trained is None else trained.filler(len(scan))
        instead = describe_filler(trained)
    else:
        points[is_missing, 3] = np.median(points[valid & is_finite, 3])
        instead = "the median instead"
    share = math.ceil(100 * missing / np.count_nonzero(valid))
    text = f"no intensity in {share} % of the points ({instead})"
    return dataclasses.replace(scan, points=points), text


def check_intensity(scan: Scan) -> Scan:
    """Return a scan with intensities in [0, 1]; a few outliers are clipped.

    Raises:
        InputError: if more than `WILD_SHARE` of the intensities are out of range.
    """
    intensity = scan.points[:, 3]
    if intensity.min() >= 0 and intensity.max() <= 1:  # false if an intensity is NaN
        return scan

    valid = scan.valid
    is_outside = valid & ((intensity < 0) | (intensity > 1))
    if not is_outside.any():
        return scan
    if is_outside.sum() > max(WILD_SHARE * valid.sum(), 1):
        low = intensity[valid].min()
        high = intensity[valid].max()
        found = f"{low:g} to {high:g}"
        advice = "divide them by the largest possible one, as amvnet predict does for scan files"
        if high <= 1:
            found = f"{low:g} in {is_outside.sum():,} of {valid.sum():,} points"
            advice = "write 0 where the intensity is unknown"
        raise InputError(
            f"{scan.name or 'scan'}: expected intensities in [0, 1], found {found}; {advice}"
        )

    points = scan.points.copy()
    points[is_outside, 3] = np.clip(intensity[is_outside], 0, 1)
    return dataclasses.replace(scan, points=points)
