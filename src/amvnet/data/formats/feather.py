"""Read columns of Feather files (Arrow), such as the scans of Argoverse 2, with pyarrow.

A file may claim to unpack to any amount of memory. Files are therefore read in the process with
limits (`reader_process`).
"""

from __future__ import annotations

from pathlib import Path

from amvnet.data.formats.cloud import Arrays, Names, check_point_count, reading, require_columns

EXPECTED = "a Feather file"
ADVICE = "copy it again, or write the table with pyarrow.feather.write_feather"


def read_columns(path: Path, wanted: Names) -> Arrays:
    """Return the wanted columns (N,) of a table, by key.

    Raises:
        InputError: if the file is not Feather, is truncated, lacks a column or has too many rows.
    """
    with reading(path, EXPECTED, ADVICE):
        import pyarrow
        from pyarrow import feather

        with pyarrow.OSFile(str(path)) as file:
            names = pyarrow.ipc.open_file(file).schema.names
        columns = {key: names[at] for key, at in require_columns(names, path, wanted).items()}

        table = feather.read_table(path, columns=list(columns.values()), memory_map=False)
        table.validate(full=True)
        check_point_count(len(table), path)
        return {key: table[name].to_numpy() for key, name in columns.items()}
