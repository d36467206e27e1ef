"""What rows of numbers without names hold: as the user says, or as the values suggest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amvnet.data.formats.cloud import Cloud, find_columns, make_cloud, ring_indices
from amvnet.errors import InputError

NAMES = ("x", "y", "z", "intensity", "ring")  # of the columns, in the usual order
ADVICE = "say what the rows hold, for example --columns x,y,z,intensity,ring --dtype float32"

# What files without names are tried for.
DTYPES = ("float32", "float64")
COUNTS = (3, 4, 5, 6)

# The sample of a file: blocks spread over it, each of whole rows of every number of columns.
BLOCKS = 20
BLOCK = 3000  # values
FEWEST = 600  # values: from fewer, nothing is inferred
ENOUGH = FEWEST * 8  # bytes of a file from which the layout is inferred, with numbers of any type

# Magnitudes of coordinates, intensities and times. Bytes that are read as numbers of another type
# have any magnitude.
SMALLEST = 1e-6
LARGEST = 1e10
USUAL = 0.95  # least share of values with such magnitudes if the type is plausible
FARTHEST = 1e7  # metres: map coordinates are nearer

# Histograms of the values of a column: bins are even near 0 and grow with the values.
LINEAR = 0.05
STEP = 0.25
SAME = 0.1  # nats: columns are as uniform as others if their mean entropies differ by less
MIXED = 0.25  # nats: columns are mixed up if their mean entropy is higher by as much
NEGATIVE = 0.001  # share of the values of an intensity that may be negative

# Between the axes of eleven real scans, some quantile differs by 0.46 of their range or more; by
# 0.012 or less if the file has all x, then all y and so on, and is read as rows.
QUANTILES = np.linspace(0.05, 0.95, 19)
ALIKE = 0.03

# Rings of whole scans have at most 2.1 times as many points as the mean of them, classes at least
# 2.8 times. Elevations within a ring have at most 0.06 of the variance of all, within a class 0.34.
UNEVEN = 2.5
FEWEST_LASERS = 8  # fewer classes can be as even
SPREAD = 0.1


@dataclass(frozen=True)
class RowLayout:
    """What the user says about rows of numbers without names.

    Attributes:
        columns: the name of each column, in order. Names that mean nothing to the readers, such as
            "time" or "_", are left out. Empty if unknown.
        dtypes: NumPy's name of the type of all columns, or that of each; empty if unknown.

    Raises:
        InputError: if a coordinate is missing or named twice, a type is unknown, or there are
            several types, but not one for each column.
    """

    columns: tuple[str, ...] = ()
    dtypes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        lower = list(map(str.lower, self.columns))
        if self.columns and any(lower.count(axis) != 1 for axis in "xyz"):
            raise InputError(
                f"--columns: expected x, y and z, each once, found {','.join(self.columns)!a}; "
                "name all columns in order, for example x,y,z,intensity,ring"
            )

        for dtype in self.dtypes:
            if not _is_number(dtype):
                raise InputError(
                    f"--dtype: expected float32, float64, float16, uint8, ..., found {dtype!a}; "
                    "give the type of all columns, or one for each with commas"
                )
        if len(self.dtypes) > 1 and len(self.dtypes) != len(self.columns):
            raise InputError(
                f"--dtype: expected one type, or one for each of {len(self.columns)} --columns, "
                f"found {len(self.dtypes)}; name as many columns as types"
            )

    @property
    def is_complete(self) -> bool:
        """Whether nothing has to be guessed."""
        return bool(self.columns and self.dtypes)

    @property
    def record(self) -> np.dtype:
        """The NumPy type of a row, with the fields "0", "1", ...; only if it is complete."""
        dtypes = self.dtypes * len(self.columns) if len(self.dtypes) == 1 else self.dtypes
        return np.dtype([(str(index), dtype) for index, dtype in enumerate(dtypes)])

    def describe(self) -> str:
        """Return the layout in words; only if it is complete."""
        return f"rows of {len(self.columns)} {' '.join(self.dtypes)}, {describe(self.columns)}"


UNKNOWN = RowLayout()


def parse_layout(columns: str | None, dtype: str | None) -> RowLayout:
    """Return the layout that the options --columns and --dtype describe.

    Raises:
        InputError: as `RowLayout`.
    """
    return RowLayout(_split(columns), _split(dtype))


def describe(columns: Sequence[str]) -> str:
    """Return the columns that are read, and how many are left out."""
    names = [columns[index] for index in sorted(find_columns(columns).values())]
    text = f"columns {' '.join(names)}"
    more = len(columns) - len(names)
    return f"{text}, {more} more left out" if more else text


def named_cloud(
    columns: Sequence[np.ndarray], names: Sequence[str], name: str, note: str = ""
) -> Cloud:
    """Return the cloud of (N,) columns with these names, which are those of a `RowLayout`.

    Args:
        name: where the scan comes from.
        note: what was assumed of the file.

    Raises:
        InputError: if there are fewer columns than names.
    """
    if len(columns) < len(names):
        raise InputError(
            f"{name}: expected {len(names)} columns ({','.join(names)}), found {len(columns)}; "
            "correct --columns"
        )

    arrays = {key: columns[index] for key, index in find_columns(names).items()}
    cloud = make_cloud(arrays, name)
    return Cloud(cloud.xyz, cloud.intensity, cloud.ring, name, note=note)


def guess_dtype(data: np.ndarray) -> str | None:
    """Infer the type of the numbers in the (B,) bytes of a file: their magnitudes are usual.

    Returns:
        One of `DTYPES`; None if the values are too few or of no magnitude that is measured.
    """
    shares = {}
    for dtype in DTYPES:
        values = _sample(data, np.dtype(dtype))
        shares[dtype] = _usual_share(values) if len(values) >= FEWEST else 0.0

    dtype = max(shares, key=lambda name: shares[name])
    return dtype if shares[dtype] >= USUAL else None


def guess_columns(data: np.ndarray, dtype: str) -> tuple[str, ...] | None:
    """Infer the columns of rows from the values in the (B,) bytes of a file.

    The number of columns is the one that separates the values best: columns that hold one quantity
    each are less varied than mixtures of several.

    Returns:
        The names of 3 to 6 columns; the size of the file may be another than that of whole rows.
        None if the values are too few, cannot be coordinates, or are not a row for each point.
    """
    values = _sample(data, np.dtype(dtype))
    if len(values) < FEWEST:
        return None

    tables = {count: values[: len(values) // count * count].reshape(-1, count) for count in COUNTS}
    table = tables[_guess_count(tables)]
    xyz = table[:, :3]
    return name_columns(table) if _are_positions(xyz) and not _are_alike(xyz) else None


def guess_rows(data: np.ndarray) -> RowLayout | None:
    """Infer the columns and their type from the (B,) bytes of a file; None if they fit none."""
    dtype = guess_dtype(data)
    columns = None if dtype is None else guess_columns(data, dtype)
    if dtype is None or columns is None:
        return None
    return RowLayout(columns, (dtype,))


def name_columns(table: np.ndarray) -> tuple[str, ...]:
    """Return the names of the columns of a (N, 3 or more) table; "_" for those of no known use."""
    count = table.shape[1]
    if _is_color(table[:, 3:6]):
        return (*"xyz", *"_" * (count - 3))

    names = [*NAMES[: min(count, 4)], *"_" * (count - 4)]
    if count > 4 and not _is_color(table[:, 4:7]) and are_rings(table[:, :3], table[:, 4]):
        names[4] = "ring"
    return tuple(names)


@np.errstate(invalid="ignore", over="ignore")
def are_rings(xyz: np.ndarray, values: np.ndarray) -> bool:
    """Return whether (N,) values of (N, 3) points are ring indices, and not labels.

    A laser has about as many points as any other, or one elevation: classes have neither.
    """
    ring = ring_indices(values)
    if ring is None:
        return False

    points = np.bincount(ring)
    lasers = np.count_nonzero(points)
    is_gapless = np.ptp(ring) < 2 * lasers
    if lasers >= FEWEST_LASERS and is_gapless and points.max() * lasers <= UNEVEN * len(ring):
        return True

    x, y, z = np.where(np.isfinite(xyz).all(axis=1, keepdims=True), xyz, 0).T.astype(np.float64)
    elevation = np.arctan2(z, np.hypot(x, y))
    mean = np.bincount(ring, elevation) / np.maximum(points, 1)
    spread = np.mean((elevation - mean[ring]) ** 2)
    return bool(spread <= SPREAD * elevation.var())


def _split(text: str | None) -> tuple[str, ...]:
    """Split an option at its commas; nothing if it was left out."""
    return () if text is None else tuple(name.strip() for name in text.split(","))


def _is_number(dtype: str) -> bool:
    try:
        return np.dtype(dtype).kind in "fiu" and np.dtype(dtype).itemsize <= 8
    except (TypeError, ValueError, SyntaxError):
        return False


def _sample(data: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Return values of blocks that are spread evenly over the bytes of a file, as float64."""
    values = data[: len(data) // dtype.itemsize * dtype.itemsize].view(dtype)
    starts = np.unique(np.linspace(0, max(len(values) - BLOCK, 0), BLOCKS).astype(int) // 60 * 60)

    blocks = []
    for start in starts.tolist():
        block = values[start : start + BLOCK]
        blocks.append(block[: len(block) // 60 * 60])
    with np.errstate(invalid="ignore", over="ignore"):  # of signalling NaN
        return np.concatenate(blocks).astype(np.float64)


@np.errstate(invalid="ignore")
def _usual_share(values: np.ndarray) -> float:
    """Return the share of the values that are 0, NaN or of the magnitude of measurements."""
    if not len(values):
        return 0.0
    magnitude = np.abs(values)
    is_usual = (magnitude >= SMALLEST) & (magnitude <= LARGEST) | (magnitude == 0)
    # NaN marks a lost point. Its bits are a fixed pattern, unlike those of other bytes.
    is_usual |= np.isnan(values)
    return float(is_usual.mean())


def _guess_count(tables: dict[int, np.ndarray]) -> int:
    """Return the number of columns, given the same values with each number of columns."""
    entropies = {count: _entropy(table) for count, table in tables.items()}

    # An intensity, the fourth column, is never negative; a mixture with coordinates is.
    suitable = [3]
    for count, table in tables.items():
        if count > 3 and (table[:, 3] < 0).mean() <= NEGATIVE:
            suitable.append(count)
    least = min(entropies[count] for count in suitable)
    count = min(count for count in suitable if entropies[count] < least + SAME)

    # Some intensities are negative, such as standardised ones.
    if count == 3:
        purest = min((4, 5), key=lambda other: entropies[other])
        if entropies[purest] < entropies[3] - MIXED:
            return purest
    return count


def _entropy(table: np.ndarray) -> float:
    """Return the mean entropy of the columns of a table, in nats, by their histograms."""
    bins = np.sign(table) * np.log1p(np.abs(table) / LINEAR)
    bins = np.round(np.nan_to_num(bins, posinf=1e3, neginf=-1e3) / STEP)

    total = 0.0
    for column in bins.T:
        _, counts = np.unique(column, return_counts=True)
        shares = counts / len(column)
        total -= float((shares * np.log(shares)).sum())
    return total / table.shape[1]


def _are_positions(xyz: np.ndarray) -> bool:
    """Return whether (N, 3) values can be coordinates: not all the same, and on this planet."""
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    if not len(finite) or (np.abs(finite) > FARTHEST).any(axis=1).mean() > 1 - USUAL:
        return False
    return bool((finite.min(axis=0) < finite.max(axis=0)).sum() >= 2)


def _are_alike(xyz: np.ndarray) -> bool:
    """Return whether (N, 3) coordinates have one distribution, as in a transposed table."""
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    quantiles = np.quantile(finite, QUANTILES, axis=0)
    return bool(np.ptp(quantiles, axis=1).max() < ALIKE * np.ptp(quantiles))


def _is_color(columns: np.ndarray) -> bool:
    """Return whether three columns are red, green and blue, 0 to 255."""
    if columns.shape[1] != 3:
        return False
    is_byte = (columns == np.round(columns)) & (columns >= 0) & (columns <= 255)
    return bool(len(columns) and is_byte.all() and (columns.max(axis=0) > 128).all())
