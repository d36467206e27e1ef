"""Every reader passes one suite; wrong input is named."""

from __future__ import annotations

import json
import pickle
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from amvnet.cli.options import LabelledChoice
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.nuscenes import NuScenes
from amvnet.data.datasets.open import is_dataset, open_dataset
from amvnet.data.datasets.training_data import to_train
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import SEMANTICKITTI

from fixtures.commands import fails, new_file
from fixtures.datasets import COUNTS, MAKERS, Layout, make_nuscenes, make_semantickitti
from fixtures.tiny import make_streets


@pytest.fixture(params=MAKERS)
def layout(request: pytest.FixtureRequest, tmp_path: Path) -> Layout:
    return MAKERS[request.param](tmp_path / "set")


@pytest.fixture
def dataset(layout: Layout) -> Dataset:
    return open_dataset(layout.spec)


def first_record(dataset: Dataset, layout: Layout) -> ScanFile:
    return dataset.records(layout.sequences[:1])[0]


@pytest.fixture
def record(dataset: Dataset, layout: Layout) -> ScanFile:
    return first_record(dataset, layout)


# --- the suite that every reader passes ---


def test_splits_are_those_on_disk(layout: Layout, dataset: Dataset) -> None:
    assert isinstance(dataset, Dataset)
    assert dataset.sequences("val") == (layout.sequences[0],)
    assert dataset.sequences("train") == (layout.sequences[1],)
    advice = f"not trained, such as --sequences {layout.sequences[0]}"
    fails(lambda: dataset.sequences("test"), dataset.root, "test", advice)
    fails(lambda: dataset.sequences("validation"), dataset.root, "'validation'")


def test_records_are_in_order_and_unique(layout: Layout, dataset: Dataset) -> None:
    first, second = layout.sequences
    records = dataset.records([first, second, first])

    assert [record.sequence for record in records] == sorted([first, first, second, second])
    assert len({record.name for record in records}) == 4
    assert len({record.prediction for record in records}) == 4
    assert [len(dataset.read(record)) for record in records] == [*COUNTS, *COUNTS]


def test_a_missing_sequence_is_answered_by_the_existing(layout: Layout, dataset: Dataset) -> None:
    fails(lambda: dataset.records(["77"]), dataset.root, "77", *layout.sequences)


def test_a_scan_has_points_intensities_and_labels_if_wanted(
    layout: Layout, dataset: Dataset, record: ScanFile
) -> None:
    scan = dataset.read(record)

    assert scan.points.dtype == np.float32
    assert scan.points[:, 3].tolist() == pytest.approx(layout.intensity)
    assert scan.labels is not None
    assert scan.labels.dtype == np.uint8
    assert scan.labels.tolist() == layout.truth
    assert scan.ring is None or scan.ring.tolist() == list(range(7))
    assert dataset.read(record, labels=False).labels is None


