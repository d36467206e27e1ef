"""Small files that claim or unpack to gigabytes are read or refused in little memory."""

from __future__ import annotations

import bz2
import sqlite3
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import yaml
from backports import zstd
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from amvnet.data.class_maps import class_map
from amvnet.data.formats import reader_process
from amvnet.data.formats.find import list_scans
from amvnet.errors import InputError

from fixtures.marks import with_quick
from fixtures.memory import memory_below
from fixtures.scan_writers import some_points, write_bag1, write_bag2, write_las

LARGEST_FILE = 15_000_000  # bytes of a file
MEMORY = 1 << 30  # bytes
TOO_LONG = "takes too long"

# --- packed zeros ---


def deflated(count: int) -> bytes:
    """Return some packed megabytes of zeros, of which only one is packed."""
    compressor = zlib.compressobj(9, wbits=-15)
    packed = compressor.compress(bytes(1 << 20)) + compressor.flush(zlib.Z_FULL_FLUSH)
    return packed * count + compressor.flush(zlib.Z_FINISH)


def zipped(name: str, start: bytes, size: int) -> bytes:
    """Return an archive of one file of some bytes and then `size` megabytes of zeros."""
    compressor = zlib.compressobj(9, wbits=-15)
    packed = compressor.compress(start) + compressor.flush(zlib.Z_FULL_FLUSH) + deflated(size)
    fields = (20, 0, 8, 0, 0, 0, len(packed), len(start) + (size << 20), len(name), 0)
    local = b"PK\3\4" + struct.pack("<HHHHHIIIHH", *fields) + name.encode() + packed
    entry = b"PK\1\2" + struct.pack("<HHHHHHIIIHHHHHII", 20, *fields, 0, 0, 0, 0, 0)
    entry += name.encode()
    end = struct.pack("<HHHHIIH", 0, 0, 1, 1, len(entry), len(local), 0)
    return local + entry + b"PK\5\6" + end


def write_npz(path: Path, description: object, shape: tuple[int, ...], size: int) -> None:
    text = str({"descr": description, "fortran_order": False, "shape": shape})
    header = b"\x93NUMPY\1\0" + struct.pack("<H", len(text) + 1) + text.encode() + b"\n"
    path.write_bytes(zipped("points.npy", header, size))


def columns_bomb(path: Path) -> None:
    write_npz(path, "<f4", (1_000_000, 1000), 4000)


def records_bomb(path: Path) -> None:
    write_npz(path, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("", "|V100000000")], (40,), 4000)


def gzip_bomb(path: Path) -> None:
    end = struct.pack("<II", 0, (4000 << 20) % (1 << 32))
    path.write_bytes(b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + deflated(4000) + end)


