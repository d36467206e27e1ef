"""What a worker does with its scans: the labels of `predict`, and a row for each."""

from __future__ import annotations

import errno
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amvnet.data.formats.registry import read_file
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.fleet.labelling import IS_FATAL, LabelScans, MeasureSensors, statistics
from amvnet.fleet.manifest import list_scans
from amvnet.fleet.results import Results, results_schema
from amvnet.fleet.storage import Place
from amvnet.inference.pipeline import LabelFiles, Segment
from amvnet.inference.predict import segment_by
from amvnet.inference.request import LabellingRequest
from amvnet.inference.segmentation import Segmentation
from amvnet.scan import Scan
from amvnet.weights.file import load

from fixtures.commands import fails, succeed
from fixtures.s3_server import Bucket
from fixtures.scan_writers import write_ply
from fixtures.surroundings import LINKS, NAMES, surroundings
from fixtures.tiny import street

NOWHERE = Place.of("/an/output/folder/elsewhere")


@pytest.fixture(scope="module")
def labelling(fleet: Path) -> LabellingRequest:
    return LabellingRequest(load(fleet / "w.safetensors"))


def label(request: LabellingRequest, out: str, inputs: Sequence[str]) -> list[dict[str, Any]]:
    """Label scans as the workers of a cluster do; return the rows of results."""
    worker = LabelScans(request, out)
    rows = []
    for scans in list_scans(inputs, NOWHERE):
        for drive in scans["drive"].unique():
            block = scans.filter(pc.equal(scans["drive"], drive))
            result = worker(with_estimates(block, estimates_of(request, block)))
            assert result.schema == results_schema(request.taxonomy).append(IS_FATAL)
            rows += result.to_pylist()
    return rows


def estimates_of(request: LabellingRequest, block: pa.Table) -> str:
    (drive,) = MeasureSensors(request)(block.slice(0, 5)).to_pylist()
    estimates: str = drive["estimates"]
    return estimates


def with_estimates(block: pa.Table, estimates: str) -> pa.Table:
    return block.append_column("estimates", pa.repeat(estimates, len(block)))


def test_labels_in_a_bucket_are_those_of_predict(
    labelling: LabellingRequest, labels: dict[str, bytes], bucket: Bucket
) -> None:
    rows = label(labelling, "s3://fleet/labels", ["s3://fleet/scans"])
    assert set(bucket.keys("labels")) == set(labels)
    for name, content in labels.items():
        assert bucket[f"labels/{name}"] == content
    assert [row["labels"] for row in rows] == [
        f"s3://fleet/labels/{row['scan']}.label" for row in rows
    ]


