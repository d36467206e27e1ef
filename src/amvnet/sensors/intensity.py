"""Bring intensities to the range and the distribution that some weights know.

Sensors and tools write intensities as fractions, in 8 bits or in 16 bits, calibrated or not. All
decisions rest on quantiles, so that a few outliers change nothing.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

import numpy as np

from amvnet.data.formats.cloud import WILD_SHARE, as_fractions
from amvnet.errors import InputError, shown
from amvnet.scan import Scan

# The quantiles at these probabilities describe a distribution of intensities. They leave out a
# thousandth at both ends: outliers, and the few retroreflectors that decide the maximum of a scan.
PROBABILITIES = (0.001, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99, 0.999)
MEDIAN = PROBABILITIES.index(0.5)
BRIGHT = PROBABILITIES.index(0.9)
DARKEST = 0.004  # one step of 8 bits; factors between darker intensities mean nothing
# The largest factor between the medians, and between the bright quantiles, ...
ALIKE = 2.0  # ... of two distributions that are alike
ONE_RANGE = 8.0  # ... of two scans whose intensities have the same range
CONSTANT = 0.01  # share of the median; if 98 % of the intensities differ by less, they say nothing
BLIND_SHARE = 0.2  # networks that saw this share of their scans without intensity need none

# Quantiles of the intensities in simulated training scans. Weights without quantiles of their own
# use these.
QUANTILES = {
    "hdl64e": (0.0, 0.0, 0.07, 0.133, 0.232, 0.311, 0.396, 0.492, 0.565, 0.755, 0.986),
    "hdl32e": (0.0, 0.0, 0.005, 0.007, 0.011, 0.039, 0.066, 0.11, 0.17, 0.265, 0.792),
}
LARGEST_INTENSITY = 1e9  # no device writes larger intensities
KEY = "intensity_quantiles"  # key of the quantiles in a part's training record
MATCHED = "match_intensity"  # key of `TrainedIntensity.is_matched` in a part's training record
NO_INTENSITY = [0.0] * len(PROBABILITIES)  # the quantiles of training scans without intensities


@dataclass(frozen=True)
class TrainedIntensity:
    """The intensities that some networks were trained with.

    Attributes:
        quantiles: the quantiles at `PROBABILITIES` of the training scans' intensities in [0, 1].
        is_optional: whether the networks learnt to label scans whose intensities are all zero.
        is_matched: whether the intensities of each scan are brought to this distribution. Networks
            trained on simulated scans need this: no real sensor has the simulated distribution.
    """

    quantiles: Sequence[float]
    is_optional: bool = False
    is_matched: bool = False

    @property
    def are_fractions(self) -> bool:
        """Whether the intensities lie in [0, 1].

        If not, the networks were trained with other intensities and take such intensities.
        """
        return self.quantiles[-1] <= 1

    def filler(self, count: int) -> np.ndarray:
        """Return (count,) float32 intensities for a scan that has none.

        Networks that learnt to do without intensities get zeros. Other networks would take a
        constant for a material. They get seeded random draws from the training's distribution.
        """
        if self.is_optional:
            return np.zeros(count, np.float32)
        draws = np.random.default_rng(0).random(count)
        return np.interp(draws, PROBABILITIES, self.quantiles).astype(np.float32)


def network_records(training: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the names and the training records of the networks that have one."""
    for part in ("range_net", "polar_net"):
        record = training.get(part)
        if isinstance(record, Mapping):
            yield part, record


def trained_intensity(training: Mapping[str, Any], sensor: str) -> TrainedIntensity | None:
    """Return the intensities that weights were trained with; None if they are unknown.

    Args:
        training: the training records of the weights by part.
        sensor: name of the sensor that the weights were trained for.
    """
    quantiles: Sequence[float] | None = QUANTILES.get(sensor)
    shares = []
    matched = []
    for part, record in network_records(training):
        carried = record.get(KEY)
        if carried == NO_INTENSITY and record.get(MATCHED) is not True:
            quantiles = NO_INTENSITY
        elif carried:
            quantiles = check_quantiles(carried, f"the training record of {part}")

        augment = record.get("augment")
        share = augment.get("no_intensity") if isinstance(augment, Mapping) else None
        shares.append(share if isinstance(share, (int, float)) else 0)
        matched.append(record.get(MATCHED) is True)

    if quantiles is None:
        return None
    return TrainedIntensity(
        quantiles,
        is_optional=min(shares, default=0) >= BLIND_SHARE,
        is_matched=bool(matched) and all(matched),
    )


def prepare(scan: Scan, trained: TrainedIntensity | None) -> Scan:
    """Return a scan with the intensities that the networks take.

    Everything that segments scans calls this.

    Raises:
        InputError: if `check_intensity` raises it.
    """
    if trained is None or trained.are_fractions:
        scan = check_intensity(scan)
    return match_scan(scan, trained)


def simulated_intensity(sensor: str) -> TrainedIntensity:
    """Return the intensities to which the scans of a simulated sensor are brought in training."""
    return TrainedIntensity(QUANTILES[sensor], is_matched=True)


def match_scan(scan: Scan, trained: TrainedIntensity | None) -> Scan:
    """Return a scan with its intensities brought to the distribution of a training.

    The scan is returned unchanged if the training does not ask for this
    (`TrainedIntensity.is_matched`), or if its intensities say nothing, such as zeros everywhere.
    """
    if trained is None or not trained.is_matched:
        return scan

    valid = scan.valid
    intensity = scan.points[valid, 3]
    quantiles = quantiles_of(intensity)
    if quantiles is None or is_constant(quantiles):
        return scan

    points = scan.points.copy()
    levels, becomes = matching(quantiles, trained.quantiles)
    points[valid, 3] = np.interp(intensity, levels, becomes)
    return dataclasses.replace(scan, points=points)


