"""Which scans a fleet has: folders, URLs and manifests give the same; names take little memory."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from pyarrow.fs import FileType

from amvnet.data.formats.find import list_scans
from amvnet.fleet import manifest
from amvnet.fleet.manifest import BLOCK, NameSet, list_blocks
from amvnet.fleet.storage import Place

from fixtures.s3_server import Bucket
from fixtures.worlds import fails


def scans_of(inputs: Sequence[str]) -> list[tuple[str, str, str]]:
    """Return the name, the drive and the URL of each scan."""
    rows = [row for block in list_blocks(inputs) for row in block.to_pylist()]
    return [(row["name"], row["drive"], row["path"]) for row in rows]


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


# ---- folders


def test_a_folder_of_drives_is_listed_as_predict_lists_its_files(fleet: Path) -> None:
    expected = []
    for scan in list_scans(f"{fleet}/scans/*/*.bin"):
        expected.append((scan.name, scan.source, str(scan.path)))
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
    expected = {"a/1": "*.bin", "a/2": "*.pcd", "a/4": "*.npz"}
    drives = {name: Path(drive).name for name, drive, _ in scans_of([str(tmp_path)])}
    assert drives == expected


def test_blocks_are_of_one_drive_and_keep_its_order(tmp_path: Path) -> None:
    names = [f"{index:03d}.bin" for index in range(2 * BLOCK + 1)]
    touch(tmp_path, *(f"{drive}/{name}" for drive in "ab" for name in names))
    blocks = list(list_blocks([str(tmp_path)]))
    assert [len(block) for block in blocks] == 2 * [BLOCK, BLOCK, 1]
    assert pa.concat_tables(blocks[:3])["name"].to_pylist() == [f"a/{name[:-4]}" for name in names]


def test_what_cannot_be_listed_is_refused_in_one_line(tmp_path: Path, bucket: Bucket) -> None:
    (tmp_path / "empty").mkdir()
    touch(tmp_path, "bags/drive.mcap")
    for text, words in (
        (tmp_path / "none", ("found nothing",)),
        (tmp_path / "empty", ("found none", "folder of scans")),
        (tmp_path / "bags", ("drive.mcap", "recording", "without --ray")),
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
def test_rows_of_a_manifest_are_brought_together_by_drive(tmp_path: Path, ending: str) -> None:
    columns = {
        "path": [f"s3://b/x/{index}.bin" for index in range(6)],
        "drive": ["a", "b"] * 3,
        "name": [f"{index:06d}" for index in range(6)],  # digits, but no numbers
    }
    a, b = list_blocks([write_manifest(tmp_path / f"m{ending}", columns)])
    assert a["drive"].to_pylist() == ["a"] * 3
    assert a["name"].to_pylist() == ["000000", "000002", "000004"]
    assert b["drive"].to_pylist() == ["b"] * 3
    assert b["path"][0].as_py() == "s3://b/x/1.bin"


def test_a_manifest_without_paths_is_refused_in_one_line(tmp_path: Path) -> None:
    path = write_manifest(tmp_path / "m.csv", {"file": ["a.bin"]})
    fails(lambda: list(list_blocks([path])), "column path", "found file")
    (tmp_path / "m.parquet").write_bytes(b"PAR1, but no more")
    fails(lambda: list(list_blocks([f"{tmp_path}/m.parquet"])), "m.parquet")


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
        if self.url == "/fleet":
            return [], [f"drive-{index:06d}" for index in range(self.drives)]
        return [f"{1_700_000_000_000_000 + index}.bin" for index in range(DRIVE)], []

    def __truediv__(self, name: str) -> Place:
        return MadeUp(f"{self.url}/{name}", self.filesystem, f"{self.path}/{name}")


def test_the_memory_of_planning_does_not_grow_with_the_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of each name stay 8 bytes."""
    monkeypatch.setattr(Place, "of", lambda url: MadeUp(url, None, url))

    def peak(drives: int) -> int:
        monkeypatch.setattr(MadeUp, "drives", drives)
        names = NameSet()
        tracemalloc.start()
        blocks = list_blocks(["/fleet"])
        while window := list(islice(blocks, 20)):
            assert names.add(pa.concat_tables(window)["name"].to_pylist()).all()
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert len(names) == drives * DRIVE
        return size

    few = peak(20)
    # Python may enlarge its table of interned strings meanwhile, but not twice.
    many = min(peak(100), peak(100))
    assert (many - few) / (80 * DRIVE) < 40
