"""Every reader passes one suite; wrong input is named."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.datasets.nuscenes import MINI_TRAIN, MINI_VAL, VAL
from amvnet.data.datasets.open import Dataset, is_dataset, open_dataset
from amvnet.data.taxonomy import SEMANTICKITTI, Taxonomy

from fixtures.datasets import COUNTS, MAKERS, Layout, make_nuscenes, make_semantickitti
from fixtures.worlds import fails

REAL = os.environ.get("AMVNET_REAL_DATA")


@pytest.fixture(params=MAKERS)
def layout(request: pytest.FixtureRequest, tmp_path: Path) -> Layout:
    return MAKERS[request.param](tmp_path / "set")


# --- the suite that every reader passes ---


def test_splits_are_those_on_disk(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    assert isinstance(dataset, Dataset)
    assert dataset.sequences("val") == (layout.sequences[0],)
    assert dataset.sequences("train") == (layout.sequences[1],)
    fails(lambda: dataset.sequences("test"), dataset.root, "test")
    fails(lambda: dataset.sequences("validation"), dataset.root, "'validation'")


def test_records_are_in_order_and_unique(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    records = dataset.records([*layout.sequences, layout.sequences[0]])
    assert [r.sequence for r in records] == sorted([*layout.sequences, *layout.sequences])
    assert len({r.name for r in records}) == len({r.prediction for r in records}) == 4
    assert [len(dataset.read(r)) for r in records] == [*COUNTS, *COUNTS]


def test_missing_sequence_lists_what_is_there(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    fails(lambda: dataset.records(["77"]), dataset.root, "77", *layout.sequences)


def test_scan_has_points_labels_and_intensity_in_unit_range(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    scan = dataset.read(dataset.records(layout.sequences[:1])[0])
    assert scan.points.dtype == np.float32
    assert scan.labels is not None
    assert scan.labels.dtype == np.uint8
    assert scan.labels.tolist() == layout.truth
    assert scan.points[:, 3].tolist() == pytest.approx(layout.intensity)
    assert scan.ring is None or scan.ring.tolist() == list(range(7))


def test_labels_are_none_where_not_wanted(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    assert dataset.read(dataset.records(layout.sequences[:1])[0], labels=False).labels is None


def test_predictions_round_trip(layout: Layout, tmp_path: Path) -> None:
    dataset = open_dataset(layout.spec)
    record = dataset.records(layout.sequences[:1])[0]
    ids = np.arange(1, 8)
    path = dataset.write_prediction(record, tmp_path / "out", ids)
    assert path == tmp_path / "out" / record.prediction
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no temporary file stays
    back = dataset.read_prediction(record, tmp_path / "out")
    assert back.dtype == np.uint8
    assert back.tolist() == ids.tolist()
    assert path.stat().st_size == 7 * (4 if dataset.taxonomy.name == "semantickitti" else 1)


def test_wrong_predictions_are_named(layout: Layout, tmp_path: Path) -> None:
    dataset = open_dataset(layout.spec)
    record = dataset.records(layout.sequences[:1])[0]
    out = tmp_path / "out" / record.prediction
    fails(lambda: dataset.read_prediction(record, tmp_path / "out"), out)
    fails(
        lambda: dataset.write_prediction(record, tmp_path / "out", np.ones(6)),
        record.points_path,
        7,
    )
    fails(lambda: dataset.write_prediction(record, tmp_path / "out", np.full(7, 20)), "20")
    assert not out.exists()
    out.parent.mkdir(parents=True)
    out.write_bytes(bytes(8 * 4))
    fails(lambda: dataset.read_prediction(record, tmp_path / "out"), out, "expected 7 labels")
    out.write_bytes(bytes([200]) * layout.first_labels.stat().st_size)
    fails(lambda: dataset.read_prediction(record, tmp_path / "out"), out, "raw ids")


def test_data_sets_can_be_pickled(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    copy = pickle.loads(pickle.dumps(dataset))
    assert copy.records(layout.sequences) == dataset.records(layout.sequences)


def test_unusable_points_are_named(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    record = dataset.records(layout.sequences[:1])[0]
    whole = layout.first_points.read_bytes()
    broken = {
        "truncated": whole[:-3],
        "0 points": b"",
        "NaN": np.full(len(whole) // 4, np.nan, dtype=np.float32).tobytes(),
    }
    for word, content in broken.items():
        layout.first_points.write_bytes(content)
        fails(lambda: dataset.read(record), layout.first_points, word)
    layout.first_points.unlink()
    fails(lambda: dataset.read(record), layout.first_points)


def test_unusable_labels_are_named(layout: Layout) -> None:
    dataset = open_dataset(layout.spec)
    record = dataset.records(layout.sequences[:1])[0]
    whole = layout.first_labels.read_bytes()
    layout.first_labels.write_bytes(whole[:4])
    fails(lambda: dataset.read(record), layout.first_labels, "expected 7 labels")
    layout.first_labels.write_bytes(b"\xc8" * len(whole))
    fails(lambda: dataset.read(record), layout.first_labels, "200" if len(whole) == 7 else "51400")
    layout.first_labels.unlink()
    fails(lambda: open_dataset(layout.spec).read(record), layout.first_labels)


def test_one_lost_return_keeps_its_place(layout: Layout) -> None:
    values = np.fromfile(layout.first_points, np.float32)
    values[0] = np.nan
    values.tofile(layout.first_points)
    dataset = open_dataset(layout.spec)
    scan = dataset.read(dataset.records(layout.sequences[:1])[0])
    assert scan.valid.tolist() == [False] + [True] * 6


# --- what only one layout has ---


def test_semantickitti_without_labels_has_none(tmp_path: Path) -> None:
    layout = make_semantickitti(tmp_path)
    for path in layout.first_labels.parent.iterdir():
        path.unlink()
    dataset = open_dataset(layout.spec)
    record = dataset.records(["08"])[0]
    assert record.labels_path is None
    assert dataset.read(record).labels is None


def test_semantickitti_opens_at_the_sequences_folder(tmp_path: Path) -> None:
    make_semantickitti(tmp_path)
    inner = open_dataset(str(tmp_path / "sequences"))
    assert [r.name for r in inner.records(["08"])] == ["08/000000", "08/000001"]


def test_nuscenes_without_lidarseg_or_sensor_tables(tmp_path: Path) -> None:
    layout = make_nuscenes(tmp_path)
    for table in ("lidarseg", "calibrated_sensor", "sensor", "category"):
        (tmp_path / f"v1.0-mini/{table}.json").unlink()
    dataset = open_dataset(layout.spec)
    assert dataset.read(dataset.records(layout.sequences)[0]).labels is None


def test_nuscenes_tables_that_cannot_be_used(tmp_path: Path) -> None:
    layout = make_nuscenes(tmp_path)
    folder = tmp_path / "v1.0-mini"
    (folder / "category.json").write_text('[{"token": "a", "name": "a.submarine", "index": 1}]')
    fails(lambda: open_dataset(layout.spec), folder / "category.json", "a.submarine")
    (folder / "category.json").write_text('[{"token": "a", "name": "vehicle.car"}]')
    fails(lambda: open_dataset(layout.spec), folder / "category.json", "index")
    (folder / "lidarseg.json").unlink()
    (folder / "sample.json").write_text('[{"token": "a"}]')
    fails(lambda: open_dataset(layout.spec), folder, "scene_token")
    (folder / "sample.json").write_text("[")
    fails(lambda: open_dataset(layout.spec), folder / "sample.json")
    (folder / "sample.json").unlink()
    fails(lambda: open_dataset(layout.spec), folder / "sample.json")


def test_nuscenes_version_has_to_be_clear(tmp_path: Path) -> None:
    make_nuscenes(tmp_path)
    (tmp_path / "v1.0-test").mkdir()
    fails(lambda: open_dataset(f"nuscenes:{tmp_path}"), tmp_path, "v1.0-mini", "v1.0-test")
    fails(lambda: open_dataset(f"nuscenes:{tmp_path}@v1.0-trainval"), tmp_path, "v1.0-mini")
    assert open_dataset(f"nuscenes:{tmp_path}@v1.0-mini").sequences("val") == ("scene-0103",)
    assert open_dataset(f"{tmp_path}@v1.0-mini").sequences("val") == ("scene-0103",)


def test_nuscenes_official_splits_have_their_sizes() -> None:
    assert (len(VAL), len(MINI_VAL), len(MINI_TRAIN)) == (150, 2, 8)
    assert {"scene-0103", "scene-0916", "scene-0003", "scene-1073"} <= VAL
    assert not MINI_VAL & MINI_TRAIN


def test_a_scan_below_a_folder_with_an_at_sign_is_a_scan(tmp_path: Path) -> None:
    scan = tmp_path / "a@b" / "c.bin"
    scan.parent.mkdir()
    np.zeros((3, 4), np.float32).tofile(scan)
    assert not is_dataset(str(scan))
    assert is_dataset("nuscenes:somewhere@v1.0-mini")


def test_catalog_names_what_it_looked_for(tmp_path: Path) -> None:
    fails(lambda: open_dataset(str(tmp_path / "no")), tmp_path / "no")
    fails(lambda: open_dataset(f"nuscenes:{tmp_path / 'no'}"), tmp_path / "no")
    fails(lambda: open_dataset(str(tmp_path)), tmp_path, "neither", "velodyne", "sample_data.json")
    fails(lambda: open_dataset(f"semantickitti:{tmp_path}"), tmp_path, "velodyne")
    fails(lambda: open_dataset(f"nuscenes:{tmp_path}"), tmp_path, "v1.0-")
    make_semantickitti(tmp_path)
    fails(lambda: open_dataset(f"semantickitti:{tmp_path}@v1.0-mini"), tmp_path, "v1.0-mini")
    assert open_dataset(str(tmp_path)).taxonomy is SEMANTICKITTI


def test_another_taxonomy_can_be_given(tmp_path: Path) -> None:
    layout = make_semantickitti(tmp_path)
    other = Taxonomy(
        "two",
        ("car", "rest"),
        ((0, 0, 0),) * 3,
        {252: 1, 40: 2, 99: 2, 81: 2},
        (0, 252, 40),
        {},
        True,
    )
    scan = open_dataset(layout.spec, other).read(
        open_dataset(layout.spec, other).records(["08"])[0]
    )
    assert scan.labels is not None
    assert scan.labels.tolist() == [1, 2, 2, 2, 1, 2, 2]


# --- real data ---


@pytest.mark.skipif(not REAL, reason="AMVNET_REAL_DATA does not name a folder")
@pytest.mark.parametrize(
    ("name", "sequence", "rings"), [("semantickitti", "07", 0), ("nuscenes", "scene-0523", 32)]
)
def test_real_scans_open(name: str, sequence: str, rings: int) -> None:
    dataset = open_dataset(str(Path(REAL or "") / name))
    records = dataset.records([sequence])
    scan = dataset.read(records[0])
    assert len(records) == 10
    assert len(scan) > 30_000
    assert 0 <= scan.points[:, 3].min() <= scan.points[:, 3].max() <= 1
    assert (
        (scan.ring is None)
        if not rings
        else (scan.ring is not None and scan.ring.max() == rings - 1)
    )
    assert (scan.labels is None) == (records[0].labels_path is None)