def matching(quantiles: np.ndarray, trained: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct quantiles of some scans, and the intensities that they become.

    Intensities between two quantiles are interpolated linearly. If quantiles are equal, as with
    many zeros, they become the mean of the training's quantiles at their probabilities.
    """
    levels, index = np.unique(quantiles, return_inverse=True)
    becomes = np.bincount(index, weights=trained) / np.bincount(index)
    return levels, np.clip(becomes, 0, 1)


def are_quantiles(values: Any) -> TypeGuard[list[float]]:
    """Return whether a value of a file is quantiles at `PROBABILITIES` that are not all equal."""
    if not isinstance(values, list) or len(values) != len(PROBABILITIES):
        return False
    are_numbers = all(type(value) in (int, float) for value in values)
    if not are_numbers or not all(0 <= value < LARGEST_INTENSITY for value in values):
        return False  # also for NaN
    is_increasing = bool((np.diff(values) >= 0).all())
    return is_increasing and not is_constant(values)


def check_quantiles(values: Any, source: str) -> list[float]:
    """Return the quantiles in a file; raise InputError if they are wrong."""
    if not are_quantiles(values):
        raise InputError(
            f"{source}: expected {len(PROBABILITIES)} quantiles of the intensities, ascending and "
            f"not all equal, found {shown(values)}; train or export again"
        )
    return values


def quantiles_of(intensity: np.ndarray | None) -> np.ndarray | None:
    """Return the quantiles of intensities (N,) at `PROBABILITIES`; None if there are none.

    Intensities that are not finite are left out.
    """
    if intensity is None:
        return None
    finite = intensity[np.isfinite(intensity)]
    if not len(finite):
        return None

    # NumPy's quantiles are four times as fast on sorted values.
    ascending = np.sort(finite).astype(np.float64)
    return np.quantile(ascending, PROBABILITIES)


def is_constant(quantiles: np.ndarray | Sequence[float]) -> bool:
    """Return whether nearly all intensities are the same, so that they say nothing."""
    low = quantiles[PROBABILITIES.index(0.01)]
    high = quantiles[PROBABILITIES.index(0.99)]
    return bool(high - low <= CONSTANT * abs(quantiles[MEDIAN]))


def are_of_one_range(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    """Return whether the intensities of two scans have the same range, given their quantiles."""
    if a is None or b is None:
        return a is None and b is None
    if is_constant(a) or is_constant(b):
        return is_constant(a) and is_constant(b)
    return _are_alike(a, b, factor=ONE_RANGE, least=DARKEST * max(a[-1], b[-1]))


def _are_alike(
    a: np.ndarray | Sequence[float], b: np.ndarray | Sequence[float], factor: float, least: float
) -> bool:
    """Return whether the medians and bright quantiles, at least `least`, differ by a factor."""
    for index in (MEDIAN, BRIGHT):
        low, high = sorted((max(a[index], least), max(b[index], least)))
        if high > factor * low:
            return False
    return True


@dataclass(frozen=True)
class IntensityMap:
    """How the intensities of some scans become intensities that some weights know.

    Attributes:
        text: describes the map to the user.
        scale: the divisor of the intensities; None if they are matched or filled in.
        matched: what `matching` returns; None if the intensities are not matched.
        trained: fills in missing intensities; if None, they become zeros.
    """

    text: str
    scale: float | None = None
    matched: tuple[np.ndarray, np.ndarray] | None = None
    trained: TrainedIntensity | None = None

    def __call__(self, intensity: np.ndarray | None, count: int) -> np.ndarray:
        """Return a scan's intensities in [0, 1], (count,); NaN stays NaN."""
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
        quantiles: the quantiles of the raw intensities at `PROBABILITIES`; None if there are no
            intensities.
        scale: the largest possible intensity.
        trained: the intensities of the training; None if unknown.
        is_given: whether the user gave the scale.
    """
    if quantiles is None:
        return IntensityMap(f"no intensity ({describe_filler(trained)})", trained=trained)

    linear = IntensityMap(f"intensity 0 to {scale:g}", scale)
    if is_given:
        return linear
    if is_constant(quantiles):
        text = f"intensity {quantiles[MEDIAN]:g} everywhere, so none ({describe_filler(trained)})"
        return IntensityMap(text, trained=trained)
    if trained is not None and trained.is_matched:  # the segmenter matches them, scan by scan
        return dataclasses.replace(linear, text=f"{linear.text}, spread as in the training")
    if trained is None or _are_alike(
        quantiles / scale, trained.quantiles, factor=ALIKE, least=DARKEST
    ):
        return linear

    text = (
        f"intensity 0 to {scale:g}, spread as in the training: half of it was below "
        f"{quantiles[MEDIAN] / scale:.2g}, now {trained.quantiles[MEDIAN]:.2g} "
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


def check_intensity(scan: Scan) -> Scan:
    """Return a scan with intensities in [0, 1]; a few outliers are clipped.

    Raises:
        InputError: if more than `WILD_SHARE` of the intensities are out of range.
    """
    intensity = scan.points[:, 3]
    if intensity.min() >= 0 and intensity.max() <= 1:  # false if one is NaN
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
