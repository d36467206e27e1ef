"""What a scan file holds, before anything is assumed of the sensor that wrote it."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amvnet.errors import InputError
from amvnet.scan import FARTHEST, Scan

MAX_POINTS = 10_000_000  # of one scan: 40 times what the largest sensors give; a header that claims more is broken
INTENSITY_RANGES = (1.0, 255.0, 65535.0)
MOST_RINGS = 256
NAMES = {
    "x": ("x",),
    "y": ("y",),
    "z": ("z",),
    "intensity": (
        "intensity",
        "intensities",
        "i",
        "reflectivity",
        "reflectance",
        "remission",
        "scalar_intensity",
    ),
    "ring": ("ring", "rings", "channel", "laser_id", "laser", "scalar_ring"),
}  # of columns, in small letters; the first that a file has counts


@dataclass(frozen=True)
class Cloud:
    """The points of one scan file, in its own units and frame.

    Attributes:
        xyz: (N, 3) float32 or float64, metres.
        intensity: (N,) numbers, or None where the file has none.
        ring: (N,) int64 index of the laser, or None.
        name: where the scan comes from, for messages.
        full: the largest intensity there can be, where the format says it.
        note: what was assumed to read the file; empty where nothing was.
    """

    xyz: np.ndarray
    intensity: np.ndarray | None = None
    ring: np.ndarray | None = None
    name: str = ""
    full: float | None = None
    note: str = ""

    def intensity_scale(self) -> float | None:
        """What the intensities have to be divided by to be in [0, 1]; None where there is none.

        Fractions up to 1 stay as they are; else the device's range is taken for 0 to 255, or 0 to 65535.
        """
        if self.full is not None or self.intensity is None:
            return self.full
        finite = self.intensity[np.isfinite(self.intensity)]
        if not len(finite):
            return None
        most, ranges = float(finite.max()), INTENSITY_RANGES
        whole = self.intensity.dtype.kind in "iu"
        return next((full for full in ranges[1 if whole else 0 :] if most <= full), most)

    def to_scan(self, scale: float | None = None) -> Scan:
        """The scan; points at the origin, which sensors write for a lost return, become NaN and so get id 0.

        Args:
            scale: what the intensities are divided by, where it is not `intensity_scale()`.

        Raises:
            InputError: where no point is usable.
        """
        points = np.zeros((len(self.xyz), 4), dtype=np.float32)
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # what does not fit is infinite, and so not valid
            points[:, :3] = self.xyz
            scale = scale or self.intensity_scale()
            if self.intensity is not None and scale is not None:
                points[:, 3] = np.clip(self.intensity / scale, 0, 1)
        x, y, z = self.xyz.T
        points[(x == 0) & (y == 0) & (z == 0), :3] = np.nan
        scan = Scan(points, ring=self.ring, name=self.name)
        if not scan.valid.any():
            raise InputError(f"{self.name}: {_no_points(points[:, :3])}")
        return scan


def _no_points(xyz: np.ndarray) -> str:
    if not len(xyz):
        return "expected a scan with points, found 0 points; leave the file out"
    finite = np.isfinite(xyz).all(axis=1)
    if not finite.any():
        return "expected finite coordinates, found NaN, infinity or 0, 0, 0 in every point; leave it out"
    if (np.abs(xyz[finite]) < FARTHEST).all(axis=1).any():
        return "expected finite intensities, found NaN or infinity in every point; leave it out"
    return (
        f"expected metres from the sensor, found every point farther than {FARTHEST / 1000:g} km, as in a map's "
        "coordinates; give the sensor's place with --offset"
    )


def check_point_count(count: int, path: Path | str, least: int = 0) -> int:
    """Hand back a number of points that a header claims, if a scan can have so many.

    Args:
        least: how many bytes of the file they take at least; 0 where that is not known.

    Raises:
        InputError: where a scan cannot, or the file is too short for it.
    """
    if not 0 <= count <= MAX_POINTS:
        raise InputError(
            f"{path}: expected a scan of at most {MAX_POINTS:,} points, found {count}; cut it into scans"
        )
    if least and least > (size := Path(path).stat().st_size):
        raise InputError(
            f"{path}: expected {least} bytes or more for {count} points, found {size}; "
            "the file is truncated, copy it again"
        )
    return count


@contextmanager
def refusing(path: Path | str, expected: str, advice: str) -> Iterator[None]:
    """Turn whatever a reader raises on broken bytes into an InputError of one line; its warnings are for nobody."""
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except InputError:
        raise
    except BaseException as error:
        # A panic of a library in Rust is no Exception; an interrupt by the user is none either, and goes on.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        found = " ".join(str(error).split())[:160] or type(error).__name__
        raise InputError(
            f"{path}: expected {expected}, found a broken one ({found}); {advice}"
        ) from None


def find_columns(names: Sequence[str]) -> dict[str, int]:
    """Which of a file's columns are x, y, z, intensity and ring, by their names; the last two can be missing."""
    lower = [name.lower() for name in names]
    found = {
        key: [lower.index(alias) for alias in aliases if alias in lower]
        for key, aliases in NAMES.items()
    }
    return {key: places[0] for key, places in found.items() if places}


def require_columns(names: Sequence[str], path: Path | str) -> dict[str, int]:
    """The same; raises InputError where x, y or z is missing."""
    found = find_columns(names)
    if not {"x", "y", "z"} <= set(found):
        shown = ", ".join(names[:20]) or "none"
        raise InputError(
            f"{path}: expected columns x, y, z, found {shown[:200]!a}; name the columns so"
        )
    return found


def make_cloud(columns: Mapping[str, np.ndarray], name: str) -> Cloud:
    """A cloud of the columns x, y, z and, where there are any, intensity and ring."""
    wide = any(
        columns[axis].dtype.itemsize > 4 or columns[axis].dtype.kind in "iu" for axis in "xyz"
    )
    xyz = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(
        np.float64 if wide else np.float32
    )
    return Cloud(xyz, columns.get("intensity"), ring_indices(columns.get("ring")), name)


@np.errstate(invalid="ignore")
def ring_indices(values: np.ndarray | None) -> np.ndarray | None:
    """(N,) int64 ring indices, or None where the values are no such thing; what is not finite counts as 0."""
    if values is None or not len(values):
        return None
    finite = np.where(np.isfinite(values), values, 0)
    whole = (
        np.array_equal(finite, np.round(finite)) and finite.min() >= 0 and finite.max() < MOST_RINGS
    )
    return finite.astype(np.int64) if whole else None
