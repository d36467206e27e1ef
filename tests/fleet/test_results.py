"""The table of results: what is done stays, what failed is done again, once each."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from pyarrow import fs

from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.fleet import results as results_module
from amvnet.fleet.actors import results_schema
from amvnet.fleet.manifest import list_blocks
from amvnet.fleet.results import Results, describe_drive, parse_estimate
from amvnet.fleet.storage import Place
from amvnet.sensors.frame import Frame
from amvnet.sensors.lasers import SensorGeometry
from amvnet.sensors.measure import Estimate

from fixtures.s3_server import Bucket
from fixtures.worlds import fails

SETTINGS = {"weights": {"range_net": "0f"}, "tau": None}


def rows(names: Sequence[str], error: str | None = None) -> pa.Table:
    schema = results_schema(SEMANTICKITTI)
    schema = schema.remove(schema.get_field_index("is_fatal"))
    return pa.Table.from_pylist([{"scan": name, "error": error} for name in names], schema)


def read(folder: Path) -> list[tuple[str, str | None]]:
    table = pa.parquet.read_table(sorted(folder.glob("results/part-*.parquet")))
    return [(row["scan"], row["error"]) for row in table.to_pylist()]


@pytest.fixture(params=["local", "s3"])
def out(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """An output folder that does not exist."""
    if request.param == "local":
        return Place.of(str(tmp_path / "out"))
    request.getfixturevalue("bucket")
    return Place.of(f"s3://fleet/{tmp_path.name}")


def test_a_resumed_run_keeps_what_is_done_and_drops_what_failed(tmp_path: Path) -> None:
    out = Place.of(str(tmp_path / "out"))
    first = Results(out, SETTINGS)
    first.add(rows("ab"))
    first.flush()
    first.add(rows("cd", "broken"))
    first.add(rows("e"))
    first.flush()
    first.add(rows("f", "broken"))
    first.flush()
    assert len(read(tmp_path / "out")) == 6

    again = Results(out, SETTINGS, resume=True)
    assert again.done.has(list("abcdef")).tolist() == [True, True, False, False, True, False]
    again.add(rows("cdf"))
    again.flush()
    assert sorted(read(tmp_path / "out")) == [(name, None) for name in "abcdef"]


def test_a_scan_that_two_runs_have_done_keeps_one_row(tmp_path: Path) -> None:
    out = Place.of(str(tmp_path / "out"))
    first = Results(out, SETTINGS)
    for names in ("ab", "bc", "bb"):
        first.add(rows(names))
        first.flush()
    Results(out, SETTINGS, resume=True)
    assert sorted(read(tmp_path / "out")) == [(name, None) for name in "abc"]


def test_no_rows_are_no_part(tmp_path: Path) -> None:
    results = Results(Place.of(str(tmp_path)), SETTINGS)
    results.add(rows(""))
    results.flush()
    assert not list(tmp_path.glob("results/part-*"))


def test_parts_are_written_by_size_and_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results_module, "PART_SECONDS", 1000.0)
    results = Results(Place.of(str(tmp_path)), SETTINGS)
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
    Results(out, SETTINGS)
    fails(lambda: Results(out, SETTINGS), out.url, "--resume")
    fails(lambda: Results(out, SETTINGS, overwrite=True), out.url, "--resume")
    other = {**SETTINGS, "weights": {"range_net": "1f"}}
    fails(lambda: Results(out, other, resume=True), out.url, "another weights;")
    (out / "results/run.json").write(b"[1")
    fails(lambda: Results(out, SETTINGS, resume=True), "another weights;")


def test_a_folder_with_other_files_is_refused_unless_the_user_insists(out: Place) -> None:
    (out / "mine.label").write(b"")
    fails(lambda: Results(out, SETTINGS), out.url, "mine.label", "--overwrite")
    Results(out, SETTINGS, overwrite=True)
    assert json.loads((out / "results/run.json").read()) == SETTINGS


def test_a_broken_part_is_refused_in_one_line(out: Place) -> None:
    Results(out, SETTINGS)
    (out / "results/part-000000.parquet").write(b"PAR1")
    fails(lambda: Results(out, SETTINGS, resume=True), "part-000000.parquet")


def test_a_place_that_cannot_be_written_is_refused_in_one_line(
    tmp_path: Path, bucket: Bucket
) -> None:
    (tmp_path / "file").touch()
    fails(lambda: Results(Place.of(f"{tmp_path}/file/out"), SETTINGS), f"{tmp_path}/file")
    fails(lambda: Results(Place.of("s3://none/out"), SETTINGS), "s3://none", "credentials")


def test_a_storage_that_does_not_answer_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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
        lambda: next(list_blocks([f"{locked_bucket}/scans"])),
        lambda: Results(Place.of(f"{locked_bucket}/out"), SETTINGS),
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
        row = describe_drive(drive, "line", estimate)
        Results(out, SETTINGS, resume=bool(resume)).add_drives([row])

    drives = Results(out, SETTINGS, resume=True).drives
    assert set(drives) == set(estimates)
    for drive, estimate in estimates.items():
        read_back = parse_estimate(drives[drive]["estimates"])
        assert repr(read_back) == repr(estimate)
        if read_back is not None and estimate is not None:
            np.testing.assert_array_equal(read_back.quantiles, estimate.quantiles)
