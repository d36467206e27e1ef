"""Simulated datasets: equal on any number of processes, resumed after a stop, read as real ones."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from lidarstreets import LIDAR_MODELS, SimulatedScan, SimulationError, simulate, writing
from lidarstreets.sensing.sensors import LidarModel

from fixtures.commands import contents, new_file
from fixtures.tiny import fake_drive, make_simulation_quick
from fixtures.waiting import wait_for_end

pytest.importorskip("embreex")

LINUX = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")
SCENES = ("simulated-0000", "simulated-0001")
SETTINGS: dict[str, Any] = {"sensor": "hdl32e", "sequences": 2, "scans": 3, "seed": 2}


def drive_quickly(
    model: LidarModel, scans: int, seed: np.random.SeedSequence, *how: object
) -> Iterator[SimulatedScan]:
    """Yield scans of `fake_drive` from a sensor that drives on."""
    (name,) = (name for name, other in LIDAR_MODELS.items() if other == model)
    for index, scan in enumerate(fake_drive(name, scans, seed)):
        pose = np.eye(4)
        pose[0, 3] = 8.0 * index
        yield replace(scan, pose=pose, time=float(index))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `simulate` write scans at once, in this process."""
    monkeypatch.setattr(writing, "drive_street", drive_quickly)


@pytest.fixture(scope="module")
def nuscenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes of three scans each, which take no time to simulate."""
    folder = tmp_path_factory.mktemp("nuscenes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writing, "drive_street", drive_quickly)
        return simulate(folder, **SETTINGS)


@pytest.fixture(scope="module")
def real_nuscenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two simulated scenes of three scans each."""
    return simulate(tmp_path_factory.mktemp("nuscenes"), **SETTINGS)


def table(folder: Path, name: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads((folder / f"v1.0-trainval/{name}.json").read_text())
    return rows


@pytest.mark.full
def test_two_processes_write_the_same_bytes_as_one(real_nuscenes: Path, tmp_path: Path) -> None:
    assert contents(simulate(tmp_path, **SETTINGS, processes=2)) == contents(real_nuscenes)


def test_a_stopped_simulation_ends_the_same(nuscenes: Path, quick: None, tmp_path: Path) -> None:
    def stop_after_four_scans(done: int, total: int) -> None:
        if done == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path, **SETTINGS, progress=stop_after_four_scans)

    counts: list[int] = []
    simulate(tmp_path, **SETTINGS, progress=lambda done, total: counts.append(done))
    assert counts == [4, 5, 6]  # the first scene was complete
    assert contents(tmp_path) == contents(nuscenes)


SCANS = 1000  # of each sequence, far more than are ever written


