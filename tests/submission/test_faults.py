"""Archives that break a rule are refused in one line, as by the official rules or more strictly."""

from __future__ import annotations

import json
import re
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.errors import InputError
from amvnet.submission import pack as submission
from amvnet.submission.rules import rules_for

from fixtures.submissions import SOURCES, Case, Entries, measured
from fixtures.worlds import run_cli

META = "test/submission.json"
LONG_JSON = b"[" * 100_000  # nested too deeply for a parser


def refused(case: Case, path: Path) -> str:
    """Check that an archive is refused, and return the one line that says why."""
    code, error = run_cli("submit", case.spec, "--check", path)
    assert code == 2
    assert error.count("\n") == 1, error
    return error


# --- archives that break a rule ---


@dataclass
class Fault:
    """A kind of bad archive.

    Attributes:
        entries: returns its content.
        words: words of the message.
        official: whether the official validator refuses it, too.
    """

    entries: Callable[[Case], Entries]
    words: str
    official: bool


Change = Callable[[bytes], bytes]


def changed(change: Change, name: str | None = None) -> Callable[[Case], Entries]:
    """The good archive with one file changed, by default the first prediction."""

    def entries(case: Case) -> Entries:
        changed_name = name or case.first
        return {**case.good, changed_name: change(case.good[changed_name])}

    return entries


def added(name: str, content: bytes = b"1234") -> Callable[[Case], Entries]:
    """The good archive with one more file."""
    return lambda case: {**case.good, name: content}


def without(name: str | None = None) -> Callable[[Case], Entries]:
    """The good archive without one entry, by default the first prediction."""

    def entries(case: Case) -> Entries:
        rest = dict(case.good)
        del rest[name or case.first]
        return rest

    return entries


def renamed(old: str, new: str) -> Callable[[Case], Entries]:
    """The good archive with a part of every name replaced."""
    return lambda case: {name.replace(old, new): data for name, data in case.good.items()}


def nothing(case: Case) -> Entries:
    return {}


def in_a_folder(case: Case) -> Entries:
    return {f"mine/{name}": data for name, data in case.good.items()}


def without_folders(case: Case) -> Entries:
    return {name: data for name, data in case.good.items() if not name.endswith("/")}


def as_type(dtype: str) -> Callable[[Case], Entries]:
    """The classes of the first prediction in another number type."""

    def convert(data: bytes) -> bytes:
        classes = np.frombuffer(data, "<u4") & 0xFFFF
        return classes.astype(dtype).tobytes()

    return changed(convert)


def uint8_as_uint32(data: bytes) -> bytes:
    return np.frombuffer(data, "u1").astype("<u4").tobytes()


