"""Rows of numbers without names are recognised by their values, or read as the user says."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.data.formats.find import find_scans, list_scans, read_cloud
from amvnet.data.formats.rows import NAMES, RowLayout, are_rings, name_columns, parse_layout
from amvnet.data.formats.text import find_table

from fixtures.commands import fails, new_file, not_none
from fixtures.growth import takes_linear_time
from fixtures.sensors import LASERS, place

TIME = 1.6e9  # seconds, of the first point


@pytest.fixture(scope="module")
def table() -> np.ndarray:
    """(N, 6) x, y, z, intensity, ring and time of a scan."""
    points, ring = place(LASERS["vlp16"], 0.9)
    return np.column_stack([points, ring, TIME + np.linspace(0, 0.1, len(points))])


def row_bytes(table: np.ndarray, dtype: str = "float32") -> bytes:
    return table.astype(dtype).tobytes()


def write_rows(folder: Path, table: np.ndarray, dtype: str = "float32") -> Path:
    return new_file(folder / "a.bin", row_bytes(table, dtype))


@pytest.mark.parametrize("order", ["as recorded", "shuffled"])
@pytest.mark.parametrize("columns", ["xyzi", "xyzir"])
def test_the_columns_of_kitti_and_nuscenes_are_told_by_the_values(
    table: np.ndarray, tmp_path: Path, columns: str, order: str
) -> None:
    if order == "shuffled":
        table = np.random.default_rng(0).permutation(table)
    cloud = read_cloud(write_rows(tmp_path, table[:, : len(columns)]))
    np.testing.assert_array_equal(cloud.xyz, table[:, :3].astype("f4"))
    np.testing.assert_array_equal(cloud.intensity, table[:, 3].astype("f4"))
    assert (cloud.ring is not None) == ("r" in columns)


def rows_of_other_layouts(table: np.ndarray) -> dict[str, bytes]:
    """Return the bytes of files that are not as KITTI's and nuScenes'."""
    rng = np.random.default_rng(0)
    tables = {
        "xyz": table[:, :3],
        "normals": np.column_stack([table[:, :3], rng.normal(0, 0.6, (len(table), 3))]),
        "two returns": np.column_stack([table[:, :4], table[:, :4] * 1.1, table[:, 5]]),
        "times": table[:, [0, 1, 2, 3, 5]],
        "rings and times": table,
        "colours": np.column_stack([table[:, :3], rng.integers(0, 256, (len(table), 3))]),
        "standardised": table[:, :4] - [0, 0, 0, 0.5],
    }
    files = {name: row_bytes(rows) for name, rows in tables.items()}
    for count in (3, 4, 5, 6):
        files[f"{count} doubles"] = row_bytes(table[:, :count], "float64")
        files[f"{count} doubles of floats"] = row_bytes(table.astype("f4")[:, :count], "float64")
    return files


@pytest.mark.parametrize("order", ["as recorded", "shuffled"])
def test_other_columns_are_asked_for(table: np.ndarray, tmp_path: Path, order: str) -> None:
    if order == "shuffled":
        table = np.random.default_rng(0).permutation(table)
    for name, content in rows_of_other_layouts(table).items():
        path = new_file(tmp_path / f"{name}.bin", content)
        fails(lambda path=path: read_cloud(path), path, "--columns", "--dtype")  # type: ignore[misc]


def test_lost_and_wild_points_do_not_hide_the_columns(table: np.ndarray, tmp_path: Path) -> None:
    rows = table[:, :4].astype("f4")
    rows[::7, :3] = np.nan
    rows[1] = (1e6, 0, 0, -1)
    np.testing.assert_array_equal(read_cloud(write_rows(tmp_path, rows)).xyz, rows[:, :3])


@pytest.mark.parametrize("columns", [4, 5])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 0.0])
def test_lost_returns_may_have_any_value_that_is_no_place(
    table: np.ndarray, tmp_path: Path, columns: int, value: float
) -> None:
    rows = table[:, :columns].astype("f4")
    rows[::3, :3] = value
    rows[::6, 3] = -1  # as simulators write for a lost return
    rows[3::6, 3] = value
    cloud = read_cloud(write_rows(tmp_path, rows))
    np.testing.assert_array_equal(cloud.xyz, rows[:, :3])
    assert cloud.to_scan().valid.tolist() == [index % 3 > 0 for index in range(len(rows))]


@pytest.mark.parametrize("columns", [4, 5])
def test_a_truncated_file_keeps_columns(table: np.ndarray, tmp_path: Path, columns: int) -> None:
    content = row_bytes(table[:, :columns])
    path = tmp_path / "a.bin"
    for removed in range(1, columns):
        path.write_bytes(content[: len(content) - removed * 4])
        fails(lambda: read_cloud(path), path, "--columns", "--dtype")


def test_values_that_fit_nothing_are_refused_and_both_options_named(tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.bin", np.random.default_rng(0).bytes(60_000))
    fails(lambda: read_cloud(path), path, "--columns x,y,z,intensity,ring", "--dtype float32")


def test_rows_of_coordinates_are_asked_for_by_name(table: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    # The size may be a multiple of KITTI's or nuScenes' rows, or not.
    for left_out in reversed(range(5)):
        write_rows(tmp_path, table[left_out:, :3])
        fails(lambda: read_cloud(path), path, "say --columns x,y,z if the rows have no more")
    cloud = read_cloud(path, parse_layout("x,y,z", None))
    np.testing.assert_array_equal(cloud.xyz, table[:, :3].astype("f4"))


def test_a_file_that_ends_in_a_row_is_called_truncated(table: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    data = row_bytes(table[:, :4])
    assert len(data) > 5000
    path.write_bytes(data[:-1])
    fails(lambda: read_cloud(path), path, f"{len(data) - 1} bytes", "copy the file again")


def test_a_table_written_column_by_column_is_refused(table: np.ndarray, tmp_path: Path) -> None:
    """As the scans of Oxford RobotCar are: all x, then all y and so on."""
    path = write_rows(tmp_path, table[:, :4].T)
    fails(lambda: read_cloud(path), path, "found values that fit neither")


def test_rows_in_millimetres_are_read_by_named_columns(table: np.ndarray, tmp_path: Path) -> None:
    rows = table[:, :4] * [1000, 1000, 1000, 1]
    path = write_rows(tmp_path, rows)
    fails(lambda: read_cloud(path), path, "--columns x,y,z,intensity if these are millimetres")
    cloud = read_cloud(path, parse_layout("x,y,z,intensity", None))
    np.testing.assert_allclose(cloud.xyz, rows[:, :3], rtol=1e-6)


def test_rows_without_a_finite_number_are_named(table: np.ndarray, tmp_path: Path) -> None:
    path = write_rows(tmp_path, np.full_like(table[:, :4], np.nan))
    fails(lambda: read_cloud(path), path, "found no finite number")


def test_the_user_s_columns_count(table: np.ndarray, tmp_path: Path) -> None:
    for dtype in (None, "float64"):
        path = write_rows(tmp_path, table[:, [5, 4, 2, 1, 0, 3]], dtype or "float32")
        cloud = read_cloud(path, parse_layout("time,ring,z,y,x,intensity", dtype))
        np.testing.assert_array_equal(cloud.xyz, table[:, :3].astype(dtype or "float32"))
        np.testing.assert_array_equal(cloud.intensity, table[:, 3].astype(dtype or "float32"))
        np.testing.assert_array_equal(cloud.ring, table[:, 4])
    fails(lambda: read_cloud(path, parse_layout("x,y,z", "float16,float32")), "--columns")


def test_each_column_can_have_its_own_type(table: np.ndarray, tmp_path: Path) -> None:
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("i", "u1"), ("ring", "u2"), ("time", "f8")]
    records = np.zeros(len(table), fields)
    for (name, _), values in zip(fields, table.T, strict=True):
        records[name] = np.round(values * 255) if name == "i" else values
    path = tmp_path / "a.bin"
    records.tofile(path)

    layout = parse_layout("x,y,z,i,ring,_", "float32,float32,float32,uint8,uint16,float64")
    (scan,) = list_scans(path, layout=layout)
    cloud = scan.read()
    np.testing.assert_array_equal(cloud.xyz, table[:, :3].astype("f4"))
    np.testing.assert_array_equal(cloud.intensity, records["i"])
    np.testing.assert_array_equal(cloud.ring, records["ring"])
    assert cloud.intensity_scale() == 255


def test_columns_of_arrays_can_be_named(table: np.ndarray, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", table[:, [2, 1, 0, 3]])
    cloud = read_cloud(tmp_path / "a.npy", RowLayout(("z", "y", "x", "intensity")))
    np.testing.assert_array_equal(cloud.xyz, table[:, :3])
    fails(
        lambda: read_cloud(tmp_path / "a.npy", RowLayout(tuple("xyzabc"))), "names of the columns"
    )


@pytest.mark.parametrize(
    ("columns", "dtype", "word"),
    [
        ("x,y,intensity", None, "--columns"),
        ("x,x,y,z", None, "--columns"),
        ("", None, "--columns"),
        (None, "float33", "--dtype"),
        (None, "complex64", "--dtype"),
        (None, "object", "--dtype"),
        ("x,y,z", "float32,float32", "--dtype"),
        (None, "float64", "--columns"),
    ],
)
def test_impossible_options_are_refused(columns: str | None, dtype: str | None, word: str) -> None:
    fails(lambda: parse_layout(columns, dtype), word)


# --- text ---

HEADERS = {
    "names": "x,y,z,intensity,ring\n",
    "quotes": '"X","Y","Z","Intensity","ring"\n',
    "units": "x [m],y [m],z [m],intensity,laser_id\n",
    "VeloView": "Points:0,Points:1,Points:2,intensity,laser_id\n",
    "ParaView": '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","intensity","laser_id"\n',
    "ouster-cli": "# X1 (m), Y1 (m), Z1 (m), REFLECTIVITY (%), CHANNEL\n",
    "comment": "# written by a tool\n# x,y,z,intensity,ring\n",
    "slashes": "//X,Y,Z,Intensity,ring\n",
    "byte order mark": "\ufeffx,y,z,intensity,ring\n",
    "none": "",
    "byte order mark alone": "\ufeff",
    "number of points": "5760\n",
}


def text_of(table: np.ndarray, separator: str = ",") -> str:
    lines = []
    for row in table:
        numbers = [f"{value:.3f}" for value in row[:4]] + [f"{value:.0f}" for value in row[4:5]]
        lines.append(separator.join(numbers))
    return "\n".join(lines) + "\n"


def check_text(path: Path, table: np.ndarray) -> None:
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.xyz, table[:, :3], atol=0.0006)
    np.testing.assert_allclose(not_none(cloud.intensity), table[:, 3], atol=0.0006)
    np.testing.assert_array_equal(cloud.ring, table[:, 4])


@pytest.mark.parametrize("header", HEADERS)
def test_text_is_read_with_any_header(table: np.ndarray, tmp_path: Path, header: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(HEADERS[header] + text_of(table), encoding="utf-8")
    check_text(path, table)


@pytest.mark.parametrize("name", ["a.xyz", "a.txt", "a.csv", "a.asc", "a.pts", "a", "a.dat"])
@pytest.mark.parametrize("separator", [" ", "\t", "; ", ", ", "  "])
def test_text_is_read_with_any_separator_and_name(
    table: np.ndarray, tmp_path: Path, name: str, separator: str
) -> None:
    path = new_file(tmp_path / name, text_of(table[:400], separator).replace("\n", "\r\n"))
    check_text(path, table[:400])


@pytest.mark.parametrize("end", [",\n", ";\n", " \n", "\r"])
def test_text_is_read_with_any_ends_of_lines(table: np.ndarray, tmp_path: Path, end: str) -> None:
    path = tmp_path / "a.csv"
    separator = end[0] if end[0] in ",;" else " "
    path.write_bytes(text_of(table[:50], separator).replace("\n", end).encode())
    check_text(path, table[:50])


def test_columns_of_text_can_have_any_order_and_words_among_them(tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.csv", "label,z,y,x\ncar,3,2,1\nroad,6,5,4\n")
    assert read_cloud(path).xyz.tolist() == [[1, 2, 3], [4, 5, 6]]


def test_text_of_other_things_is_refused(tmp_path: Path) -> None:
    texts = ["hello\n", "1 2\n3 4\n", "x,y,z\n", "P0: 1 2 3\n", "1 2 3\n4 5\n"]
    texts.append("a line of a log\n" * 30 + "1 2 3\n")
    for text in texts:
        path = new_file(tmp_path / "a.txt", text)
        fails(lambda path=path: read_cloud(path), path)  # type: ignore[misc]
        assert find_table(text.encode()) is None


@pytest.mark.parametrize("separator", [";", " ", "\t"])
def test_decimal_commas_are_named(separator: str, tmp_path: Path) -> None:
    path = new_file(tmp_path / "a.csv", f"1,5{separator}-2,0{separator}0,25\n" * 5)
    for scan in (path, tmp_path):
        fails(lambda scan=scan: read_cloud(scan), path, "found decimal commas")  # type: ignore[misc]

    path.write_text(separator.join(["0,5"] * 12) + "\n")  # a pose
    fails(lambda: read_cloud(tmp_path), tmp_path, "found none in it")


def test_text_files_of_a_folder_are_scans_only_if_nothing_else_is(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("read me")
    (tmp_path / "a.csv").write_text("1,2,3\n")
    (tmp_path / "b.xyz").write_text("1 2 3\n")
    assert find_scans(tmp_path) == [tmp_path / "a.csv", tmp_path / "b.xyz"]

    (tmp_path / "c.bin").touch()
    assert find_scans(tmp_path) == [tmp_path / "c.bin"]


def test_poses_next_to_a_folder_of_scans_are_no_scan(tmp_path: Path) -> None:
    scan = tmp_path / "velodyne/000000.bin"
    scan.parent.mkdir()
    scan.touch()
    np.savetxt(tmp_path / "poses.txt", np.ones((30, 12)))
    fails(lambda: find_scans(tmp_path), scan.parent)


# --- which files ---


def test_patterns_name_scans(tmp_path: Path) -> None:
    for name in ("a/1.bin", "a/2.bin", "a/1.label", "b/1.bin", "b/.2.bin"):
        new_file(tmp_path / name, np.ones((2, 4), np.float32).tobytes())

    def names(pattern: str) -> list[str]:
        return [scan.name for scan in list_scans(tmp_path / pattern)]

    assert names("a/*") == ["1", "2"]
    assert names("?/1.bin") == ["a/1", "b/1"]
    assert names("*") == ["a/1", "a/2", "b/1"]
    assert names("**/*.bin") == ["a/1", "a/2", "b/1"]
    fails(lambda: names("a/*.pcd"), "*.pcd")
    # A folder without scans names the one below that has some.
    fails(lambda: names(""), tmp_path / "a")


def test_a_pattern_takes_the_scans_of_many_drives(tmp_path: Path) -> None:
    for drive in ("0001", "0005"):
        data = tmp_path / f"2011_09_26_drive_{drive}_sync/velodyne_points/data"
        new_file(data.parent / "timestamps.txt", "2011-09-26 13:02:25.594360375\n")
        new_file(data / "0000000000.bin", np.ones((2, 4), np.float32).tobytes())

    (data.parent / "classes").mkdir()
    np.save(data.parent / "classes/0000000000.npy", np.ones(2, np.uint8))  # labels are no scans
    fails(lambda: list(list_scans(data.parents[1])), f"give the folder of scans, such as {data}")
    names = [scan.name for scan in list_scans(tmp_path / "*/velodyne_points/data")]
    folder = "_sync/velodyne_points/data/0000000000"
    assert names == [f"2011_09_26_drive_0001{folder}", f"2011_09_26_drive_0005{folder}"]


def test_patterns_of_any_folders_follow_links_once(table: np.ndarray, tmp_path: Path) -> None:
    drives = tmp_path / "drives"
    elsewhere = tmp_path / "disk"
    for folder in (drives / "a", elsewhere / "deep"):
        new_file(folder / "0.bin", row_bytes(table[:, :4]))
    (drives / "b").symlink_to(elsewhere)
    for name in ("up", "again"):  # many ways around in circles
        (drives / "a" / name).symlink_to(drives)
        (elsewhere / "deep" / name).symlink_to(drives)
    (drives / "0").symlink_to(drives / "a")  # the folder has its own name

    expected = [drives / "a/0.bin", drives / "b/deep/0.bin"]
    assert find_scans(drives / "**/*.bin") == expected
    assert find_scans(drives / "*/**/0.bin")
    path = new_file(drives / "own.yaml", 'classes: {a: 1}\nscans: "**/*.bin"\n')
    data = open_dataset(str(path))
    assert [record.path for record in data.records(data.sequences("all"))] == expected


@pytest.mark.parametrize("has_circles", [False, True])
def test_the_folders_of_a_pattern_are_read_once_for_each_any_folders(
    has_circles: bool, table: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path
    for _ in range(6):
        folder /= "d"
        folder.mkdir()
        if has_circles:
            (folder / "up").symlink_to(tmp_path)
    (folder / "0.bin").write_bytes(row_bytes(table[:, :4]))
    counts = [0]

    def counted(read: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            counts[-1] += 1
            assert counts[-1] < 100_000  # much more would take minutes
            return read(*arguments)

        return call

    monkeypatch.setattr(os, "scandir", counted(os.scandir))
    monkeypatch.setattr(Path, "iterdir", counted(Path.iterdir))
    for any_folders in (3, 9):
        counts.append(0)
        assert find_scans(tmp_path / f"{'**/' * any_folders}*.bin") == [folder / "0.bin"]
    _, few, many = counts
    assert 0 < many < 4 * few

    (tmp_path / "own.yaml").write_text(f'classes: {{a: 1}}\nscans: "{"**/" * 7}*.bin"\n')
    data = open_dataset(str(tmp_path / "own.yaml"))
    (record,) = data.records(data.sequences("all"))
    assert record.path == folder / "0.bin"
    assert find_scans(tmp_path / "**/d/**/d/**/d/**/d/**/*.bin") == [folder / "0.bin"]


def test_the_time_of_a_name_of_a_column_is_proportional_to_its_length() -> None:
    def find(length: int) -> None:
        line = "x" + " " * length + "y"
        assert find_table(f"{line}\n1,2,3\n4,5,6\n".encode()) is not None

    takes_linear_time(find, 15_000)


def test_colours_after_the_intensity_are_no_rings() -> None:
    rng = np.random.default_rng(0)
    scan = np.column_stack([rng.normal(0, 10, (5000, 3)), rng.random(5000)])
    colors = rng.integers(0, 256, (5000, 3))  # each value is equally frequent, as lasers are
    assert are_rings(scan[:, :3], colors[:, 0])
    assert name_columns(np.column_stack([scan, colors])) == (*NAMES[:4], "_", "_", "_")


def test_equally_frequent_labels_with_gaps_are_no_rings() -> None:
    xyz = np.random.default_rng(0).normal(0, 10, (2600, 3))
    labels = np.arange(2600) % 26
    assert are_rings(xyz, labels)
    assert not are_rings(xyz, labels * 9)