def run_on_two_processes(out: Path) -> subprocess.Popen[bytes]:
    """Start a long simulation, as the leader of a group of processes; return once it writes."""
    command = [sys.executable, "-m", "lidarstreets", str(out)]
    parent = subprocess.Popen(
        [*command, "--sequences", "2", "--scans", str(SCANS), "--processes", "2"],
        stderr=subprocess.PIPE,
        start_new_session=True,
        # Tests that a shell started in the background ignore SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    while len(list((out / "sequences").glob("*/labels/000000.label"))) < 2:
        assert parent.poll() is None
        time.sleep(0.05)  # only until the files are looked for again
    return parent


def workers_of(parent: subprocess.Popen[bytes]) -> list[Path]:
    """Return the folders in /proc of the processes that simulate."""
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    processes = [Path(f"/proc/{child}") for child in children]
    return [process for process in processes if b"spawn_main" in (process / "cmdline").read_bytes()]


@pytest.mark.full
@LINUX
def test_no_process_outlives_one_that_was_killed(tmp_path: Path) -> None:
    with run_on_two_processes(tmp_path) as parent:
        workers = workers_of(parent)
        assert len(workers) == 2
        parent.kill()

    for worker in workers:
        wait_for_end(int(worker.name))
    assert not list(tmp_path.rglob("*.part*"))


@pytest.mark.full
@LINUX
def test_each_process_computes_with_one_thread(tmp_path: Path) -> None:
    """A second thread of each waits for the parent to end. Embree would start one a processor."""
    with run_on_two_processes(tmp_path) as parent:
        threads = [len(list((worker / "task").iterdir())) for worker in workers_of(parent)]
        parent.kill()
    assert threads == [2, 2]


@pytest.mark.full
@LINUX
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_to_all_processes_stops_them_amid_their_scans_and_leaves_whole_files(
    number: signal.Signals, code: int, tmp_path: Path
) -> None:
    with run_on_two_processes(tmp_path) as parent:
        workers = workers_of(parent)
        os.killpg(parent.pid, number)
        _, complaint = parent.communicate()

    assert parent.returncode == code
    assert complaint.count(b"\n") == (number == signal.SIGINT)
    assert not any(map(is_running, workers))
    for folder in (tmp_path / "sequences").iterdir():
        assert len(list(folder.glob("labels/*"))) < SCANS
        for path in folder.rglob("*.*"):
            assert path.suffix == ".bin" or path.with_suffix(".label").is_file()
    assert not list(tmp_path.rglob("*.part*"))


def is_running(process: Path) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        stat = (process / "stat").read_text()
    except OSError:
        return False
    return stat.rsplit(")", 1)[1].split()[0] != "Z"


def test_a_complete_simulation_is_kept(nuscenes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writing, "drive_street", lambda *_: pytest.fail("simulated again"))
    before = contents(nuscenes)
    simulate(nuscenes, **SETTINGS)
    assert contents(nuscenes) == before


@pytest.mark.parametrize("content", ["", "{", "[]", '{"seed": 3}', "[" * 100_000, "\x00" * 9])
def test_a_sequence_whose_record_is_broken_is_written_again(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut may leave an empty file."""
    make_simulation_quick(monkeypatch)
    settings: dict[str, Any] = {"scans": 1, "seed": 3}
    simulate(tmp_path, sequences=2, **settings)
    before = contents(tmp_path)
    (tmp_path / ".simulation/0001.json").write_text(content)
    with pytest.raises(SimulationError, match=r"0001\.json: expected .* simulate sequence 0001"):
        simulate(tmp_path, sequences=1, **settings)
    simulate(tmp_path, sequences=2, **settings)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("other", [{"seed": 3}, {"scans": 4}, {"sensor": "hdl64e"}])
def test_a_folder_with_other_settings_is_refused(nuscenes: Path, other: dict[str, Any]) -> None:
    settings: dict[str, Any] = {"sensor": "hdl32e", "scans": 3, "seed": 2} | other
    with pytest.raises(SimulationError, match="another folder") as caught:
        simulate(nuscenes, **settings)
    assert str(nuscenes) in str(caught.value)


@pytest.mark.full
def test_simulated_nuscenes_is_read_as_the_real_one(real_nuscenes: Path) -> None:
    dataset = open_dataset(f"nuscenes:{real_nuscenes}")
    assert dataset.sequences("all") == SCENES
    classes: set[int] = set()
    for record in dataset.records(SCENES):
        scan = dataset.read(record)
        assert scan.ring is not None
        assert scan.labels is not None
        classes |= set(scan.labels.tolist())
        assert (np.bincount(scan.ring) == 1084).all()  # a point for each shot, as in nuScenes

        # Lost returns, and the roof of the car: a tenth of its points have the class of cars.
        is_near = np.linalg.norm(scan.points[:, :3], axis=1) < 1
        assert set(scan.labels[is_near]) == {0, 4}
        assert 0.7 < is_near.sum() / (4_180 + 3_000) < 1.4

        x, y, z = scan.points[:, :3].T
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        error = np.abs(elevation - (-30.66 + scan.ring * 4 / 3))[~is_near]
        assert np.median(error) < 0.5  # the device of each drive is a little off
        assert error.max() < 2.5  # correcting the motion of the sensor moves points off their beams

    # Car, driveable surface, sidewalk, terrain, manmade, vegetation.
    assert classes >= {4, 11, 13, 14, 15, 16}


def test_simulated_nuscenes_drives_forward_along_y(nuscenes: Path) -> None:
    """The LiDAR looks to the right: its x is right, its y is forward; poses have x forward."""
    rotation = np.array(table(nuscenes, "calibrated_sensor")[0]["rotation"])
    np.testing.assert_allclose(rotation, [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)])
    first, second = (row["translation"] for row in table(nuscenes, "ego_pose")[:2])
    np.testing.assert_allclose(first, 0, atol=1e-9)
    assert 7 < second[0] < 9


@pytest.mark.parametrize(
    ("name", "key", "target"),
    [
        ("sample", "scene_token", "scene"),
        ("sample_data", "sample_token", "sample"),
        ("sample_data", "ego_pose_token", "ego_pose"),
        ("sample_data", "calibrated_sensor_token", "calibrated_sensor"),
        ("calibrated_sensor", "sensor_token", "sensor"),
        ("lidarseg", "sample_data_token", "sample_data"),
        ("scene", "log_token", "log"),
        ("scene", "first_sample_token", "sample"),
        ("scene", "last_sample_token", "sample"),
    ],
)
def test_every_token_leads_to_a_row(nuscenes: Path, name: str, key: str, target: str) -> None:
    tokens = [row["token"] for row in table(nuscenes, target)]
    references = {row[key] for row in table(nuscenes, name)}
    assert len(set(tokens)) == len(tokens)
    assert references
    assert references <= set(tokens)


@pytest.mark.parametrize(("name", "links"), [("sample", 6), ("sample_data", 6)])
def test_scans_are_linked_in_the_order_of_time(nuscenes: Path, name: str, links: int) -> None:
    rows = {row["token"]: row for row in table(nuscenes, name)}
    assert len(rows) == links
    firsts = [row for row in rows.values() if not row["prev"]]
    assert len(firsts) == len(SCENES)
    for first in firsts:
        chain = [first]
        while chain[-1]["next"]:
            chain.append(rows[chain[-1]["next"]])
            assert chain[-1]["prev"] == chain[-2]["token"]

        times = [link["timestamp"] for link in chain]
        assert len(chain) == 3
        assert times == sorted(times)


def test_the_files_that_the_tables_name_are_there(nuscenes: Path) -> None:
    for name in ("sample_data", "lidarseg", "map"):
        for row in table(nuscenes, name):
            assert (nuscenes / row["filename"]).is_file()

    for row in table(nuscenes, "lidarseg"):
        labels = np.fromfile(nuscenes / row["filename"], np.uint8)
        assert len(labels) == 500  # of `street`
        assert labels.max() < len(table(nuscenes, "category"))


@pytest.mark.parametrize("name", ["robot.yaml", "site_a/truth/0000.npy"])
def test_a_robot_does_not_replace_files_that_were_not_simulated(tmp_path: Path, name: str) -> None:
    path = new_file(tmp_path / name, "mine")
    with pytest.raises(SimulationError, match="another folder"):
        simulate(tmp_path, sensor="vlp16", scans=1)
    assert path.read_text() == "mine"


def test_a_robots_scans_can_be_extended(quick: None, tmp_path: Path) -> None:
    for sequences in (1, 2, 2):
        simulate(tmp_path, sensor="vlp16", sequences=sequences, scans=1)
    assert "val: site_b" in (tmp_path / "robot.yaml").read_text()
    labels = np.load(tmp_path / "site_b/truth/0000.npy")
    assert set(labels.tolist()) <= {-1, 3, 7, 9, 21, 22, 40}
    assert f"POINTS {len(labels)}\n".encode() in (tmp_path / "site_b/clouds/0000.pcd").read_bytes()