def sweep_of_zeros(path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    feather = pytest.importorskip("pyarrow.feather")
    column = pyarrow.array(np.zeros(60_000_000, np.float32))
    table = pyarrow.table([column, column, column], names=["x", "y", "z"])
    feather.write_feather(table, path, compression="zstd", chunksize=60_000_000)


# --- PCD ---


def write_pcd(path: Path, points: int, count: int, packed: bytes) -> None:
    header = f"FIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 {count - 12}\n"
    header += f"POINTS {points}\nDATA binary_compressed\n"
    path.write_bytes(header.encode() + struct.pack("<II", len(packed), points * count) + packed)


def lzf_bomb(path: Path) -> None:
    repetition = b"\xe0\xff\0"  # 264 zeros
    write_pcd(path, 5_000_000, 256, b"\0\0" + repetition * (1_280_000_000 // 264))


def slow_lzf(path: Path) -> None:
    size = 7_000_000 * 3
    write_pcd(path, size // 12, 12, b"\0\0" + b"\x20\0" * (size // 3 - 1) + b"\1\0\0")


def largest_lzf(path: Path) -> None:
    size = 10_000_000 * 32
    repetitions, rest = divmod(size - 1, 264)
    write_pcd(path, 10_000_000, 32, b"\0\0" + b"\xe0\xff\0" * repetitions + b"\0\0" * rest)


# --- bags ---


def write_mcap(path: Path, compression: str, packed: bytes, size: int) -> None:
    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def record(kind: int, data: bytes) -> bytes:
        return struct.pack("<BQ", kind, len(data)) + data

    magic = b"\x89MCAP0\r\n"
    chunk = struct.pack("<QQQI", 0, 1, size, 0) + text(compression)
    chunk += struct.pack("<Q", len(packed)) + packed
    footer = record(2, bytes(20))
    path.write_bytes(magic + record(1, text("ros2") + text("")) + record(6, chunk) + footer + magic)


def zstd_of_zeros(count: int) -> bytes:
    return zstd.compress(bytes(100 << 20)) * count


def mcap_zstd(path: Path) -> None:
    write_mcap(path, "zstd", zstd_of_zeros(40), 4000 << 20)


def mcap_lz4(path: Path) -> None:
    with lz4.frame.LZ4FrameCompressor() as compressor:
        packed = compressor.begin()
        packed += b"".join(compressor.compress(bytes(4 << 20)) for _ in range(700))
        packed += compressor.flush()
    write_mcap(path, "lz4", packed, 2800 << 20)


def ros1_bz2(path: Path) -> None:
    packed = bz2.compress(bytes(100 << 20)) * 40

    class Writer(BagWriter):
        def open(self) -> None:
            super().open()
            self.compressor = lambda data: bz2.compress(data) + packed

    write_bag1(path, {"/lidar": [some_points()]}, "BZ2", Writer)


def zstd_files(path: Path) -> None:
    write_bag2(path, {"/lidar": [some_points()]}, StoragePlugin.MCAP, CompressionMode.FILE)
    (file,) = path.glob("*.zstd")
    file.write_bytes(file.read_bytes() + zstd_of_zeros(40))


def many_zstd_files(path: Path) -> None:
    """Write a bag of 40 files, each of which is small enough when it is unpacked."""
    write_bag2(path, {"/lidar": [some_points()]}, StoragePlugin.MCAP, CompressionMode.FILE)
    (file,) = path.glob("*.zstd")
    packed = file.read_bytes() + zstd.compress(bytes(50 << 20))
    others = [f"part{index}.mcap.zstd" for index in range(40)]
    for name in others:
        (path / name).write_bytes(packed)

    metadata = path / "metadata.yaml"
    content = yaml.safe_load(metadata.read_text())
    content["rosbag2_bagfile_information"]["relative_file_paths"] = others
    metadata.write_text(yaml.safe_dump(content))


def zstd_messages(path: Path) -> None:
    """Write a message of four gigabytes into a database."""
    write_bag2(path, {"/lidar": [some_points()]}, StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
    (file,) = path.glob("*.db3*")
    with sqlite3.connect(file) as database:
        database.execute("UPDATE messages SET data = ?", (zstd_of_zeros(40),))


def metadata_of_merges(path: Path) -> None:
    write_bag2(path, {"/lidar": [some_points()]}, StoragePlugin.MCAP)
    with (path / "metadata.yaml").open("a") as file:
        file.write(merges())


ENDLESS = "AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT"


def database(path: Path, view: str) -> None:
    write_bag2(path.with_suffix(""), {"/lidar": [some_points()]}, StoragePlugin.SQLITE3)
    (file,) = path.with_suffix("").glob("*.db3")
    name = view.split()[0]
    connection = sqlite3.connect(file)
    connection.execute(f"DROP TABLE {name}")
    connection.execute(f"CREATE VIEW {view} FROM n")
    connection.commit()
    connection.close()
    file.rename(path)


def endless_schema(path: Path) -> None:
    database(path, f"schema {ENDLESS} max(i) AS schema_version")


def endless_definitions(path: Path) -> None:
    names = ("id", "topic_type", "encoding", "encoded_message_definition", "type_description_hash")
    database(path, f"message_definitions {ENDLESS} " + ", ".join(f"i AS {name}" for name in names))


# --- other formats ---


def laz_of_many_points(path: Path) -> None:
    content = bytearray(write_las(path, some_points()).read_bytes())
    struct.pack_into("<I", content, 107, 10_000_000)
    path.write_bytes(content)


def long_text(path: Path) -> None:
    path.write_bytes(b"1 2 3\n" * 2_000_000)


def long_number(path: Path) -> None:
    path.write_bytes(b"1 2 3\n" * 50 + b"1 2 3" + b"0" * 14_000_000 + b"\n")


def pcd_of_text(path: Path) -> None:
    lines = 2_000_000
    header = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS {lines}\nDATA ascii\n"
    path.write_bytes(header.encode() + b"1 2 3\n" * lines)


def merges() -> str:
    """Return ten lines of YAML that merge 10^12 mappings."""
    lines = ["a0: &a0 {k: 1}"]
    for level in range(12):
        lines.append(f"a{level + 1}: &a{level + 1} {{<<: [{', '.join([f'*a{level}'] * 10)}]}}")
    return "\n".join(lines) + "\n"


def yaml_of_merges(path: Path) -> None:
    path.write_text(merges())


def yaml_of_aliases(path: Path) -> None:
    lines = ["labels:", "  0: &a0 [x, x]"]
    lines += [f"  {i + 1}: &a{i + 1} [{', '.join([f'*a{i}'] * 10)}]" for i in range(12)]
    path.write_text("\n".join(lines))


# By the name of the file: what reads it, what writes it, and what the error says; empty if it is
# read.
BOMBS: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "columns.npz": ("scan", columns_bomb, "4000000000"),
    "records.npz": ("scan", records_bomb, "4000"),
    "bomb.pcd": ("scan", lzf_bomb, "1280000000"),
    "slow.pcd": ("scan", slow_lzf, "0, 0, 0"),
    "largest.pcd": ("scan", largest_lzf, "0, 0, 0"),
    "zstd.mcap": ("scan", mcap_zstd, "zstd.mcap"),
    "lz4.mcap": ("scan", mcap_lz4, "lz4.mcap"),
    "bz2.bag": ("scan", ros1_bz2, "bz2.bag"),
    "zstd_files": ("scan", zstd_files, "zstd_files"),
    "many_zstd_files": ("scan", many_zstd_files, "unpacked"),
    "zstd_messages": ("scan", zstd_messages, "zstd_messages"),
    "metadata": ("scan", metadata_of_merges, TOO_LONG),
    "schema.db3": ("scan", endless_schema, TOO_LONG),
    "definitions.db3": ("scan", endless_definitions, "definitions.db3"),
    "bomb.bin.gz": ("scan", gzip_bomb, "bomb.bin.gz"),
    "zeros.feather": ("scan", sweep_of_zeros, "zeros.feather"),
    "many.las": ("scan", laz_of_many_points, "many.las"),
    "long.xyz": ("scan", long_text, ""),
    "number.xyz": ("scan", long_number, ""),
    "text.pcd": ("scan", pcd_of_text, ""),
    "merges.yaml": ("classes", yaml_of_merges, "alias"),
    "aliases.yaml": ("classes", yaml_of_aliases, "alias"),
}


# A bomb of each kind: what its header claims is too much, or the process that reads it meets its
# limit of memory, of a file's size or of time.
QUICK = ["columns.npz", "bomb.pcd", "lz4.mcap", "bomb.bin.gz"]
QUICK += ["schema.db3", "number.xyz", "merges.yaml"]


def write_bomb(name: str, folder: Path) -> Path:
    path = folder / name
    BOMBS[name][1](path)
    files = [path] if path.is_file() else list(path.iterdir())
    assert sum(file.stat().st_size for file in files) < LARGEST_FILE
    return path


def check_message(name: str, message: str) -> None:
    words = BOMBS[name][2]
    assert words in message
    assert bool(words) == bool(message)
    assert "\n" not in message
    # All but those without an end are refused for another reason than the time.
    assert (TOO_LONG in message) == (words == TOO_LONG)


def allowed_seconds(name: str) -> float:
    """Return the limit of time: little for a bomb without an end, which meets it anyway."""
    return 0.0 if BOMBS[name][2] == TOO_LONG else reader_process.SECONDS


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
@pytest.mark.parametrize("name", with_quick(BOMBS, QUICK))
def test_a_bomb_is_read_or_refused_in_little_memory(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader_process, "SECONDS", allowed_seconds(name))
    path = write_bomb(name, tmp_path)
    message = ""
    with memory_below(MEMORY):
        try:
            if BOMBS[name][0] == "classes":
                class_map(str(path))
            else:
                for scan in list_scans(path):
                    scan.read().to_scan()
        except InputError as error:
            message = str(error)
    check_message(name, message)
