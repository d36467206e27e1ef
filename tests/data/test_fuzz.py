"""Broken files of every format end in a scan or in one line, soon and in little memory."""

from __future__ import annotations

import resource
import sys
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin

from amvnet.data.formats.detect import scans_in_file
from amvnet.errors import InputError
from amvnet.scan import Scan

from fixtures.scan_writers import WRITERS, some_points, write_bag2

CASES = 200  # of each format
SLOW_CASES = 25  # of the one that starts a process for each
METADATA = "drive/metadata.yaml"
FORMATS = [*WRITERS, METADATA]
BEGIN = 400  # bytes: most headers are within them
LONGEST, MOST_MEMORY = timedelta(seconds=10), 2 << 30
Change = Callable[[bytes], bytes]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """A whole file of every format."""
    folder = tmp_path_factory.mktemp("whole")
    for name, write in WRITERS.items():
        write(folder / name, some_points())
    write_bag2(folder / "drive", {"/lidar": [some_points()]}, StoragePlugin.MCAP)
    return {name: (folder / name).read_bytes() for name in FORMATS}


def changes() -> st.SearchStrategy[list[tuple[float, bool, int, bytes]]]:
    """Where (as a share of the file, or of its beginning), how many bytes go there, and what comes in their place."""
    telling = st.sampled_from(
        [b"\x00", b"\xff", b"\x7f", b"9", b"-", b" ", b"\n", bytes(4), b"\xff" * 4, b"\xff" * 8]
    )
    place = st.floats(0, 1, exclude_max=True)
    change = st.tuples(place, st.booleans(), st.integers(0, 9), telling | st.binary(max_size=9))
    return st.lists(change, min_size=1, max_size=6)


def changed(content: bytes, how: list[tuple[float, bool, int, bytes]], kept: float) -> bytes:
    """The content after some changes, cut off after a share of it."""
    broken = bytearray(content)
    for share, begin, gone, come in how:
        place = int(share * min(len(broken), BEGIN if begin else len(broken)))
        broken[place : place + gone] = come
    return bytes(broken[: int(kept * len(broken))])


@pytest.mark.parametrize("name", FORMATS)
def test_a_broken_file_ends_in_a_scan_or_in_one_line(
    name: str, whole: dict[str, bytes], tmp_path: Path
) -> None:
    content, path = whole[name], tmp_path / ("drive" if name == METADATA else name)
    if name == METADATA:
        write_bag2(tmp_path / "drive", {"/lidar": [some_points()]}, StoragePlugin.MCAP)

    @settings(
        max_examples=SLOW_CASES if name.endswith(".laz") else CASES,
        deadline=LONGEST,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(
        how=changes(),
        kept=st.just(1.0) | st.floats(0, 1),
        random=st.none() | st.binary(max_size=300),
    )
    def breaks(
        how: list[tuple[float, bool, int, bytes]], kept: float, random: bytes | None
    ) -> None:
        (tmp_path / name).write_bytes(changed(content, how, kept) if random is None else random)
        ends_well(path)

    (tmp_path / name).write_bytes(content)
    assert refusal(path) == ""
    breaks()
    assert most_memory() < MOST_MEMORY


def ends_well(path: Path) -> None:
    """Every scan of a file is read, or refused in one line that names the file."""
    message = refusal(path)
    assert "\n" not in message
    assert message.startswith(str(path) if message else "")


def refusal(path: Path) -> str:
    """What is said of a file that is refused; nothing where all of its scans are read."""
    try:
        for scan in scans_in_file(path):
            assert isinstance(scan.read().to_scan(), Scan)
    except InputError as error:
        return str(error)
    return ""


def most_memory() -> int:
    """Bytes that this process had at most."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
