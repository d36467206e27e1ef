"""Predictions that break a rule are refused in one line, as by the official rules or strictly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fixtures.commands import refusal
from fixtures.submissions import Case, Entries, write_files


@dataclass
class Fault:
    """Bad predictions, words of their message, and whether the official validator refuses them."""

    entries: Callable[[Case], Entries]
    words: str
    official: bool


def changed(change: Callable[[bytes], bytes]) -> Callable[[Case], Entries]:
    def entries(case: Case) -> Entries:
        return {**case.good, case.first: change(case.good[case.first])}

    return entries


def without_the_first(case: Case) -> Entries:
    return {name: content for name, content in case.good.items() if name != case.first}


def nothing(case: Case) -> Entries:
    return {}


def as_type(dtype: str) -> Callable[[Case], Entries]:
    def convert(data: bytes) -> bytes:
        classes = np.frombuffer(data, "<u4") & 0xFFFF
        return classes.astype(dtype).tobytes()

    return changed(convert)


def uint8_as_uint32(data: bytes) -> bytes:
    return np.frombuffer(data, "u1").astype("<u4").tobytes()


def filled(*raw_ids: int) -> Callable[[Case], Entries]:
    return changed(lambda data: np.resize(np.array(raw_ids, "<u4"), len(data) // 4).tobytes())


BOTH = {
    "no entries": Fault(nothing, "found no", official=True),
    "a prediction missing": Fault(without_the_first, "found no", official=True),
    "empty prediction": Fault(changed(lambda data: b""), "found 0", official=True),
    "a point too few": Fault(changed(lambda data: data[:-4]), "one per point", official=True),
}
SEMANTICKITTI = {
    "uint8": Fault(as_type("<u1"), "of 8 bits; write the ids as uint32", official=True),
    "uint16": Fault(as_type("<u2"), "of 16 bits; write the ids as uint32", official=True),
    "int64": Fault(as_type("<u8"), "of 64 bits; write the ids as uint32", official=True),
    "float32": Fault(as_type("<f4"), "float32", official=False),
    "big-endian": Fault(as_type(">u4"), "endian", official=False),
    "train ids": Fault(filled(*range(20)), "train ids", official=False),
    "unknown id": Fault(filled(40, 400), "400", official=False),
}
NUSCENES = {
    "no class": Fault(changed(lambda data: b"\0" + data[1:]), "found 0 for 1 of", official=True),
    "class 17": Fault(changed(lambda data: b"\x11" + data[1:]), "found 17;", official=True),
    "255": Fault(changed(lambda data: b"\xff" + data[1:]), "found 255;", official=True),
    "uint32": Fault(changed(uint8_as_uint32), "of 32 bits; write", official=True),
}
FAULTS = {"semantickitti": BOTH | SEMANTICKITTI, "nuscenes": BOTH | NUSCENES}
BROKEN = [(_benchmark, _name) for _benchmark, _faults in FAULTS.items() for _name in _faults]


@pytest.mark.parametrize(("layout", "name"), BROKEN)
def test_a_broken_rule_is_named_in_one_line(
    layout: str, name: str, cases: dict[str, Case], tmp_path: Path
) -> None:
    case = cases[layout]
    fault = FAULTS[layout][name]
    entries = fault.entries(case)
    folder = tmp_path / "predictions"
    folder.mkdir()
    write_files(folder, entries)

    out = tmp_path / "s.zip"
    error = refusal("submit", case.spec, "--predictions", folder, "--out", out)
    for word in (str(folder), "expected", "found", "; ", fault.words):
        assert word in error
    assert not out.exists()

    archive = case.pack(tmp_path / "as_it_is.zip", entries)
    assert bool(case.official(archive, case.data)) == fault.official