def test_predictions_round_trip(dataset: Dataset, record: ScanFile, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    ids = np.arange(1, 8)

    path = dataset.write_labels(record, folder, dataset.read(record), ids)
    assert path == folder / record.prediction
    assert list(path.parent.iterdir()) == [path]  # no temporary file is left
    assert path.stat().st_size == 7 * (4 if dataset.taxonomy.name == "semantickitti" else 1)

    predicted = dataset.read_prediction(record, folder)
    assert predicted.dtype == np.uint8
    assert predicted.tolist() == ids.tolist()


def test_unfit_ids_are_not_written(dataset: Dataset, record: ScanFile, tmp_path: Path) -> None:
    write = partial(dataset.write_labels, record, tmp_path, dataset.read(record))
    fails(lambda: write(np.ones(6)), record.path, 7)
    fails(lambda: write(np.full(7, 20)), "20")
    assert not (tmp_path / record.prediction).exists()


def test_wrong_predictions_are_named(
    layout: Layout, dataset: Dataset, record: ScanFile, tmp_path: Path
) -> None:
    path = tmp_path / "out" / record.prediction
    fails(lambda: dataset.read_prediction(record, tmp_path / "out"), path)

    path.parent.mkdir(parents=True)
    path.write_bytes(bytes(8 * 4))
    fails(lambda: dataset.read_prediction(record, tmp_path / "out"), path, "expected 7 labels")

    path.write_bytes(bytes([200]) * layout.first_labels.stat().st_size)
    fails(lambda: dataset.read_prediction(record, tmp_path / "out"), path, "raw ids")


def test_datasets_can_be_pickled(layout: Layout, dataset: Dataset) -> None:
    copy = pickle.loads(pickle.dumps(dataset))
    assert copy.records(layout.sequences) == dataset.records(layout.sequences)


def test_unusable_points_are_named(layout: Layout, dataset: Dataset, record: ScanFile) -> None:
    path = layout.first_points
    content = path.read_bytes()

    path.write_bytes(content[:-3])
    fails(lambda: dataset.read(record), path, "truncated")
    path.write_bytes(b"")
    fails(lambda: dataset.read(record), path, "0 points")
    np.full(len(content) // 4, np.nan, dtype=np.float32).tofile(path)
    fails(lambda: dataset.read(record), path, "NaN")
    path.unlink()
    fails(lambda: dataset.read(record), path)


def test_unusable_labels_are_named(layout: Layout, dataset: Dataset, record: ScanFile) -> None:
    path = layout.first_labels
    content = path.read_bytes()

    path.write_bytes(content[:4])
    fails(lambda: dataset.read(record), path, "expected 7 labels")

    path.write_bytes(b"\xc8" * len(content))
    unknown = "200" if len(content) == 7 else "51400"  # 0xC8, or 0xC8C8 of uint32
    fails(lambda: dataset.read(record), path, unknown)

    path.unlink()
    fails(lambda: open_dataset(layout.spec).read(record), path)


def test_nuscenes_without_labels_names_the_table_that_is_missing(tmp_path: Path) -> None:
    spec = make_nuscenes(tmp_path).spec
    (tmp_path / "v1.0-mini/lidarseg.json").unlink()
    fails(partial(LabelledChoice(split="val").records, open_dataset(spec)), "lidarseg.json: ")


@pytest.mark.parametrize("has_folder", [False, True])
def test_a_name_without_an_ending_is_of_the_yaml_file(tmp_path: Path, has_folder: bool) -> None:
    (tmp_path / "mine.yaml").write_text("classes: {a: 1}\n")
    if has_folder:
        (tmp_path / "mine").mkdir()
    fails(lambda: open_dataset(str(tmp_path / "mine")), f"did you mean {tmp_path}/mine.yaml?")


def test_lost_returns_of_nuscenes_get_the_most_frequent_class_in_files(tmp_path: Path) -> None:
    dataset = open_dataset(make_nuscenes(tmp_path).spec)
    record = dataset.records(dataset.sequences("all"))[0]
    scan = dataset.read(record)
    ids = np.full(len(scan), 5, dtype=np.uint8)
    ids[:2] = [0, 3]
    path = dataset.write_labels(record, tmp_path, scan, ids)
    assert np.fromfile(path, np.uint8).tolist() == [5, 3, *[5] * (len(scan) - 2)]
    assert ids[0] == 0

    # Other classes have an id for them.
    dataset.write_labels(record, tmp_path, scan, ids, taxonomy=SEMANTICKITTI)
    assert np.fromfile(path, np.uint8)[0] == 0


def test_a_lost_return_keeps_its_place(layout: Layout, dataset: Dataset, record: ScanFile) -> None:
    values = np.fromfile(layout.first_points, np.float32)
    values[0] = np.nan
    values.tofile(layout.first_points)
    assert dataset.read(record).valid.tolist() == [False] + [True] * 6


# --- properties of one layout ---


def test_semantickitti_without_labels_has_none(tmp_path: Path) -> None:
    layout = make_semantickitti(tmp_path)
    for path in layout.first_labels.parent.iterdir():
        path.unlink()

    dataset = open_dataset(layout.spec)
    record = first_record(dataset, layout)
    assert record.labels_path is None
    assert dataset.read(record).labels is None


def test_semantickitti_opens_at_the_sequences_folder(tmp_path: Path) -> None:
    make_semantickitti(tmp_path)
    first, second = open_dataset(str(tmp_path / "sequences")).records(["08"])
    assert (first.name, second.name) == ("08/000000", "08/000001")


def test_an_index_that_is_not_in_the_table_of_categories_is_refused(tmp_path: Path) -> None:
    layout = make_nuscenes(tmp_path)
    path = tmp_path / "v1.0-mini/category.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps([row for row in rows if row["name"] != "vehicle.car"]))
    (index,) = (row["index"] for row in rows if row["name"] == "vehicle.car")

    dataset = open_dataset(layout.spec)
    record = first_record(dataset, layout)
    assert record.labels_path is not None
    np.full(COUNTS[0], index, np.uint8).tofile(record.labels_path)
    fails(lambda: dataset.read(record), record.labels_path, f"found {index}", "tables that came")


def test_nuscenes_without_lidarseg_or_sensor_tables(tmp_path: Path) -> None:
    layout = make_nuscenes(tmp_path)
    for table in ("lidarseg", "calibrated_sensor", "sensor", "category"):
        (tmp_path / f"v1.0-mini/{table}.json").unlink()

    dataset = open_dataset(layout.spec)
    assert dataset.read(first_record(dataset, layout)).labels is None


def test_scans_that_are_not_in_the_table_of_labels_count_as_unlabelled(tmp_path: Path) -> None:
    layout = make_nuscenes(tmp_path)
    table = tmp_path / "v1.0-mini/lidarseg.json"
    listed = [row for row in json.loads(table.read_text()) if "0103-9" not in str(row)]
    table.write_text(json.dumps(listed))
    dataset = open_dataset(layout.spec)
    records = dataset.records(layout.sequences)
    labelled = dataset.labelled(records)
    (unlabelled,) = (record for record in records if record not in labelled)
    assert unlabelled.name == "scene-0103-9"
    fails(lambda: dataset.labelled([unlabelled]), "labelled scans", "1 scan")


def test_nuscenes_tables_that_cannot_be_used(tmp_path: Path) -> None:
    layout = make_nuscenes(tmp_path)
    folder = tmp_path / "v1.0-mini"

    scenes = folder / "scene.json"
    names = scenes.read_text()
    for name in ("5", '"../scene-0103"'):
        scenes.write_text(names.replace('"name": "scene-0103"', f'"name": {name}'))
        fails(lambda: open_dataset(layout.spec), "expected", name.strip('"'))
    scenes.write_text(names)

    categories = folder / "category.json"
    categories.write_text('[{"token": "a", "name": "a.submarine", "index": 1}]')
    fails(lambda: open_dataset(layout.spec), categories, "a.submarine")
    categories.write_text('[{"token": "a", "name": "vehicle.car"}]')
    fails(lambda: open_dataset(layout.spec), categories, "index")
    categories.write_text('[{"token": "a", "index": 1}]')
    fails(lambda: open_dataset(layout.spec), folder, "name")
    categories.write_text('[{"token": "a", "name": "vehicle.car", "index": 999}]')
    fails(lambda: open_dataset(layout.spec), folder)
    categories.write_text("[" * 100_000)
    fails(lambda: open_dataset(layout.spec), categories)

    for text in ('{"name": "vehicle.car"}', '["vehicle.car"]', "5"):
        categories.write_text(text)
        fails(lambda: open_dataset(layout.spec), categories, "expected a table")

    labels = new_file(folder / "lidarseg.json", '[{"sample_data_token": "a"}]')
    fails(lambda: open_dataset(layout.spec), folder, "filename")
    labels.unlink()
    samples = new_file(folder / "sample.json", '[{"token": "a"}]')
    fails(lambda: open_dataset(layout.spec), folder, "scene_token")
    samples.write_text("[")
    fails(lambda: open_dataset(layout.spec), samples)
    samples.unlink()
    fails(lambda: open_dataset(layout.spec), samples)


def test_key_frames_of_nuscenes_are_scans_in_the_order_of_time(tmp_path: Path) -> None:
    layout = make_nuscenes(tmp_path)
    expected = [record.name for record in open_dataset(layout.spec).records(layout.sequences)]
    expected.remove("scene-0103-9")
    path = tmp_path / "v1.0-mini/sample_data.json"
    rows = json.loads(path.read_text())
    for row in rows:
        row["is_key_frame"] &= row["token"] != "scene-0103-9"
    for table in (rows, rows[::-1]):
        path.write_text(json.dumps(table))
        records = open_dataset(layout.spec).records(layout.sequences)
        assert [record.name for record in records] == expected


def test_nuscenes_version_must_be_unambiguous(tmp_path: Path) -> None:
    make_nuscenes(tmp_path)
    (tmp_path / "v1.0-test").mkdir()
    fails(lambda: open_dataset(f"nuscenes:{tmp_path}"), tmp_path, "v1.0-mini", "v1.0-test")
    fails(lambda: open_dataset(f"nuscenes:{tmp_path}@v1.0-trainval"), tmp_path, "v1.0-mini")

    assert open_dataset(f"nuscenes:{tmp_path}@v1.0-mini").sequences("val") == ("scene-0103",)
    assert open_dataset(f"{tmp_path}@v1.0-mini").sequences("val") == ("scene-0103",)


def test_nuscenes_own_names_of_splits_are_taken(tmp_path: Path) -> None:
    dataset = open_dataset(make_nuscenes(tmp_path).spec)
    assert isinstance(dataset, NuScenes)
    assert dataset.scenes("mini_val") == dataset.scenes("val") == ("scene-0103",)
    assert dataset.scenes("mini_train") == dataset.scenes("train")


def test_of_sequences_to_train_on_none_is_advised(tmp_path: Path) -> None:
    dataset = open_dataset(str(make_streets(tmp_path, ("03", "04"), 1)))
    fails(lambda: dataset.sequences("test"), "not trained, with --sequences")


def test_a_scan_below_a_folder_with_an_at_sign_is_a_scan(tmp_path: Path) -> None:
    scan = tmp_path / "a@b" / "c.bin"
    scan.parent.mkdir()
    np.zeros((3, 4), np.float32).tofile(scan)
    assert not is_dataset(str(scan))
    assert is_dataset("nuscenes:somewhere@v1.0-mini")


def test_opening_names_what_it_looked_for(tmp_path: Path) -> None:
    fails(lambda: open_dataset(str(tmp_path / "no")), tmp_path / "no")
    fails(lambda: open_dataset(f"nuscenes:{tmp_path / 'no'}"), tmp_path / "no")
    fails(lambda: open_dataset(str(tmp_path)), tmp_path, "neither", "velodyne", "sample_data.json")
    fails(lambda: open_dataset(str(tmp_path)), "amvnet check", "YAML file")
    fails(lambda: open_dataset(f"semantickitti:{tmp_path}"), tmp_path, "velodyne")
    fails(lambda: open_dataset(f"nuscenes:{tmp_path}"), tmp_path, "v1.0-")

    make_semantickitti(tmp_path)
    fails(lambda: open_dataset(f"semantickitti:{tmp_path}@v1.0-mini"), tmp_path, "v1.0-mini")
    assert open_dataset(str(tmp_path)).taxonomy is SEMANTICKITTI


@pytest.mark.parametrize(
    "inside", ["sequences/08", "sequences/08/velodyne", "samples/LIDAR_TOP", "v1.0-mini"]
)
def test_a_part_of_a_dataset_names_the_folder_of_the_whole(tmp_path: Path, inside: str) -> None:
    make_semantickitti(tmp_path / "kitti")
    make_nuscenes(tmp_path / "nuscenes")
    (whole,) = [folder for folder in tmp_path.iterdir() if (folder / inside).is_dir()]
    fails(lambda: open_dataset(str(whole / inside)), "give the folder of the whole dataset", whole)


@pytest.mark.parametrize("folder", ["scans", "scans/monday", "drive/more/monday"])
@pytest.mark.parametrize("neighbour", ["drive/velodyne", "sequences/08/velodyne", "v1.0-mini"])
def test_a_neighbour_with_the_layout_of_a_dataset_does_not_change_the_advice(
    tmp_path: Path, folder: str, neighbour: str
) -> None:
    for name in (folder, neighbour):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / neighbour / "sample_data.json").touch()
    fails(lambda: open_dataset(str(tmp_path / folder)), "amvnet check", "YAML file")


def test_a_folder_with_a_description_names_the_yaml_file(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").touch()
    fails(lambda: open_dataset(str(tmp_path)), "give the YAML file", tmp_path / "mine.yaml")


@pytest.mark.parametrize(
    ("sequences", "train", "val"),
    [
        (("00", "01", "08", "11"), ("00", "01"), ("08",)),
        (("00", "01", "02"), ("00", "01"), ("02",)),
        (("00", "01", "11"), ("00",), ("01",)),
        (("08", "place"), ("place",), ("08",)),
    ],
)
def test_without_the_official_split_the_last_sequence_validates_and_tests_are_left_out(
    tmp_path: Path, sequences: tuple[str, ...], train: tuple[str, ...], val: tuple[str, ...]
) -> None:
    dataset = open_dataset(str(make_streets(tmp_path, sequences, 1)))
    assert (dataset.sequences("train"), dataset.sequences("val")) == (train, val)
    scans = to_train(dataset)
    assert tuple(record.sequence for record in scans.train) == train
    assert tuple(record.sequence for record in scans.val) == val


def test_a_lone_sequence_is_not_split(tmp_path: Path) -> None:
    dataset = open_dataset(str(make_streets(tmp_path, ("00", "11"), 1)))
    fails(lambda: to_train(dataset), "two sequences", "00 alone", "YAML")
    assert [record.sequence for record in to_train(dataset, with_val=True).train] == ["00"]