def filled(*raw_ids: int) -> Callable[[Case], Entries]:
    """The first prediction filled with these ids."""
    return changed(lambda data: np.resize(np.array(raw_ids, "<u4"), len(data) // 4).tobytes())


def flags(**values: object) -> Callable[[Case], Entries]:
    """The good archive with some flags of submission.json changed, or removed if None."""
    meta = {**dict.fromkeys(SOURCES, False), **values}
    for key, value in values.items():
        if value is None:
            del meta[key]
    return changed(lambda data: json.dumps({"meta": meta}).encode(), META)


def off_disk(content: bytes) -> Callable[[Case], Entries]:
    """The good archive with a prediction for a scan that is not on disk."""
    return added("sequences/11/predictions/000900.label", content)


BOTH = {
    "no entries": Fault(nothing, "", official=True),
    "all in a folder": Fault(in_a_folder, "below 'mine'", official=True),
    "a prediction missing": Fault(without(), "found no", official=True),
    "a system file": Fault(added("__MACOSX/._x", b""), "found __MACOSX/._x;", official=False),
    "absolute name": Fault(added("/etc/passwd", b"x"), "'/etc/passwd'", official=False),
    "name that leads out": Fault(
        added("sequences/../../x", b"x"), "'sequences/../../x'", official=False
    ),
    "backslashes": Fault(added("lidarseg\\test\\x", b"x"), "and slashes", official=False),
    "drive": Fault(added("C:x", b"x"), "'C:x'", official=False),
    "empty prediction": Fault(changed(lambda data: b""), "found 0", official=True),
    "a point too few": Fault(changed(lambda data: data[:-4]), "one per point", official=True),
}
SEMANTICKITTI = {
    "no folders": Fault(without_folders, "sequences/ ", official=True),
    "one folder without entry": Fault(
        without("sequences/21/predictions/"), "sequences/21/predictions/", official=True
    ),
    "a prediction too many": Fault(
        added("sequences/08/predictions/000000.label"), "only predictions", official=False
    ),
    "uint8": Fault(as_type("<u1"), "of 8 bits; write the ids as uint32", official=True),
    "uint16": Fault(as_type("<u2"), "of 16 bits; write the ids as uint32", official=True),
    "int64": Fault(as_type("<u8"), "of 64 bits; write the ids as uint32", official=True),
    "float32": Fault(as_type("<f4"), "float32", official=False),
    "big-endian": Fault(as_type(">u4"), "endian", official=False),
    "train ids": Fault(filled(*range(20)), "train ids", official=False),
    "unknown id": Fault(filled(40, 400), "400", official=False),
    "a huge description": Fault(
        added("description.txt", bytes(2_000_000)), "2000000", official=False
    ),
    "scan off disk, empty": Fault(off_disk(b""), "found 0 bytes", official=False),
    "scan off disk, odd size": Fault(off_disk(b"123"), "found 3 bytes", official=False),
    "scan off disk, huge": Fault(off_disk(bytes(5_000_000)), "000000 ids", official=False),
    "scan past the last": Fault(
        added("sequences/11/predictions/000921.label"), "only predictions", official=False
    ),
}
NUSCENES = {
    "another split": Fault(renamed("test/", "val/"), "--split", official=True),
    "no submission.json": Fault(without(META), "expected test/submission.json", official=True),
    "broken JSON": Fault(changed(lambda data: data[:-1], META), "expected JSON", official=True),
    "latin-1": Fault(changed(lambda data: b"\xe9", META), "expected JSON", official=True),
    "endless JSON": Fault(changed(lambda data: LONG_JSON, META), "expected JSON", official=True),
    "a JSON list": Fault(changed(lambda data: b"[]", META), "no such object", official=True),
    "long submission.json": Fault(
        changed(lambda data: data + b" " * 1_000_000, META), "shorten", official=False
    ),
    "flag missing": Fault(flags(use_map=None), "found 'use_camera'", official=True),
    "flag too many": Fault(flags(use_sonar=True), "use_sonar", official=True),
    "flag as text": Fault(flags(use_radar="false"), "true or false for use_radar", official=True),
    "flag as number": Fault(flags(use_lidar=1), "true or false for use_lidar", official=True),
    "a token too many": Fault(
        added("lidarseg/test/x_lidarseg.bin", b"1"), "only predictions", official=False
    ),
    "no class": Fault(changed(lambda data: b"\0" + data[1:]), "found 0 for 1 of", official=True),
    "class 17": Fault(changed(lambda data: b"\x11" + data[1:]), "found 17;", official=True),
    "255": Fault(changed(lambda data: b"\xff" + data[1:]), "found 255;", official=True),
    "uint32": Fault(changed(uint8_as_uint32), "of 32 bits; write", official=True),
}
FAULTS = {"semantickitti": BOTH | SEMANTICKITTI, "nuscenes": BOTH | NUSCENES}
BROKEN = []
for _benchmark, _faults in FAULTS.items():
    for _name in _faults:
        BROKEN.append((_benchmark, _name))


def is_refused_officially(case: Case, path: Path) -> bool:
    try:
        return bool(case.official(path, case.data))
    except (ValueError, RecursionError, TypeError):
        return True  # it cannot be read


@pytest.mark.parametrize(("layout", "name"), BROKEN)
def test_a_broken_rule_is_named_in_one_line(
    layout: str, name: str, cases: dict[str, Case], tmp_path: Path
) -> None:
    case = cases[layout]
    fault = FAULTS[layout][name]
    path = case.pack(tmp_path / "s.zip", fault.entries(case))

    error = refused(case, path)
    for word in (str(path), "expected", "found", "; ", fault.words):
        assert word in error
    assert is_refused_officially(case, path) == fault.official


@pytest.mark.parametrize("layout", FAULTS)
def test_kinds_of_faults_have_messages_of_their_own(
    layout: str, cases: dict[str, Case], tmp_path: Path
) -> None:
    case = cases[layout]
    messages = set()
    for fault in FAULTS[layout].values():
        error = refused(case, case.pack(tmp_path / "s.zip", fault.entries(case)))
        messages.add(re.sub(r"\d+|'[^']*'|\S*/\S*", "#", error))  # without numbers and names
    assert len(messages) >= 12


# --- broken archives ---


CENTRAL_ENTRY = b"PK\x01\x02"  # the signature of an entry in the central directory
FLAGS = 8  # offsets in such an entry
METHOD = 10
SIZE = 24


def patch(path: Path, offset: int, value: int) -> None:
    """Change one byte of a file."""
    data = bytearray(path.read_bytes())
    data[offset] = value
    path.write_bytes(data)


def patch_last_entry(path: Path, field: int, change: Callable[[int], int]) -> None:
    """Change one byte of the last entry in the central directory."""
    data = path.read_bytes()
    offset = data.rindex(CENTRAL_ENTRY) + field
    patch(path, offset, change(data[offset]))


def not_an_archive(case: Case, path: Path) -> None:
    path.write_bytes(b"not an archive")


def empty_file(case: Case, path: Path) -> None:
    path.write_bytes(b"")


def cut_off(case: Case, path: Path) -> None:
    path.write_bytes(case.pack(path).read_bytes()[:-30])


def no_beginning(case: Case, path: Path) -> None:
    path.write_bytes(case.pack(path).read_bytes()[2000:])


def another_ending(case: Case, path: Path) -> None:
    case.pack(path).rename(path.with_suffix(".tar"))


def encrypted(case: Case, path: Path) -> None:
    patch_last_entry(case.pack(path), FLAGS, lambda byte: byte | 1)


def flipped_bit(case: Case, path: Path) -> None:
    data = case.pack(path, method=zipfile.ZIP_STORED).read_bytes()
    offset = data.index(case.good[case.first]) + 5
    patch(path, offset, data[offset] ^ 16)


def deflate64(case: Case, path: Path) -> None:
    patch_last_entry(case.pack(path), METHOD, lambda byte: 9)


def bzip2(case: Case, path: Path) -> None:
    case.pack(path, method=zipfile.ZIP_BZIP2)


def wrong_stored_size(case: Case, path: Path) -> None:
    case.pack(path, method=zipfile.ZIP_STORED)
    patch_last_entry(path, SIZE, lambda byte: byte + 1)


def wrong_deflated_size(case: Case, path: Path) -> None:
    patch_last_entry(case.pack(path), SIZE, lambda byte: byte ^ 4)


@pytest.mark.parametrize(
    ("write_broken", "words"),
    [
        (not_an_archive, "broken or another file"),
        (empty_file, "broken or another file"),
        (cut_off, "broken or another file"),
        (no_beginning, "broken"),
        (another_ending, "no file"),
        (encrypted, "password"),
        (flipped_bit, "broken"),
        (deflate64, "method 9"),
        (bzip2, "method 12"),
        (wrong_stored_size, ""),
        (wrong_deflated_size, ""),
    ],
)
def test_a_broken_archive_is_refused_in_one_line(
    write_broken: Callable[[Case, Path], None], words: str, case: Case, tmp_path: Path
) -> None:
    path = tmp_path / "s.zip"
    write_broken(case, path)
    assert words in refused(case, path)


def test_no_flipped_byte_is_a_traceback(case: Case, tmp_path: Path) -> None:
    path = case.pack(tmp_path / "s.zip")
    good = path.read_bytes()
    rules = rules_for(open_dataset(case.spec), "test")
    rng = np.random.default_rng(0)

    errors = 0
    for _ in range(300):
        data = bytearray(good)
        data[rng.integers(len(data))] = rng.integers(256)
        path.write_bytes(data)
        try:
            submission.check(rules, path)
        except InputError:
            errors += 1

    assert errors > 100


def test_a_duplicate_name_is_refused(case: Case, tmp_path: Path) -> None:
    path = case.pack(tmp_path / "s.zip")
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr(case.first, case.good[case.first])
    assert "2 times" in refused(case, path)


@pytest.mark.parametrize("name", ["description.txt", "sequences/11/predictions/000000.label"])
def test_a_zip_bomb_is_not_unpacked(name: str, cases: dict[str, Case], tmp_path: Path) -> None:
    case = cases["semantickitti"]
    size = 100_000_000
    entries = dict(case.good)
    entries.pop(name, None)
    path = case.pack(tmp_path / "s.zip", entries)
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open(name, "w") as file,
    ):
        for _ in range(size // 1_000_000):
            file.write(bytes(1_000_000))

    assert path.stat().st_size < size / 100

    error, peak = measured(lambda: refused(case, path))
    assert isinstance(error, str)
    assert "found 100000000" in error or "found 25000000" in error  # bytes, or labels
    assert peak < size / 10
