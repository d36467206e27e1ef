"""Name the columns of a table without names, as the user says or in the usual order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from amvnet.data.formats.cloud import Cloud, find_columns, make_cloud, ring_indices
from amvnet.errors import InputError

NAMES = ("x", "y", "z", "intensity", "ring")  # the names of the columns in the usual order
USUAL_TYPE = "float32"

# These limits tell rings from labels. On whole scans, the largest ring has at most 2.1 times as
# many points as the mean ring; the largest class has at least 2.8 times as many as the mean class.
# The variance of the elevations within a ring is at most 0.06 of their variance in the scan; within
# a class it is at least 0.34.
LARGEST_RING = 2.5  # largest number of points of a ring, relative to the mean ring
FEWEST_LASERS = 8  # the fewest lasers; fewer classes may also have similar numbers of points
# The largest variance of the elevations within a ring, relative to their variance in the scan.
ELEVATION_SPREAD = 0.1


def _is_number(dtype: str) -> bool:
    try:
        return np.dtype(dtype).kind in "fiu" and np.dtype(dtype).itemsize <= 8
    except (TypeError, ValueError, SyntaxError):
        return False


@dataclass(frozen=True)
class RowLayout:
    """The layout of rows of numbers without names, as the user states it.

    Attributes:
        columns: the name of each column, in order; empty if the user does not state them. Columns
            whose names the readers do not know, such as "time" or "_", are not read.
        dtypes: NumPy's names of the types: one for all columns, or one for each column.
        in_yaml: whether a YAML file states the layout, or else options of a command; messages
            name the keys or the options.

    Raises:
        InputError: if a coordinate is missing or named twice, a type is unknown, or there are
            several types but not one for each column.
    """

    columns: tuple[str, ...] = ()
    dtypes: tuple[str, ...] = (USUAL_TYPE,)
    in_yaml: bool = field(default=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        option = "" if self.in_yaml else "--"
        lower = list(map(str.lower, self.columns))
        if self.columns and any(lower.count(axis) != 1 for axis in "xyz"):
            raise InputError(
                f"{option}columns: expected x, y and z, each once, found "
                f"{','.join(self.columns)!a}; name all columns in order, for example "
                f"{','.join(NAMES)}"
            )

        for dtype in self.dtypes:
            if not _is_number(dtype):
                raise InputError(
                    f"{option}dtype: expected float32, float64, float16, uint8, ..., found "
                    f"{dtype!a}; give the type of all columns, or a type for each column"
                )

        is_stated = self.dtypes != (USUAL_TYPE,)
        fits_columns = len(self.dtypes) in (1, len(self.columns))
        if is_stated and not (self.columns and fits_columns):
            raise InputError(
                f"{option}dtype: expected {option}columns, and one type or a type for each column, "
                f"found {len(self.columns)} columns and {len(self.dtypes)} types; name the columns"
            )

    @property
    def record(self) -> np.dtype:
        """The NumPy type of a row, with the fields "0", "1", ..."""
        dtypes = self.dtypes * len(self.columns) if len(self.dtypes) == 1 else self.dtypes
        return np.dtype([(str(index), dtype) for index, dtype in enumerate(dtypes)])

    def advise(self, *columns: str) -> str:
        """Return in words how the user states columns: as an option, or in the YAML file."""
        if self.in_yaml:
            return f"columns: [{', '.join(columns)}] in the YAML file"
        return f"--columns {','.join(columns)}"

    @property
    def advice(self) -> str:
        """What the user can do if rows are not read, for messages."""
        dtype = " (and dtype)" if self.in_yaml else f" --dtype {USUAL_TYPE}"
        return f"say what the rows hold, for example {self.advise(*NAMES)}{dtype}"

    def describe(self) -> str:
        """Return the layout in words, for messages."""
        return f"rows of {len(self.columns)} {' '.join(self.dtypes)}, {describe(self.columns)}"


UNKNOWN = RowLayout()


def parse_layout(columns: str | Sequence[str] | None, dtype: str | None = None) -> RowLayout:
    """Return the layout that the options --columns and --dtype describe; lists have no commas."""
    return RowLayout(_split(columns), _split(dtype or USUAL_TYPE))


def describe(columns: Sequence[str]) -> str:
    """Describe which columns are read, and how many are left out."""
    names = [columns[index] for index in sorted(find_columns(columns).values())]
    text = f"columns {' '.join(names)}"
    more = len(columns) - len(names)
    return f"{text}, {more} more left out" if more else text


def named_cloud(
    columns: Sequence[np.ndarray], names: Sequence[str], name: str, note: str = ""
) -> Cloud:
    """Return a cloud from columns (N,) with names of a `RowLayout`; further columns are left out.

    Raises:
        InputError: if there are fewer columns than names, or a column does not hold numbers.
    """
    if len(columns) < len(names):
        raise InputError(
            f"{name}: expected {len(names)} columns ({','.join(names)}), found {len(columns)}; "
            "correct the names of the columns"
        )

    arrays = {}
    for key, index in find_columns(names).items():
        values = columns[index]
        if values.ndim != 1 or values.dtype.kind not in "fiu":
            found = (
                f"{values.dtype} of shape {values.shape[1:]}" if values.ndim > 1 else values.dtype
            )
            raise InputError(
                f"{name}: expected a number for each point in the column {names[index]!a}, found "
                f"{found}; convert the column"
            )
        arrays[key] = values
    return replace(make_cloud(arrays, name), note=note)


def name_columns(table: np.ndarray) -> tuple[str, ...]:
    """Return names for the columns of a table (N, 3 or more); "_" for an unknown column."""
    count = table.shape[1]
    if _is_color(table[:, 3:6]):
        return (*"xyz", *"_" * (count - 3))

    names = [*NAMES[: min(count, 4)], *"_" * (count - 4)]
    if count > 4 and not _is_color(table[:, 4:7]) and are_rings(table[:, :3], table[:, 4]):
        names[4] = "ring"
    return tuple(names)


@np.errstate(invalid="ignore", over="ignore")
def are_rings(xyz: np.ndarray, values: np.ndarray) -> bool:
    """Return whether values (N,) of points (N, 3) are ring indices rather than labels.

    Lasers have similar numbers of points, or each laser has one elevation. Neither holds for the
    classes of labels.
    """
    ring = ring_indices(values)
    if ring is None:
        return False

    points = np.bincount(ring)
    lasers = np.count_nonzero(points)
    is_gapless = np.ptp(ring) < 2 * lasers
    is_even = points.max() * lasers <= LARGEST_RING * len(ring)
    if lasers >= FEWEST_LASERS and is_gapless and is_even:
        return True

    x, y, z = np.where(np.isfinite(xyz).all(axis=1, keepdims=True), xyz, 0).T.astype(np.float64)
    elevation = np.arctan2(z, np.hypot(x, y))
    mean = np.bincount(ring, elevation) / np.maximum(points, 1)
    spread = np.mean((elevation - mean[ring]) ** 2)
    return bool(spread <= ELEVATION_SPREAD * elevation.var())


def _split(names: str | Sequence[str] | None) -> tuple[str, ...]:
    if names is None:
        return ()
    return tuple(name.strip() for name in (names.split(",") if isinstance(names, str) else names))


def _is_color(columns: np.ndarray) -> bool:
    """Return whether three columns can be red, green and blue, from 0 to 255."""
    if columns.shape[1] != 3:
        return False
    is_byte = (columns == np.round(columns)) & (columns >= 0) & (columns <= 255)
    return bool(len(columns) and is_byte.all() and (columns.max(axis=0) > 128).all())
