"""Archives that break a rule, made by hand: each is refused in one line, as the official rules do or more strictly."""

from __future__ import annotations

import json
import re
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.errors import InputError
from amvnet.submission import pack as submission
from amvnet.submission.rules import rules_for

from fixtures.submissions import Case, Entries, measured
from fixtures.worlds import run_cli

# ---- archives that break a rule


META = "test/submission.json"
Change = Callable[[bytes], bytes]
# what is packed, words of the message, whether the official validators refuse it, too
Fault = tuple[Callable[[Case], Entries], str, bool]


def change(to: Change, name: str | None = None) -> Callable[[Case], Entries]:
    """The good archive with one file changed; without a name, the first prediction."""
    return lambda case: {**case.good, name or case.first: to(case.good[name or case.first])}


def added(name: str, content: bytes = b"1234") -> Callable[[Case], Entries]:
    return lambda case: {**case.good, name: content}


def without(name: str | None = None) -> Callable[[Case], Entries]:
    return lambda case: {k: v for k, v in case.good.items() if k != (name or case.first)}


def as_type(dtype: str) -> Callable[[Case], Entries]:
    """The classes of the first prediction as another number type."""
    return change(lambda d: (np.frombuffer(d, "<u4") & 0xFFFF).astype(dtype).tobytes())


