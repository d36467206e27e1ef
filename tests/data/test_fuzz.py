"""Broken files of every format give a scan or an error of one line, in little memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin

from amvnet.data.formats.find import list_scans
from amvnet.errors import InputError
from amvnet.scan import Scan

from fixtures.memory import memory_below
from fixtures.scan_writers import WRITERS, some_points, write_bag2

CASES = [6, pytest.param(200, marks=pytest.mark.full)]  # of each format
METADATA = "drive/metadata.yaml"
FORMATS = [*WRITERS, METADATA]
HEADER = 400  # bytes: most headers are within them
MAX_MEMORY = 2 << 30  # bytes
TELLING_BYTES = [b"\x00", b"\xff", b"\x7f", b"9", b"-", b" ", b"\n"]
TELLING_BYTES += [bytes(4), b"\xff" * 4, b"\xff" * 8]


@dataclass(frozen=True)
class Change:
    """A change of some bytes of a file.

    Attributes:
        position: the share of the file, or of its header, before the change.
        in_header: whether the position is within the header.
        removed: how many bytes are removed.
        inserted: the bytes that are inserted instead.
    """

    position: float
    in_header: bool
    removed: int
    inserted: bytes

    def apply(self, content: bytearray) -> None:
        length = min(len(content), HEADER) if self.in_header else len(content)
        start = int(self.position * length)
        content[start : start + self.removed] = self.inserted


CHANGES = st.lists(
    st.builds(
        Change,
        position=st.floats(0, 1, exclude_max=True),
        in_header=st.booleans(),
        removed=st.integers(0, 9),
        inserted=st.sampled_from(TELLING_BYTES) | st.binary(max_size=9),
    ),
    min_size=1,
    max_size=6,
)


def change(content: bytes, changes: list[Change], share: float) -> bytes:
    """Return the first share of the content after some changes."""
    changed = bytearray(content)
    for each in changes:
        each.apply(changed)

    return bytes(changed[: int(share * len(changed))])


@pytest.fixture(scope="module")
def contents(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("intact")
    for name, write in WRITERS.items():
        write(folder / name, some_points())
    write_bag2(folder / "drive", {"/lidar": [some_points()]}, StoragePlugin.MCAP)

    return {name: (folder / name).read_bytes() for name in FORMATS}


@pytest.mark.parametrize("cases", CASES)
@pytest.mark.parametrize("name", FORMATS)
def test_a_broken_file_gives_a_scan_or_an_error_of_one_line(
    name: str, cases: int, contents: dict[str, bytes], tmp_path: Path
) -> None:
    file = tmp_path / name
    scan_path = file
    if name == METADATA:
        scan_path = write_bag2(tmp_path / "drive", {"/lidar": [some_points()]}, StoragePlugin.MCAP)

    @settings(
        max_examples=cases,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(
        changes=CHANGES,
        share=st.just(1.0) | st.floats(0, 1),
        random=st.none() | st.binary(max_size=300),
    )
    def check_broken_file(changes: list[Change], share: float, random: bytes | None) -> None:
        file.write_bytes(change(contents[name], changes, share) if random is None else random)

        message = error_of(scan_path)
        assert "\n" not in message
        assert not message or message.startswith(str(scan_path))

    file.write_bytes(contents[name])
    assert error_of(scan_path) == ""
    with memory_below(MAX_MEMORY):
        check_broken_file()


def error_of(path: Path) -> str:
    """Return the InputError of reading all scans of a file; empty if there is none."""
    try:
        for scan in list_scans(path):
            assert isinstance(scan.read().to_scan(), Scan)
    except InputError as error:
        return str(error)
    return ""
