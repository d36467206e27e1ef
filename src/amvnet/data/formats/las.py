"""Read the dimensions of LAS and LAZ files with laspy.

If a file is broken, lazrs 0.8 can take any amount of memory or abort its process. Files are
therefore read in the process with limits.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amvnet.data.formats.cloud import Arrays, Names, check_point_count, reading, require_columns
from amvnet.errors import InputError

EXPECTED = "a LAS or LAZ file"
ADVICE = "write the file again"
CLASSIFICATION = "classification"
FIRST_WIDE_FORMAT = 6  # the first point format whose classification has a byte of its own
FLAGS = ("synthetic", "key_point", "withheld")  # the other bits of the byte in earlier formats
COMMENTS = ("amvnet", 1)  # the user id and the record id of the record with comments
CHUNK = 1_000_000  # the points that are read at a time


def read_comments(path: Path) -> dict[str, list[str]]:
    """Return the lines of the record `COMMENTS`; raise InputError if the file is not LAS."""
    comments: list[str] = []
    with reading(path, EXPECTED, ADVICE):
        import laspy

        with laspy.open(path, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as file:
            for record in file.header.vlrs.get_by_id(COMMENTS[0], [COMMENTS[1]]):
                comments += record.record_data.decode("ascii").splitlines()
    return {"comments": comments}


def read_columns(path: Path, wanted: Names) -> Arrays:
    """Read some dimensions of all points: x, y and z in metres, others in the file's own units.

    Raises:
        InputError: if the file is not LAS or LAZ, is truncated or lacks a dimension.
    """
    with reading(path, EXPECTED, ADVICE):
        import laspy

        done = 0
        with laspy.open(path, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as file:
            count = check_point_count(file.header.point_count, path)
            # X, Y and Z are integers, from which laspy computes x, y and z.
            names = ["x", "y", "z"]
            for name in file.header.point_format.dimension_names:
                if name not in ("X", "Y", "Z"):
                    names.append(name)

            chosen = require_columns(names, path, wanted)
            columns = {}
            for key, index in chosen.items():
                columns[key] = np.empty(count, "u2" if names[index] == "intensity" else "f8")

            is_narrow = file.header.point_format.id < FIRST_WIDE_FORMAT
            holds_classes = is_narrow and CLASSIFICATION in {names[i] for i in chosen.values()}
            for points in file.chunk_iterator(CHUNK):
                if holds_classes and any(np.any(points[flag]) for flag in FLAGS):
                    raise InputError(
                        f"{path}: expected classes up to 31, the largest one in point format "
                        f"{file.header.point_format.id}, found points with the bits of larger ones "
                        "or with flags; write LAS 1.4 with point format 6"
                    )
                for key, values in columns.items():
                    values[done : done + len(points)] = points[names[chosen[key]]]
                done += len(points)

    if done < count:
        raise InputError(
            f"{path}: expected {count} points, found {done}; the file is truncated, copy it again"
        )
    return columns
