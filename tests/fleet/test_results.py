"""The table of results: what is done stays, what failed is done again, once each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from pyarrow import fs

from amvnet.errors import InputError
from amvnet.fleet import results as results_module
from amvnet.fleet.manifest import list_scans
from amvnet.fleet.results import (
    DRIVES_SCHEMA,
    Results,
    describe_drive,
    parse_estimate,
    results_schema,
)
from amvnet.fleet.storage import Place
from amvnet.inference.request import LabellingRequest
from amvnet.sensors.frame import Frame
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.measure import Estimate

from fixtures.commands import fails
from fixtures.s3_server import Bucket
from fixtures.tiny import fresh_weights

REQUEST = LabellingRequest(fresh_weights())


def rows(names: Sequence[str], error: str | None = None) -> pa.Table:
    values = [{"scan": name, "error": error} for name in names]
    return pa.Table.from_pylist(values, results_schema(REQUEST.taxonomy))


def touch(out: Place, names: Sequence[str]) -> None:
    for name in names:
        (out / f"{name}.label").write(b"label")


def read(out: Place) -> list[tuple[str, str | None]]:
    rows: list[dict[str, Any]] = []
    folder = out / "results"
    for file in folder.children()[0]:
        if file.startswith("part-"):
            rows += pa.parquet.read_table(BytesIO((folder / file).read())).to_pylist()
    return [(row["scan"], row["error"]) for row in rows]


@pytest.fixture(params=["local", "s3"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    if request.param == "local":
        return Place.of(str(tmp_path / "out"))
    request.getfixturevalue("bucket")
    return Place.of(f"s3://fleet/{tmp_path.name}")


def test_a_resumed_run_keeps_what_is_done_and_drops_what_failed(out: Place) -> None:
    first = Results(out, REQUEST)
    first.add(rows("ab"))
    first.flush()
    first.add(rows("cd", "broken"))
    first.add(rows("e"))
    first.flush()
    first.add(rows("f", "broken"))
    first.flush()
    touch(out, "abe")
    assert len(read(out)) == 6

    again = Results(out, REQUEST, resume=True)
    assert again.done.has(list("abcdef")).tolist() == [True, True, False, False, True, False]
    again.add(rows("cdf"))
    again.flush()
    assert sorted(read(out)) == [(name, None) for name in "abcdef"]


def test_a_scan_whose_labels_are_gone_is_not_done(out: Place) -> None:
    first = Results(out, REQUEST)
    first.add(rows(["a", "day/b", "day/c"]))
    first.flush()
    touch(out, ["a", "day/b", "day/c"])
    (out / "day/b.label").remove()
    again = Results(out, REQUEST, resume=True)
    assert again.done.has(["a", "day/b", "day/c"]).tolist() == [True, False, True]
    assert sorted(read(out)) == [("a", None), ("day/c", None)]


def test_a_scan_that_two_runs_have_done_keeps_one_row(out: Place) -> None:
    first = Results(out, REQUEST)
    for names in ("ab", "bc", "bb"):
        first.add(rows(names))
        first.flush()
    touch(out, "abc")
    Results(out, REQUEST, resume=True)
    assert sorted(read(out)) == [(name, None) for name in "abc"]


def test_no_rows_are_no_part(tmp_path: Path) -> None:
    results = Results(Place.of(str(tmp_path)), REQUEST)
    results.add(rows(""))
    results.flush()
    assert not list(tmp_path.glob("results/part-*"))


def test_parts_are_written_by_size_or_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results_module, "PART_SECONDS", 1000.0)
    results = Results(Place.of(str(tmp_path)), REQUEST)
    results.add(rows("a"))
    assert not list(tmp_path.glob("results/part-*"))
    monkeypatch.setattr(results_module, "PART_BYTES", 1)
    results.add(rows("b"))
    monkeypatch.setattr(results_module, "PART_BYTES", 1 << 20)
    monkeypatch.setattr(results_module, "PART_SECONDS", 0.0)
    results.add(rows("c"))
    parts = [pa.parquet.read_table(path) for path in sorted(tmp_path.glob("results/part-*"))]
    assert [part["scan"].to_pylist() for part in parts] == [["a", "b"], ["c"]]


def test_another_runs_folder_is_refused_in_one_line(out: Place) -> None:
    Results(out, REQUEST)
    fails(lambda: Results(out, REQUEST), out.url, "--resume")
    other = replace(REQUEST, weights=fresh_weights(seed=1))
    fails(lambda: Results(out, other, resume=True), out.url, "other values of weights;")
    for content in (b"[1", b"[]", b"1" * 10_000, b"[" * 100_000, b"\xff", b""):
        (out / "results/run.json").write(content)
        fails(lambda: Results(out, REQUEST, resume=True), "other values of weights,")


def test_a_folder_with_other_files_is_refused(out: Place) -> None:
    (out / "mine.label").write(b"")
    fails(lambda: Results(out, REQUEST), out.url, "mine.label", "change --out")
    assert out.children() == (["mine.label"], [])


def test_the_request_is_written_down(out: Place) -> None:
    Results(out, REQUEST)
    assert json.loads((out / "results/run.json").read()) == REQUEST.settings


def written(table: pa.Table) -> bytes:
    buffer = BytesIO()
    pa.parquet.write_table(table, buffer)
    return buffer.getvalue()


GOOD = rows("ab")


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("part-000000.parquet", b"PAR1", ()),
        ("part-000000.parquet", b"", ()),
        ("part-000000.parquet", written(GOOD.drop_columns(["error"])), ("the columns",)),
        ("part-000000.parquet", written(GOOD.drop_columns(["scan"])), ("the columns",)),
        ("part-000000.parquet", written(pa.table({"x": [1]})), ("the columns x",)),
        ("part-000000.parquet", written(rows([None])), ("a row without scan",)),  # type: ignore[list-item]
        (
            "part-000000.parquet",
            written(GOOD.set_column(11, "weights", pa.array([[1], [2]]))),
            ("other types",),
        ),
        ("part-000000 (copy).parquet", written(GOOD), ("another file",)),
        ("part-000000.parquet.tmp", b"", ("another file",)),
        ("part-1.parquet", written(GOOD), ("another file",)),
        ("notes.txt", b"", ("another file",)),
        ("drives.parquet", written(pa.table({"height": [1.0]})), ("the columns height",)),
        ("drives.parquet", b"PAR1", ()),
    ],
)
def test_tables_of_another_make_are_refused_in_one_line_and_kept(
    tmp_path: Path, file: str, content: bytes, words: Sequence[str]
) -> None:
    out = Place.of(str(tmp_path))
    Results(out, REQUEST)
    (out / "results" / file).write(content)
    fails(lambda: Results(out, REQUEST, resume=True), file, *words)
    assert (tmp_path / "results" / file).read_bytes() == content


def test_what_a_killed_run_left_half_written_is_taken_away(tmp_path: Path) -> None:
    out = Place.of(str(tmp_path))
    Results(out, REQUEST)
    for name in (f".{'0' * 32}.part.label", f"results/.{'f' * 32}.part.parquet"):
        (tmp_path / name).write_bytes(b"half")
    (tmp_path / ".notes.part").touch()
    Results(out, REQUEST, resume=True)
    names = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert names == {"run.json", ".notes.part"}


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path, bucket: Bucket) -> None:
    (tmp_path / "file").touch()
    fails(lambda: Results(Place.of(f"{tmp_path}/file/out"), REQUEST), f"{tmp_path}/file")
    fails(lambda: Results(Place.of("s3://none/out"), REQUEST), "s3://none", "credentials")


def test_a_storage_without_an_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    class Unreachable(fs.FileSystem):
        @staticmethod
        def from_uri(uri: str) -> tuple[fs.FileSystem, str]:
            raise OSError(f"cannot resolve the host of {uri}")

    monkeypatch.setattr("amvnet.fleet.storage.fs.FileSystem", Unreachable)
    with pytest.raises(InputError, match=r"s3://a-bucket-of-no-host: .* check the URL") as error:
        Place.of("s3://a-bucket-of-no-host/scans")
    assert "\n" not in str(error.value)


def test_missing_credentials_are_one_line(locked_bucket: str) -> None:
    for action in (
        lambda: next(list_scans([f"{locked_bucket}/scans"], Place.of("/out"))),
        lambda: Results(Place.of(f"{locked_bucket}/out"), REQUEST),
    ):
        fails(action, locked_bucket, "ACCESS_DENIED", "check the URL and the credentials")


def test_drives_are_read_as_they_were_measured(out: Place) -> None:
    """To the last digit, so that all workers normalise alike."""
    rng = np.random.default_rng(0)
    measured = Estimate(
        Frame("m", "y-forward", rng.normal(), rng.normal(), rng.normal(), rng.normal()),
        SensorGeometry(32, rng.normal(), rng.normal()),
        quantiles=rng.random(11),
        is_steady=False,
    )
    unknown = Estimate(Frame(), SensorGeometry(), quantiles=None)
    estimates = {"a": measured, "b": unknown, "c": None}
    for resume, (drive, estimate) in enumerate(estimates.items()):
        table = pa.Table.from_pylist([describe_drive(drive, "line", estimate)], DRIVES_SCHEMA)
        Results(out, REQUEST, resume=bool(resume)).add_drives(table)

    drives = Results(out, REQUEST, resume=True).estimates
    assert set(drives) == set(estimates)
    for drive, estimate in estimates.items():
        read_back = parse_estimate(drives[drive])
        assert repr(read_back) == repr(estimate)
        if read_back is not None and estimate is not None:
            np.testing.assert_array_equal(read_back.quantiles, estimate.quantiles)
