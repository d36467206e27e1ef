"""Scans in Feather files (Arrow), such as those of Argoverse 2, by pyarrow."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.data.formats.cloud import (
    Cloud,
    check_point_count,
    make_cloud,
    reading,
    require_columns,
)
from amvnet.data.formats.fields import Arrays, Choose
from amvnet.errors import InputError

EXPECTED = "a Feather file"
ADVICE = "copy it again, or write the table with pyarrow.feather.write_feather"

# Argoverse 2: `LOG/sensors/lidar/TIME.feather` and `LOG/calibration/egovehicle_SE3_sensor.feather`.
# Both of its LiDARs are on the roof, one upon the other, and the points of both are in one file.
CALIBRATION = "calibration/egovehicle_SE3_sensor.feather"
LIDARS = ("up_lidar", "down_lidar")
POSITION = ("tx_m", "ty_m", "tz_m")


def read_feather(path: Path) -> Cloud:
    """Read the columns of a table by their names.

    The points of Argoverse 2 are in the frame of the vehicle, whose origin is on its rear axle. If
    the calibration of the log is there, they are moved to the LiDARs.

    Raises:
        InputError: if the file is not Feather, is truncated, or has no x, y, z.
    """
    cloud = make_cloud(read_columns(path, partial(require_columns, path=path)), str(path))
    calibration = path.absolute().parents[min(2, len(path.absolute().parents) - 1)] / CALIBRATION
    if not calibration.is_file():
        return cloud

    position = _lidar_position(calibration)
    moved = (cloud.xyz - position).astype(cloud.xyz.dtype)
    place = ", ".join(f"{value:.2f}" for value in position)
    note = f"Argoverse 2, moved from the vehicle's origin to the LiDARs at {place}"
    return replace(cloud, xyz=moved, note=note, file_xyz=cloud.xyz)


def _lidar_position(path: Path) -> np.ndarray:
    """Return the (3,) mean position of the LiDARs in the frame of the vehicle, metres.

    Raises:
        InputError: if the calibration is broken or names no LiDAR.
    """
    names = ("sensor_name", *POSITION)
    table = read_columns(path, lambda all_names: {name: all_names.index(name) for name in names})
    is_lidar = np.isin(table["sensor_name"].astype(str), LIDARS)
    if not is_lidar.any():
        raise InputError(
            f"{path}: expected the sensors {', '.join(LIDARS)}, found none; copy the file again"
        )
    return np.stack([table[name][is_lidar].mean() for name in POSITION])


def read_columns(path: Path, choose: Choose) -> Arrays:
    """Read some columns of a table.

    Args:
        choose: returns the columns to read, given the names of all.

    Raises:
        InputError: if the file is not Feather or is truncated.
    """
    with reading(path, EXPECTED, ADVICE):
        import pyarrow

        with pyarrow.OSFile(str(path)) as file:
            try:
                reader = pyarrow.ipc.open_file(file)
            except pyarrow.ArrowInvalid:
                raise InputError(f"{path}: expected {EXPECTED} of version 2; {ADVICE}") from None
            all_names = reader.schema.names
            columns = choose(all_names)
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