def ids(*raw: int) -> Callable[[Case], Entries]:
    """The first prediction filled with these ids."""
    return change(lambda d: np.resize(np.array(raw, "<u4"), len(d) // 4).tobytes())


def meta(**values: object) -> Callable[..., Entries]:
    flags = {
        f"use_{kind}": False for kind in ("camera", "lidar", "radar", "map", "external")
    } | values
    kept = {key: value for key, value in flags.items() if value is not None}
    return change(lambda _: json.dumps({"meta": kept}).encode(), META)


BOTH: dict[str, Fault] = {
    "nothing in it": (lambda case: {}, "", True),
    "all in a folder": (
        lambda case: {f"mine/{k}": v for k, v in case.good.items()},
        "below 'mine'",
        True,
    ),
    "a prediction missing": (without(), "found no", True),
    "rubbish of an operating system": (added("__MACOSX/._x", b""), "found __MACOSX/._x;", False),
    "absolute name": (added("/etc/passwd", b"x"), "'/etc/passwd'", False),
    "name that leads out": (added("sequences/../../x", b"x"), "'sequences/../../x'", False),
    "backslashes": (added("lidarseg\\test\\x", b"x"), "and slashes", False),
    "drive": (added("C:x", b"x"), "'C:x'", False),
    "empty prediction": (change(lambda d: b""), "found 0", True),
    "a point too few": (change(lambda d: d[:-4]), "one per point", True),
}
KITTI: dict[str, Fault] = {
    "no folders": (
        lambda case: {k: v for k, v in case.good.items() if k[-1] != "/"},
        "sequences/ ",
        True,
    ),
    "one folder without entry": (
        without("sequences/21/predictions/"),
        "sequences/21/predictions/",
        True,
    ),
    "a prediction too many": (
        added("sequences/08/predictions/000000.label"),
        "only predictions",
        False,
    ),
    "uint8": (as_type("<u1"), "of 8 bits; write the ids as uint32", True),
    "uint16": (as_type("<u2"), "of 16 bits; write the ids as uint32", True),
    "int64": (as_type("<u8"), "of 64 bits; write the ids as uint32", True),
    "float32": (as_type("<f4"), "float32", False),
    "big-endian": (as_type(">u4"), "endian", False),
    "train ids": (ids(*range(20)), "train ids", False),
    "unknown id": (ids(40, 400), "400", False),
    "a description without end": (added("description.txt", bytes(2_000_000)), "2000000", False),
    "scan off disk, empty": (
        added("sequences/11/predictions/000900.label", b""),
        "found 0 bytes",
        False,
    ),
    "scan off disk, odd": (
        added("sequences/11/predictions/000900.label", b"123"),
        "found 3 bytes",
        False,
    ),
    "scan off disk, huge": (
        added("sequences/11/predictions/000900.label", bytes(5_000_000)),
        "000000 ids",
        False,
    ),
    "scan past the last": (
        added("sequences/11/predictions/000921.label"),
        "only predictions",
        False,
    ),
}
LIDARSEG: dict[str, Fault] = {
    "another split": (lambda case: {k.replace("test/", "val/"): v for k, v in case.good.items()}, "--split", True),
    "no submission.json": (without(META), "expected test/submission.json", True),
    "no JSON": (change(lambda d: d[:-1], META), "expected JSON", True),
    "latin-1": (change(lambda d: b"\xe9", META), "expected JSON", True),
    "JSON without end": (change(lambda d: b"[" * 100_000, META), "expected JSON", True),
    "JSON of another kind": (change(lambda d: b"[]", META), "no such object", True),
    "long submission.json": (change(lambda d: d + b" " * 1_000_000, META), "shorten", False),
    "flag missing": (meta(use_map=None), "found 'use_camera'", True),
    "flag too many": (meta(use_sonar=True), "use_sonar", True),
    "flag as text": (meta(use_radar="false"), "true or false for use_radar", True),
    "flag as number": (meta(use_lidar=1), "true or false for use_lidar", True),
    "a token too many": (added("lidarseg/test/x_lidarseg.bin", b"1"), "only predictions", False),
    "no class": (change(lambda d: b"\0" + d[1:]), "found 0 for 1 of", True),
    "class 17": (change(lambda d: b"\x11" + d[1:]), "found 17;", True),
    "255": (change(lambda d: b"\xff" + d[1:]), "found 255;", True),
    "uint32": (change(lambda d: np.frombuffer(d, "u1").astype("<u4").tobytes()), "of 32 bits; write", True),
}  # fmt: skip
FAULTS = {"semantickitti": BOTH | KITTI, "nuscenes": BOTH | LIDARSEG}
BROKEN = [(name, fault) for name, faults in FAULTS.items() for fault in faults]


@pytest.mark.parametrize(("name", "fault"), BROKEN)
def test_a_broken_rule_is_named_in_one_line(
    name: str, fault: str, cases: dict[str, Case], tmp_path: Path
) -> None:
    case, (make, words, refused) = cases[name], FAULTS[name][fault]
    path = case.pack(tmp_path / "s.zip", make(case))
    error = line_of(case, path)
    assert all(part in error for part in (str(path), "expected", "found", "; ", words)), error
    try:
        said = case.official(path, case.data)
    except (ValueError, RecursionError, TypeError):
        said = ["unreadable"]
    assert bool(said) == refused


@pytest.mark.parametrize("name", FAULTS)
def test_kinds_of_faults_have_messages_of_their_own(
    name: str, cases: dict[str, Case], tmp_path: Path
) -> None:
    lines = [
        line_of(cases[name], cases[name].pack(tmp_path / "s.zip", make(cases[name])))
        for make, *_ in FAULTS[name].values()
    ]
    assert (
        len({re.sub(r"\d+|'[^']*'|\S*/\S*", "#", line) for line in lines}) >= 12
    )  # less numbers and names


def line_of(case: Case, path: Path) -> str:
    """The one line that is said of a bad archive."""
    code, error = run_cli("submit", case.spec, "--check", path)
    assert (code, error.count("\n")) == (2, 1), error
    return error


def patched(path: Path, at: Callable[[bytes], int], change: Callable[[int], int]) -> Path:
    data = bytearray(path.read_bytes())
    place = at(bytes(data))
    data[place] = change(data[place])
    path.write_bytes(data)
    return path


LAST = b"PK\x01\x02"  # the signature of an entry in the central directory


def last_entry(field: int) -> Callable[[bytes], int]:
    return lambda data: data.rindex(LAST) + field


RUINS: dict[str, tuple[Callable[[Case, Path], object], str]] = {
    "no archive": (lambda c, p: p.write_bytes(b"no archive"), "broken or another file"),
    "empty file": (lambda c, p: p.write_bytes(b""), "broken or another file"),
    "cut off": (lambda c, p: p.write_bytes(c.pack(p).read_bytes()[:-30]), "broken or another file"),
    "no beginning": (lambda c, p: p.write_bytes(c.pack(p).read_bytes()[2000:]), "broken"),
    "another ending": (lambda c, p: c.pack(p).rename(p.with_suffix(".tar")), "no file"),
    "encrypted": (lambda c, p: patched(c.pack(p), last_entry(8), lambda b: b | 1), "password"),
    "flipped bit": (
        lambda c, p: patched(
            c.pack(p, method=0), lambda d: d.index(c.good[c.first]) + 5, lambda b: b ^ 16
        ),
        "broken",
    ),
    "deflate64": (lambda c, p: patched(c.pack(p), last_entry(10), lambda b: 9), "method 9"),
    "bzip2": (lambda c, p: c.pack(p, method=zipfile.ZIP_BZIP2), "method 12"),
    "stored size that is a lie": (
        lambda c, p: patched(c.pack(p, method=0), last_entry(24), lambda b: b + 1),
        "",
    ),
    "size that is a lie": (lambda c, p: patched(c.pack(p), last_entry(24), lambda b: b ^ 4), ""),
}


@pytest.mark.parametrize("ruin", RUINS)
def test_a_ruined_archive_is_one_line(ruin: str, case: Case, tmp_path: Path) -> None:
    path = tmp_path / "s.zip"
    RUINS[ruin][0](case, path)
    assert RUINS[ruin][1] in line_of(case, path)


def test_no_flipped_byte_is_a_traceback(case: Case, tmp_path: Path) -> None:
    path, rng = case.pack(tmp_path / "s.zip"), np.random.default_rng(0)
    rules, good = rules_for(open_dataset(case.spec), "test"), path.read_bytes()
    refused = 0
    for _ in range(300):
        data = bytearray(good)
        data[rng.integers(len(data))] = rng.integers(256)
        path.write_bytes(data)
        try:
            submission.check(rules, path)
        except InputError:
            refused += 1
    assert refused > 100


def test_a_name_twice_is_found(case: Case, tmp_path: Path) -> None:
    path = case.pack(tmp_path / "s.zip")
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr(case.first, case.good[case.first])
    assert "2 times" in line_of(case, path)


@pytest.mark.parametrize("place", ["description.txt", None])
def test_a_bomb_is_not_unpacked(place: str | None, cases: dict[str, Case], tmp_path: Path) -> None:
    case, size = cases["semantickitti"], 100_000_000
    path = case.pack(
        tmp_path / "s.zip", {k: v for k, v in case.good.items() if k != (place or case.first)}
    )
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open(place or case.first, "w") as file,
    ):
        for _ in range(size // 1_000_000):
            file.write(bytes(1_000_000))
    assert path.stat().st_size < size / 100
    error, peak = measured(lambda: run_cli("submit", case.spec, "--check", path)[1])
    assert "found 100000000" in error or "found 25000000" in error
    assert peak < size / 10
