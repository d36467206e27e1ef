"""Simulated streets are made when they are read, equal those in files, and share a cache."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.config.schema import AugmentConfig
from amvnet.data.datasets import simulated
from amvnet.data.datasets.base import Dataset
from amvnet.data.datasets.open import is_dataset, open_dataset
from amvnet.data.datasets.simulated import SimulatedStreets
from amvnet.data.datasets.training_data import Source, TrainingData, to_train
from amvnet.data.taxonomy import NUSCENES, SEMANTICKITTI, Taxonomy
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.lasers import lasers_by_order
from amvnet.sensors.lidars import KNOWN_SENSORS
from amvnet.training.loaders import ScanSet, make_loader
from lidarstreets import SimulatedScan, drive_street, simulate, writing

from fixtures.commands import fails, new_file, not_none
from fixtures.tiny import fake_drive

BENCHMARKS = {"hdl64e": SEMANTICKITTI, "hdl32e": NUSCENES, "vlp32c": SEMANTICKITTI}


@pytest.fixture(params=BENCHMARKS)
def sensor(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.fixture(autouse=True)
def simulated_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulated, "drive_street", fake_drive)


def streets(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("streets-*/*"))


@pytest.mark.parametrize("is_real", [False, pytest.param(True, marks=pytest.mark.full)])
def test_a_scan_equals_that_of_the_files_of_a_simulation(
    sensor: str, is_real: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("embreex")
    drive = drive_street if is_real else fake_drive
    monkeypatch.setattr(simulated, "drive_street", drive)
    monkeypatch.setattr(writing, "drive_street", lambda _, *rest: drive(sensor, *rest))
    scans = 2 if is_real else 1  # all stand-ins have the same time
    monkeypatch.setattr(simulated, "SCANS", scans)
    options: dict[str, Any] = {"sensor": sensor, "scans": scans, "seed": simulated.SEED}
    written = open_dataset(str(simulate(tmp_path / "files", first_sequence=12, **options)))

    dataset = pickle.loads(pickle.dumps(SimulatedStreets(tmp_path / "cache", sensor)))
    expected = written.records(written.sequences("all"))
    for record, written_record in zip(dataset.records(["12"]), expected, strict=True):
        scan = dataset.read(record)
        other = written.read(written_record)
        assert np.array_equal(scan.points, other.points)
        assert scan.points.dtype == other.points.dtype
        assert scan.labels is not None
        assert other.labels is not None
        assert np.array_equal(scan.labels, other.labels)
        assert scan.labels.dtype == other.labels.dtype
        if other.ring is None:
            if not is_real:
                continue
            # The order of the points in the files of SemanticKITTI tells their rings.
            lasers = not_none(KNOWN_SENSORS[sensor].beams)
            other = replace(other, ring=lasers_by_order(other.points, lasers))
        assert scan.ring is not None
        assert other.ring is not None
        assert np.array_equal(scan.ring, other.ring)
        assert scan.ring.dtype == other.ring.dtype


def test_streets_are_opened_by_the_name_of_their_sensor(sensor: str, tmp_path: Path) -> None:
    spec = f"simulated-{sensor}:{tmp_path / 'not' / 'there'}"
    assert is_dataset(spec)
    dataset = open_dataset(spec)
    assert isinstance(dataset, Dataset)
    assert dataset.taxonomy is BENCHMARKS[sensor]
    assert dataset.spec == spec
    assert vars(pickle.loads(pickle.dumps(dataset))) == vars(dataset)


def test_other_classes_are_refused(tmp_path: Path) -> None:
    fails(lambda: open_dataset(f"simulated-hdl64e:{tmp_path}", NUSCENES), "classes", "nuscenes")


def data_of(dataset: Dataset, *streets: str) -> TrainingData:
    return TrainingData([Source(dataset, dataset.records(streets))])


def test_the_splits_are_different_streets(sensor: str, tmp_path: Path) -> None:
    dataset = SimulatedStreets(tmp_path, sensor)
    train = dataset.sequences("train")
    assert train[:2] == ("000000", "000001")
    assert len(train) == {"hdl64e": 140, "hdl32e": 84, "vlp32c": 1000}[sensor]
    assert dataset.sequences("val") == tuple(f"90000{index}" for index in range(6))
    assert dataset.sequences("all") == (*train, *dataset.sequences("val"))
    fails(lambda: dataset.sequences("test"), "train, val, all", "test")

    scans = to_train(dataset)
    assert (len(scans.train), len(scans.val)) == (6 * len(train), 36)


def test_any_number_is_a_street(tmp_path: Path) -> None:
    records = SimulatedStreets(tmp_path).records(["31", "000007", "7"])
    assert [record.sequence for record in records] == ["000007"] * 6 + ["000031"] * 6
    assert [record.name for record in records[5:7]] == ["000007/000005", "000031/000000"]


@pytest.mark.parametrize("name", ["-1", "first", "1000000"])
def test_anything_but_a_number_is_no_street(name: str, tmp_path: Path) -> None:
    dataset = SimulatedStreets(tmp_path)
    fails(lambda: dataset.records([name]), "streets 0 to 999999", name)


def test_a_street_depends_on_its_number_alone(tmp_path: Path) -> None:
    first = SimulatedStreets(tmp_path / "a")
    second = SimulatedStreets(tmp_path / "b")
    points = {record.name: first.read(record).points for record in first.records(["3", "4"])}
    for record in reversed(second.records(["3", "4"])):
        assert np.array_equal(second.read(record).points, points[record.name])
    assert not np.array_equal(points["000003/000000"], points["000004/000000"])


def test_a_street_is_simulated_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = SimulatedStreets(tmp_path)
    first, *others = dataset.records(["3"])
    dataset.read(first)
    monkeypatch.delattr(simulated, "drive_street")
    for record in others:
        dataset.read(record)
    assert streets(tmp_path) == ["000003"]


def test_each_epoch_has_other_streets(tmp_path: Path) -> None:
    dataset = SimulatedStreets(tmp_path)
    train = dataset.records(["139"])[4]
    val = dataset.records(["900001"])[4]
    names = [dataset.at_epoch(train, epoch).name for epoch in range(3)]
    assert names == ["000139/000004", "001139/000004", "002139/000004"]
    for epoch in range(0, 5000, 7):
        assert int(dataset.at_epoch(train, epoch).sequence) < 900_000
        assert dataset.at_epoch(val, epoch) == val
    assert dataset.at_epoch(train, 1) == dataset.records(["1139"])[4]


def test_a_faster_process_street_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = SimulatedStreets(tmp_path)
    record = dataset.records(["5"])[0]

    def overtaken(*arguments: Any) -> Iterator[SimulatedScan]:
        monkeypatch.setattr(simulated, "drive_street", fake_drive)
        dataset.read(record)  # as another process, in the middle of this one's simulation
        yield from fake_drive(*arguments)

    monkeypatch.setattr(simulated, "drive_street", overtaken)
    assert len(dataset.read(record)) > 0
    assert streets(tmp_path) == ["000005"]


def test_a_failed_street_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = SimulatedStreets(tmp_path)

    def broken(*arguments: Any) -> Iterator[SimulatedScan]:
        yield from list(fake_drive(*arguments))[:2]
        raise OSError("no space left")

    monkeypatch.setattr(simulated, "drive_street", broken)
    with pytest.raises(OSError, match="no space"):
        dataset.read(dataset.records(["5"])[0])
    assert streets(tmp_path) == []


def test_streets_read_long_ago_make_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = SimulatedStreets(tmp_path)
    records = [dataset.records([str(number)])[0] for number in range(6)]
    for age, record in enumerate(records[:4]):
        dataset.read(record)
        long_ago = time.time() - 100 * (10 - age)  # only the order matters
        os.utime(record.path.parent, (long_ago, long_ago))
    dataset.read(records[0])  # now the latest

    size = sum(path.stat().st_size for path in records[0].path.parent.rglob("*.npy"))
    monkeypatch.setattr(simulated, "CACHE_BYTES", int(3.5 * size))
    dataset.read(records[4])
    assert streets(tmp_path) == ["000000", "000003", "000004"]

    # A street that is larger than the whole cache is read all the same.
    monkeypatch.setattr(simulated, "CACHE_BYTES", 1)
    assert len(dataset.read(records[5])) > 0
    assert streets(tmp_path) == ["000005"]
    assert len(dataset.read(records[1])) > 0


def test_only_streets_are_ever_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = new_file(tmp_path / "sequences/00/velodyne/000000.bin", bytes(1000))
    monkeypatch.setattr(simulated, "CACHE_BYTES", 1)
    dataset = SimulatedStreets(tmp_path)
    for record in dataset.records(["1", "2"]):
        dataset.read(record)
    assert kept.is_file()


def test_the_unfinished_street_of_a_killed_process_is_removed_later(tmp_path: Path) -> None:
    dataset = SimulatedStreets(tmp_path)
    first = dataset.records(["1"])[0]
    second = dataset.records(["2"])[0]
    folder = first.path.parent.parent
    for name in ("old", "new"):
        (folder / f".{name}.part/000000").mkdir(parents=True)
    long_ago = time.time() - 2 * simulated.ABANDONED
    os.utime(folder / ".old.part", (long_ago, long_ago))

    dataset.read(first)
    dataset.read(second)
    assert streets(tmp_path) == [".new.part", "000001", "000002"]


def test_broken_files_are_named(tmp_path: Path) -> None:
    dataset = SimulatedStreets(tmp_path)
    first, second = dataset.records(["1"])[:2]
    dataset.read(first)
    (first.path / "points.npy").write_bytes(b"")
    (second.path / "labels.npy").unlink()
    fails(lambda: dataset.read(first), first.path, "broken", "delete")
    fails(lambda: dataset.read(second), second.path.parent, "a part of them", "delete")


@pytest.mark.parametrize("workers", [0, 2])
def test_any_number_of_workers_gives_the_same_fresh_streets(workers: int, tmp_path: Path) -> None:
    dataset = SimulatedStreets(tmp_path)
    config = AugmentConfig(mix=0.5, laser_mix=0.5, paste=0.5)
    scans = ScanSet(data_of(dataset, "0", "1"), Expectation(), config)
    loader = make_loader(scans, batch=3, workers=workers, shuffle=True)
    for epoch in (0, 1):
        loader.sampler.set_epoch(epoch)  # type: ignore[attr-defined]
        keys = list(loader.sampler)
        names = []
        for batch in loader:
            assert isinstance(batch, tuple)
            points, _, _ = batch
            for name, part in zip(points.names, points.slices, strict=True):
                names.append(name)
                key = keys[len(names) - 1]
                assert np.array_equal(points.points[part].numpy(), scans[key].points)
        assert {name[:6] for name in names} == {f"00{epoch}000", f"00{epoch}001"}
    assert streets(tmp_path) == ["000000", "000001", "001000", "001001"]


def test_validation_has_the_same_streets_in_every_epoch(tmp_path: Path) -> None:
    scans = ScanSet(data_of(SimulatedStreets(tmp_path), "7"), Expectation())
    assert scans[4, 2].name == scans[0, 2].name == "000007/000002"


@pytest.mark.parametrize("taxonomy", [SEMANTICKITTI, NUSCENES])
def test_objects_to_paste_are_rare_classes_of_each_set(taxonomy: Taxonomy, tmp_path: Path) -> None:
    dataset = SimulatedStreets(tmp_path, "hdl64e" if taxonomy is SEMANTICKITTI else "hdl32e")
    scans = ScanSet(data_of(dataset), Expectation())
    names = {taxonomy.classes[train_id - 1] for train_id in scans.pasted}
    assert {"bicycle", "motorcycle", "truck"} <= names
    assert not names & {"car", "road", "sidewalk", "driveable_surface", "vegetation"}
