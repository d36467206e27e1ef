"""The queries and the Python of docs/fleet.md."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest

from amvnet.fleet.labelling import IS_FATAL, LabelScans, MeasureSensors
from amvnet.fleet.manifest import list_scans
from amvnet.fleet.results import DRIVES, Results
from amvnet.fleet.storage import Place
from amvnet.inference.request import LabellingRequest
from amvnet.weights.file import load

PAGE = (Path(__file__).parents[2] / "docs/fleet.md").read_text()


@pytest.fixture(scope="module")
def world(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `labels/results` as of a run, and a manifest."""
    root = tmp_path_factory.mktemp("page")
    request = LabellingRequest(load(fleet / "w.safetensors"))
    out = Place.of(str(root / "labels"))
    results = Results(out, request)
    worker = LabelScans(request, out.address)
    for scans in list_scans([f"{fleet}/scans"], out):
        drive = MeasureSensors(request)(scans)
        results.add_drives(drive)
        estimates = pa.repeat(drive["estimates"][0], len(scans))
        rows = worker(scans.append_column("estimates", estimates))
        results.add(rows.drop_columns([IS_FATAL.name]))
    results.flush()

    paths = [str(path) for path in sorted((fleet / "scans").rglob("*.bin"))]
    pa.parquet.write_table(pa.table({"path": paths}), root / "fleet.parquet")
    return root


def test_the_queries_answer_their_questions(world: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    duckdb = pytest.importorskip("duckdb")
    monkeypatch.chdir(world)
    persons, moved, cost = re.findall(r"```sql\n(.*?)```", PAGE, re.S)

    table = pa.parquet.read_table(sorted(Path("labels/results").glob("part-*"))).to_pylist()
    most = max(row["class_uncertain"]["person"] for row in table)
    answer = duckdb.sql(persons).fetchall()
    assert len(answer) == len(table)
    assert answer[0][1] == most

    # Each drive has its sensor 0.2 m higher than the one before; the one in the middle is usual.
    heights = {
        Path(drive).parent.name: height for drive, height, *_ in duckdb.sql(moved).fetchall()
    }
    assert set(heights) == {"drive0", "drive1", "drive3", "drive4"}
    assert heights["drive4"] == pytest.approx(2.5, abs=0.05)

    ((scans, dollars),) = duckdb.sql(cost).fetchall()
    seconds = sum(row["seconds"] for row in table) / len(table)
    assert scans == len(table)
    assert dollars == pytest.approx(1000 * seconds / 3600 * 2, rel=1e-4)


def test_the_worker_labels_the_partitions_of_other_engines(
    world: Path, fleet: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(world)
    _, functions = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    request = LabellingRequest(load(fleet / "w.safetensors"))
    names: dict[str, Any] = {"request": request, "LabelScans": LabelScans, "pa": pa}
    exec(functions, names)

    frame = pd.read_parquet("fleet.parquet").iloc[:4]
    rows = pd.concat(names["label"](iter([frame[:2], frame[2:]])))
    assert rows["scan"].tolist() == [f"{index:06d}" for index in range(4)]
    assert rows["error"].isna().all()

    dask = pytest.importorskip("dask.dataframe")
    shares = names["on_dask"](dask.from_pandas(frame, npartitions=1)).compute()
    assert shares["uncertain"].tolist() == rows["uncertain"].tolist()


def test_the_page_names_every_column_of_the_tables(world: Path) -> None:
    part = next(Path(world, "labels/results").glob("part-*"))
    for path in (part, world / "labels/results" / DRIVES):
        for column in pa.parquet.read_schema(path).names:
            assert column == "drive" or f"`{column}`" in PAGE, column
