"""Read columns of Feather files (Arrow), such as the scans of Argoverse 2, with pyarrow.

A file may claim to unpack to any amount of memory. Files are therefore read in the process with
limits.
"""

from __future__ import annotations

from pathlib import Path

from amvnet.data.formats.cloud import Arrays, Names, check_point_count, reading, require_columns

EXPECTED = "a Feather file"
ADVICE = "copy it again, or write the table with pyarrow.feather.write_feather"


def read_columns(path: Path, wanted: Names) -> Arrays:
    """Read some columns of a table.

    Raises:
        InputError: if the file is not Feather, is truncated or lacks a column.
    """
    with reading(path, EXPECTED, ADVICE):
        import pyarrow
        from pyarrow import feather

        with pyarrow.OSFile(str(path)) as file:
            names = pyarrow.ipc.open_file(file).schema.names
        chosen = require_columns(names, path, wanted)

        table = feather.read_table(
            path, columns=[names[index] for index in chosen.values()], memory_map=False
        )
        table.validate(full=True)
        check_point_count(len(table), path)
        return {key: table[names[index]].to_numpy() for key, index in chosen.items()}