def test_the_labels_come_last_into_a_bucket(
    labelling: LabellingRequest, fleet: Path, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If they are there, the other files are there, whenever the worker is killed."""
    written = []
    write = Place.write

    def record(place: Place, content: bytes) -> None:
        written.append(Path(place.path).name)
        write(place, content)

    monkeypatch.setattr(Place, "write", record)
    request = replace(labelling, files=LabelFiles(scores=True, uncertain=True))
    label(request, "s3://fleet/last", [f"{fleet}/scans/drive1/000000.bin"])
    assert len(written) == 3
    assert written[-1] == "000000.label"


def test_labels_in_a_folder_are_those_of_predict_in_each_format(
    labelling: LabellingRequest, fleet: Path, tmp_path: Path
) -> None:
    request = replace(labelling, files=LabelFiles("ply", True, True))
    label(request, str(tmp_path / "out"), [f"{fleet}/scans"])
    succeed(
        f"predict '{fleet}/scans/*/*.bin' --weights {fleet}/w.safetensors --out {tmp_path}/whole "
        "--format ply --scores --uncertain"
    )
    paths = [path for path in (tmp_path / "whole").rglob("*/*") if path.is_file()]
    assert len(paths) == 60
    for path in paths:
        copy = tmp_path / "out" / path.relative_to(tmp_path / "whole")
        assert copy.read_bytes() == path.read_bytes(), path


def test_workers_normalise_by_what_was_measured_and_not_by_their_own_scans(
    labelling: LabellingRequest, fleet: Path, tmp_path: Path
) -> None:
    """A worker that gets only the last scans of a drive gives them the labels of the whole."""
    (block,) = list(list_scans([f"{fleet}/scans/drive4"], NOWHERE))
    worker = LabelScans(labelling, str(tmp_path))
    (drive,) = MeasureSensors(labelling)(block).to_pylist()
    assert drive["height"] == pytest.approx(2.5, abs=0.05)
    other = json.dumps(json.loads(drive["estimates"]) | {"quantiles": None})

    for estimates, is_same in ((drive["estimates"], True), (other, False)):
        worker(with_estimates(block, estimates).slice(len(block) - 1))
        expected = (fleet / "labels/drive4/000003.label").read_bytes()
        assert ((tmp_path / "000003.label").read_bytes() == expected) == is_same


def test_only_paths_are_needed(labelling: LabellingRequest, fleet: Path, tmp_path: Path) -> None:
    """In a user's own pipeline, the sensor is measured on the batch."""
    worker = LabelScans(labelling, str(tmp_path))
    paths = sorted((fleet / "scans/drive1").glob("*.bin"))
    worker(pa.table({"path": list(map(str, paths))}))
    for path in paths:
        expected = fleet / f"labels/drive1/{path.stem}.label"
        assert (tmp_path / f"{path.stem}.label").read_bytes() == expected.read_bytes()


def test_broken_scans_have_a_row_with_one_line_and_the_others_labels(
    labelling: LabellingRequest, labels: dict[str, bytes], fleet: Path, bucket: Bucket
) -> None:
    bucket.upload(fleet / "scans/drive0", "broken")
    bucket["broken/000001.bin"] = b"123"
    bucket["broken/000002.pcd"] = b"VERSION"
    rows = label(labelling, "s3://fleet/broken-out", ["s3://fleet/broken"])
    errors = {row["path"]: row["error"] for row in rows if row["error"]}
    assert set(errors) == {"s3://fleet/broken/000001.bin", "s3://fleet/broken/000002.pcd"}
    for path, error in errors.items():
        assert error.startswith(f"{path}: expected")
        assert "\n" not in error
    assert len(rows) == 5
    assert bucket["broken-out/000003.label"] == labels["drive0/000003.label"]


def test_a_scan_that_is_gone_is_a_broken_one(labelling: LabellingRequest, tmp_path: Path) -> None:
    worker = LabelScans(labelling, f"{tmp_path}/out")
    for path in (f"{tmp_path}/gone.bin", "s3://fleet/gone.bin"):
        (row,) = worker(pa.table({"path": [path]})).to_pylist()
        assert row["error"].startswith(f"{path}: expected")
        assert "output folder" not in row["error"]


def test_a_scan_in_the_output_is_not_replaced(labelling: LabellingRequest, tmp_path: Path) -> None:
    """In a pipeline of one's own, nobody has listed the scans."""
    points, _ = street(0)
    path = write_ply(tmp_path / "a.ply", points)
    before = path.read_bytes()
    worker = LabelScans(replace(labelling, files=LabelFiles("ply")), str(tmp_path))
    (row,) = worker(pa.table({"path": [str(path)]})).to_pylist()
    assert "expected an input outside the output folder" in row["error"]
    assert path.read_bytes() == before


def test_a_fault_of_a_library_is_the_row_of_its_scan_and_the_others_are_labelled(
    labelling: LabellingRequest, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = [f"{fleet}/scans/drive1/{index:06d}.bin" for index in range(4)]

    def read(path: Path, *others: Any) -> object:
        return 1 / 0 if str(path) == paths[2] else read_file(path, *others)

    (block,) = list(list_scans([f"{fleet}/scans/drive1"], NOWHERE))
    estimates = estimates_of(labelling, block)
    monkeypatch.setattr("amvnet.fleet.labelling.read_file", read)
    rows = LabelScans(labelling, str(tmp_path))(with_estimates(block, estimates)).to_pylist()
    errors = [row["error"] for row in rows]
    fault = f"{paths[2]}: expected a scan, found ZeroDivisionError: division by zero"
    assert errors == [None, None, fault, None]
    for index in (0, 1, 3):
        expected = fleet / f"labels/drive1/{index:06d}.label"
        assert (tmp_path / f"{index:06d}.label").read_bytes() == expected.read_bytes()


def test_scans_beside_a_fault_are_normalised_as_their_drive(
    labelling: LabellingRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if nobody has measured the drive before: each scan is then labelled on its own."""
    (tmp_path / "drive").mkdir()
    for index in range(4):
        points, _ = street(index)
        points[:, 3] *= 4 if index == 3 else 1  # alone, the scan would be one from 0 to 255
        points.tofile(tmp_path / f"drive/{index}.bin")
    (block,) = list(list_scans([f"{tmp_path}/drive"], NOWHERE))
    LabelScans(labelling, str(tmp_path / "whole"))(block)

    def segment_by_a_broken_library(*arguments: Any) -> Segment:
        segment = segment_by(*arguments)

        def fail_at_one(inputs: Sequence[ScanFile], scans: Sequence[Scan]) -> list[Segmentation]:
            if any(scan.name == "2" for scan in inputs):
                raise ZeroDivisionError
            return segment(inputs, scans)

        return fail_at_one

    monkeypatch.setattr("amvnet.fleet.labelling.segment_by", segment_by_a_broken_library)
    rows = LabelScans(labelling, str(tmp_path / "out"))(block).to_pylist()
    assert [row["error"] is None for row in rows] == [True, True, False, True]
    for name in ("0.label", "1.label", "3.label"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.full
@settings(max_examples=50)
@given(name=NAMES, drive=NAMES, kind=st.sampled_from(["label", "npy", "ply"]), link=LINKS)
def test_names_in_a_manifest_write_nothing_elsewhere(
    labelling: LabellingRequest, name: str, drive: str, kind: str, link: str
) -> None:
    def make(folder: Path) -> None:
        folder.mkdir()
        street(0, 200)[0].tofile(folder / "a.bin")

    with surroundings(link, make=make) as base:
        out = str(base / "out")
        request = replace(labelling, files=LabelFiles(kind, True, True))
        row = {
            "path": f"{base}/data/a.bin",
            "name": name.replace("BASE", str(base)),
            "drive": drive,
        }
        with suppress(UnicodeEncodeError):  # no table can hold such a name
            block = pa.Table.from_pylist([row])
            LabelScans(request, out)(block)
            Results(Place.of(f"{out}/new"), request).add_drives(MeasureSensors(request)(block))


def test_what_is_no_scan_is_a_broken_scan(labelling: LabellingRequest, tmp_path: Path) -> None:
    """A folder, a bag, a name that leads out of the output folder, a storage that is not there."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\n")
    (tmp_path / "a.bin").write_bytes(np.ones((9, 4), np.float32).tobytes())
    rows = [
        {"path": f"{tmp_path}/folder", "name": "1", "drive": "a"},
        {"path": f"{tmp_path}/folder/", "name": "2", "drive": "b"},
        {"path": f"{tmp_path}/drive.bag", "name": "3", "drive": "c"},
        {"path": f"{tmp_path}/a.bin", "name": "../a", "drive": "d"},
        {"path": "nowhere://a.bin", "name": "4", "drive": "e"},
    ]
    worker = LabelScans(labelling, str(tmp_path / "out"))
    errors = worker(pa.Table.from_pylist(rows))["error"].to_pylist()
    for error, found in zip(
        errors, ("a folder", "a folder", "a recording", "leads elsewhere", "nowhere"), strict=True
    ):
        assert "expected" in error
        assert found in error, error
        assert "\n" not in error
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a.bin", "drive.bag", "folder"]


def test_credentials_of_a_url_are_in_no_row(
    labelling: LabellingRequest, bucket: Bucket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The workers read and write with them."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    bucket["secret/broken.bin"] = b"123"
    own = "s3://anybody:hush%2Fhush@fleet"
    (scans,) = list(list_scans([f"{own}/scans/drive0"], NOWHERE))
    (broken,) = list(list_scans([f"{own}/secret"], NOWHERE))
    worker = LabelScans(labelling, f"{own}/secret-out")
    drives = MeasureSensors(labelling)(scans)
    rows = worker(pa.concat_tables([scans, broken]))
    assert rows["error"].null_count == len(scans)
    for table in (drives, rows):
        shown = str(table.to_pylist())
        assert "s3://fleet/" in shown
        assert "anybody" not in shown
        assert "hush" not in shown


def test_a_full_disk_is_fatal(
    labelling: LabellingRequest, fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/full/000000.label")

    worker = LabelScans(labelling, str(tmp_path))
    monkeypatch.setattr("amvnet.inference.pipeline.Pipeline.write", fail)
    (row,) = worker(pa.table({"path": [f"{fleet}/scans/drive0/000000.bin"]})).to_pylist()
    assert row["is_fatal"]
    assert row["error"] == "/full/000000.label: No space left on device"


@pytest.mark.full
def test_a_bucket_that_takes_no_labels_is_fatal(
    labelling: LabellingRequest, fleet: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")  # where nothing listens
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "anybody")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "anything")
    worker = LabelScans(labelling, "s3://no-such-bucket/out")
    (row,) = worker(pa.table({"path": [f"{fleet}/scans/drive0/000000.bin"]})).to_pylist()
    assert row["is_fatal"]
    assert row["error"].startswith("s3://no-such-bucket/out/000000.label: ")


def test_a_row_counts_its_labels(labelling: LabellingRequest, fleet: Path, tmp_path: Path) -> None:
    for row in label(labelling, str(tmp_path), [f"{fleet}/scans/drive0"]):
        ids = SEMANTICKITTI.to_train(np.fromfile(row["labels"], np.uint32))
        assert row["points"] == np.count_nonzero(ids)
        for index, name in enumerate(SEMANTICKITTI.classes):
            assert row["class_points"][name] == np.count_nonzero(ids == index + 1)
        share = sum(row["class_uncertain"].values()) / row["points"]
        assert row["uncertain"] == pytest.approx(share, abs=1e-6)
        assert (row["error"], row["is_fatal"]) == (None, False)
        assert row["seconds"] > 0


def test_confidence_is_the_mean_largest_score_of_a_class() -> None:
    scores = np.zeros((3, SEMANTICKITTI.size), np.float32)
    scores[[0, 1, 2], [0, 0, 5]] = [0.5, 0.75, 1.0]
    result = Segmentation(np.array([1, 1, 6], np.uint8), np.array([True, False, False]), scores)
    values = statistics(result, SEMANTICKITTI)
    confidence = {name: value for name, value in values["class_confidence"].items() if value}
    assert confidence == {"car": 0.625, "person": 1.0}
    assert (values["class_uncertain"]["car"], values["uncertain"]) == (1, pytest.approx(1 / 3))


def test_files_of_any_storage_of_fsspec_are_read_and_written() -> None:
    place = Place.of("memory://bucket/folder") / "file"
    place.write(b"content")
    assert Place.of("memory://bucket/folder").children() == (["file"], [])
    assert place.read() == b"content"
    place.remove()
    fails(place.read, "memory://bucket/folder/file")
