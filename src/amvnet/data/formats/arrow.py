"""Columns of Feather files (Arrow), such as the scans of Argoverse 2, by pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.formats.cloud import Arrays, Names, check_point_count, reading, require_columns
from amvnet.errors import InputError

EXPECTED = "a Feather file"
ADVICE = "copy it again, or write the table with pyarrow.feather.write_feather"


def read_columns(path: Path, wanted: Names) -> Arrays:
    """Read some columns of a table.

    Raises:
        InputError: if the file is not Feather, is truncated or lacks a column.
    """
    with reading(path, EXPECTED, ADVICE):
        import pyarrow

        with pyarrow.OSFile(str(path)) as file:
            try:
                reader = pyarrow.ipc.open_file(file)
            except pyarrow.ArrowInvalid:
                raise InputError(f"{path}: expected {EXPECTED} of version 2; {ADVICE}") from None
            all_names = reader.schema.names
            columns = require_columns(all_names, path, wanted)
            options = pyarrow.ipc.IpcReadOptions(included_fields=sorted(set(columns.values())))
            reader = pyarrow.ipc.open_file(file, options=options)

            batches: list[Any] = []
            count = 0
            for index in range(reader.num_record_batches):
                batches.append(reader.get_batch(index))
                count = check_point_count(count + len(batches[-1]), path)

        arrays = {}
        for key, index in columns.items():
            values = []
            for batch in batches:
                values.append(batch.column(all_names[index]).to_numpy(zero_copy_only=False))
            arrays[key] = np.concatenate(values) if values else np.empty(0, np.float32)
        return arrays
