"""Which scans a fleet has: folders, URLs and manifests give the same; names take little memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from pyarrow.fs import FileType, LocalFileSystem

from amvnet.data.formats import find
from amvnet.data.formats.detect import scan_stem
from amvnet.errors import InputError
from amvnet.fleet import manifest
from amvnet.fleet.manifest import NameSet, list_scans, split_name
from amvnet.fleet.storage import Place

from fixtures.commands import fails
from fixtures.s3_server import Bucket

NOWHERE = "/an/output/folder/elsewhere"


def scans_of(inputs: Sequence[str], out: str = NOWHERE) -> list[tuple[str, str, str]]:
    rows = [row for table in list_scans(inputs, Place.of(out)) for row in table.to_pylist()]
    return [(row["name"], row["drive"], row["path"]) for row in rows]


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


# ---- folders


def test_a_folder_of_drives_is_listed_as_predict_lists_its_files(fleet: Path) -> None:
    expected = []
    for scan in find.list_scans(f"{fleet}/scans/*/*.bin"):
        expected.append((scan.name, scan.recording.name, str(scan.path)))
    assert scans_of([f"{fleet}/scans"]) == expected


def test_a_prefix_of_a_bucket_has_the_same_scans(fleet: Path, bucket: Bucket) -> None:
    local = [name for name, _, _ in scans_of([f"{fleet}/scans"])]
    rows = scans_of(["s3://fleet/scans/"])
    assert [name for name, _, _ in rows] == local
    name, drive, url = rows[0]
    assert (drive, url) == ("s3://fleet/scans/drive0/*.bin", f"s3://fleet/scans/{name}.bin")


def test_only_scans_are_listed_and_those_of_other_formats_are_another_drive(tmp_path: Path) -> None:
    touch(tmp_path, "a/1.bin", "a/1.label", "a/2.pcd", "a/3.npz", "a/3.label", "a/4.npz")
    touch(tmp_path, "a/5.bin.gz", "a/6.txt", "a/6.txt.gz", "a/.7.bin", "a/1.uncertain.npy")
    touch(tmp_path, ".hidden/8.bin", "results/part-000000.parquet")
    expected = {"a/1": "*.bin", "a/2": "*.pcd", "a/4": "*.npz", "a/5": "*.bin.gz"}
    assert {name: Path(drive).name for name, drive, _ in scans_of([str(tmp_path)])} == expected


def test_scans_have_the_names_that_predict_gives_them() -> None:
    for name in ("1.bin", "2.pcd.bin", "3.bin.gz", "4.pcd.bin.gz", "5.PLY", "6.ply.GZ", "7.a.npy"):
        assert split_name(name)[0] == scan_stem(Path(name))


def test_what_cannot_be_listed_is_refused_in_one_line(tmp_path: Path, bucket: Bucket) -> None:
    (tmp_path / "empty").mkdir()
    touch(tmp_path, "bags/drive.mcap")
    for text, words in (
        (tmp_path / "none", ("found nothing",)),
        (tmp_path / "empty", ("found none", "folder of scans")),
        (tmp_path / "bags", ("drive.mcap", "recording", "amvnet predict")),
        ("s3://fleet/none", ("found nothing", "check the URL")),
        ("nowhere://fleet", ("nowhere", "s3://")),
    ):
        fails(partial(scans_of, [str(text)]), text, *words)


# ---- manifests


def write_manifest(path: Path, columns: dict[str, list[str]]) -> str:
    table = pa.table(columns)
    if path.suffix == ".csv":
        pa.csv.write_csv(table, path)
    else:
        pa.parquet.write_table(table, path)
    return str(path)


@pytest.mark.parametrize("ending", manifest.MANIFESTS)
def test_a_manifest_of_paths_gives_the_same_scans_as_the_folder(fleet: Path, ending: str) -> None:
    expected = scans_of([f"{fleet}/scans"])
    paths = [f"scans/{name}.bin" for name, _, _ in expected]
    path = fleet / f"fleet{ending}"
    rows = scans_of([write_manifest(path, {"path": paths})])
    path.unlink()
    assert rows == [(f"scans/{name}", drive, url) for name, drive, url in expected]


@pytest.mark.parametrize("ending", manifest.MANIFESTS)
def test_columns_of_a_manifest_are_texts(tmp_path: Path, ending: str) -> None:
    columns = {
        "path": [f"s3://b/x/{index}.bin" for index in range(2)],
        "drive": ["7", "8"],
        "name": ["000000", "000001"],  # digits, but no numbers
    }
    rows = scans_of([write_manifest(tmp_path / f"m{ending}", columns)])
    assert rows == [("000000", "7", "s3://b/x/0.bin"), ("000001", "8", "s3://b/x/1.bin")]


def test_names_of_one_file_are_one_name(tmp_path: Path) -> None:
    names = ["x/a", "x//a", "./x/a", "x/./a", "x/a/"]
    path = write_manifest(tmp_path / "m.csv", {"path": ["a.bin"] * 5, "name": names})
    assert {name for name, _, _ in scans_of([path])} == {"x/a"}


def test_a_manifest_without_paths_is_refused_in_one_line(tmp_path: Path) -> None:
    path = write_manifest(tmp_path / "m.csv", {"file": ["a.bin"]})
    fails(lambda: scans_of([path]), "column path", "found file")
    (tmp_path / "m.parquet").write_bytes(b"PAR1, but no more")
    fails(lambda: scans_of([f"{tmp_path}/m.parquet"]), "m.parquet", "Parquet or CSV")


@pytest.mark.parametrize("ending", manifest.MANIFESTS)
def test_a_manifest_needs_each_column_once_and_all_paths(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"m{ending}"
    twice = pa.Table.from_arrays([pa.array(["a.bin"]), pa.array(["b.bin"])], ["path", "path"])
    for table, words in (
        (twice, ("one column path", "found 2")),
        (pa.table({"path": ["a.bin", None], "name": ["a", "b"]}), ("a path in each row",)),
    ):
        if ending == ".csv":
            pa.csv.write_csv(table, path)
        else:
            pa.parquet.write_table(table, path)
        fails(lambda: scans_of([str(path)]), path, *words)


# ---- the output folder


def test_an_output_folder_among_the_inputs_is_refused_also_through_links(tmp_path: Path) -> None:
    touch(tmp_path, "scans/a.bin", "out/old.ply")
    (tmp_path / "link").symlink_to(tmp_path / "scans")
    (tmp_path / "scans/loop").symlink_to(tmp_path / "out")
    path = write_manifest(tmp_path / "m.csv", {"path": [f"{tmp_path}/scans/loop/old.ply"]})
    for inputs, out in (
        ("scans", "scans"),
        ("scans", "scans/out"),
        ("scans", "link"),
        ("scans", "link/out"),
        ("link", "scans"),
        (".", "out"),
        ("scans", "out"),  # holds a link to it
        ("out/old.ply", "out"),
        ("scans/loop/old.ply", "out"),
    ):
        fails(partial(scans_of, [f"{tmp_path}/{inputs}"], f"{tmp_path}/{out}"), "change ")
    fails(partial(scans_of, [path], f"{tmp_path}/out"), "change the output folder")
    assert len(scans_of([f"{tmp_path}/scans"], f"{tmp_path}/scans-out")) == 2


def test_a_manifest_or_a_link_in_the_output_folder_is_refused(tmp_path: Path) -> None:
    """A resumed run replaces the tables of results, and labels replace the link."""
    touch(tmp_path, "scans/a.ply")
    (tmp_path / "out/results").mkdir(parents=True)
    (tmp_path / "out/a.ply").symlink_to(tmp_path / "scans/a.ply")
    columns = {"path": [f"{tmp_path}/scans/a.ply"]}
    path = write_manifest(tmp_path / "out/results/part-000000.parquet", columns)
    for text in (path, f"{tmp_path}/out/a.ply"):
        fails(partial(scans_of, [text], f"{tmp_path}/out"), text, "change the output folder")
        assert len(scans_of([text])) == 1


def test_a_home_of_nobody_is_a_path_where_nothing_is() -> None:
    fails(partial(scans_of, ["~nobody-has-this-name/scans"]), "found nothing")


def test_an_output_prefix_among_the_inputs_is_refused(bucket: Bucket) -> None:
    for inputs, out in (
        ("s3://fleet/scans", "s3://fleet/scans/"),
        ("s3://fleet/scans", "s3://anybody:anything@fleet/scans/out"),
        ("s3://fleet/scans/drive0/000000.bin", "s3://fleet/scans/drive0"),
    ):
        fails(partial(scans_of, [inputs], out), "change ")
    assert scans_of(["s3://fleet/scans"], "s3://fleet/scans-out")


# ---- secrets


def test_credentials_are_in_the_paths_for_the_workers_only(
    bucket: Bucket, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    own = "s3://anybody:hush%2Fhush@fleet"
    path = write_manifest(tmp_path / "m.csv", {"path": [f"{own}/scans/drive0/000000.bin"]})
    for text in (f"{own}/scans/drive0", path, f"{own}/scans/drive0/000000.bin"):
        name, drive, url = scans_of([text])[0]
        assert name.endswith("000000")
        assert drive == "s3://fleet/scans/drive0/*.bin"
        assert url.startswith(own)
    for text, out in (
        (f"{own}/none", NOWHERE),
        (f"{own}/scans", f"{own}/scans"),
        ("s3://anybody:hush%2Fhush@none/x", NOWHERE),
        ("nowhere://anybody:hush/hush@none/x", NOWHERE),
    ):
        with pytest.raises(InputError) as caught:
            scans_of([text], out)
        assert "anybody" not in str(caught.value)
        assert "hush" not in str(caught.value)


# ---- many names


def test_a_set_of_names_has_those_that_were_added() -> None:
    rng = np.random.default_rng(0)
    names = NameSet()
    reference: set[str] = set()
    for _ in range(50):
        some = [str(number) for number in rng.integers(0, 200, 7)]
        expected = []
        for name in some:
            expected.append(name not in reference)
            reference.add(name)
        assert names.add(some).tolist() == expected
        assert names.has(list(map(str, range(200)))).tolist() == [
            str(number) in reference for number in range(200)
        ]
    assert len(names) == len(reference)


DRIVE = 500  # scans of each made-up drive


class MadeUp(Place):
    """A folder of drives that exist only by their names."""

    drives = 0

    def kind(self) -> FileType:
        return FileType.Directory

    def children(self) -> tuple[list[str], list[str]]:
        if self.path == "/fleet":
            return [], [f"drive-{index:06d}" for index in range(self.drives)]
        return [f"{1_700_000_000_000_000 + index}.bin" for index in range(DRIVE)], []

    def __truediv__(self, name: str) -> Place:
        return MadeUp(f"{self.address}/{name}", self.filesystem, f"{self.path}/{name}")


@pytest.mark.full
def test_the_memory_of_a_plan_does_not_grow_with_names(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each name stay 8 bytes."""
    monkeypatch.setattr(Place, "of", lambda url: MadeUp(url, LocalFileSystem(), url))

    def kept(drives: int) -> int:
        monkeypatch.setattr(MadeUp, "drives", drives)
        names = NameSet()
        tracemalloc.start()
        for table in list_scans(["/fleet"], Place.of("/out")):
            assert names.add(table["name"].to_pylist()).all()
            snapshot = tracemalloc.take_snapshot() if len(names) == drives * DRIVE else None
        tracemalloc.stop()
        # Python enlarges its table of interned strings at times that differ.
        assert snapshot is not None
        own = snapshot.filter_traces([tracemalloc.Filter(False, "*/pathlib.py")])
        return sum(trace.size for trace in own.traces)

    few = kept(20)
    assert (kept(100) - few) / (80 * DRIVE) < 20
