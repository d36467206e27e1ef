"""Simulated data sets: the same on any number of processes, resumed after a stop, readable as their benchmark's own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from amvnet.data.datasets.open import open_dataset
from amvnet.simulation import simulate, writing
from amvnet.simulation.layouts import NuScenesLayout

from fixtures.worlds import fails

pytest.importorskip("embreex")
SCENES = ("simulated-0000", "simulated-0001")


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def nuscenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulate(
        tmp_path_factory.mktemp("nuscenes"), sensor="hdl32e", sequences=2, scans=3, seed=2
    )


def table(folder: Path, name: str) -> list[dict[str, Any]]:
    return json.loads((folder / "v1.0-trainval" / f"{name}.json").read_text())


def test_two_processes_write_the_same_bytes_as_one(nuscenes: Path, tmp_path: Path) -> None:
    again = simulate(tmp_path, sensor="hdl32e", sequences=2, scans=3, seed=2, processes=2)
    assert contents(again) == contents(nuscenes)


def test_a_stopped_simulation_goes_on_to_the_same_bytes(
    nuscenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, calls = NuScenesLayout.scan, []

    def stop(self: NuScenesLayout, index: int, scan: Any) -> None:
        calls.append(index)
        if len(calls) == 5:
            raise KeyboardInterrupt
        write(self, index, scan)

    monkeypatch.setattr(NuScenesLayout, "scan", stop)
    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path, sensor="hdl32e", sequences=2, scans=3, seed=2)
    monkeypatch.undo()
    done: list[int] = []
    simulate(
        tmp_path,
        sensor="hdl32e",
        sequences=2,
        scans=3,
        seed=2,
        progress=lambda n, _: done.append(n),
    )
    assert done == [4, 5, 6]  # the first scene was whole
    assert contents(tmp_path) == contents(nuscenes)


@pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="asks Linux which processes there are"
)
def test_no_process_outlives_one_that_was_killed(tmp_path: Path) -> None:
    command = ["simulate", str(tmp_path), "--sequences", "2", "--scans", "1000", "--processes", "2"]
    parent = subprocess.Popen([sys.executable, "-m", "amvnet", *command], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(tmp_path.rglob("*.bin")) and time.monotonic() < deadline:
        time.sleep(0.1)
    children = [
        int(pid)
        for pid in Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text().split()
    ]
    assert len(children) >= 2
    parent.kill()
    parent.wait()
    while any(_runs(pid) for pid in children) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not [pid for pid in children if _runs(pid)]


def _runs(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"


def test_a_finished_simulation_is_left_as_it_is(
    nuscenes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "drive_street", lambda *_: pytest.fail("was simulated again"))
    before = contents(nuscenes)
    simulate(nuscenes, sensor="hdl32e", sequences=2, scans=3, seed=2)
    assert contents(nuscenes) == before


@pytest.mark.parametrize("other", [{"seed": 3}, {"scans": 4}, {"sensor": "hdl64e"}])
def test_a_folder_of_another_simulation_is_refused(nuscenes: Path, other: dict[str, Any]) -> None:
    fails(
        lambda: simulate(nuscenes, **({"sensor": "hdl32e", "scans": 3, "seed": 2} | other)),
        nuscenes,
        "another",
    )


def test_simulated_nuscenes_is_read_as_the_real_one(nuscenes: Path) -> None:
    dataset = open_dataset(f"nuscenes:{nuscenes}")
    assert dataset.sequences("all") == SCENES
    seen: set[int] = set()
    for record in dataset.records(SCENES):
        scan = dataset.read(record)
        assert scan.ring is not None
        assert scan.labels is not None
        elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(*scan.points[:, :2].T)))
        near = np.linalg.norm(scan.points[:, :3], axis=1) < 1
        off = np.abs(elevation - (-30.66 + scan.ring * 4 / 3))[~near]
        assert np.median(off) < 0.1
        assert off.max() < 2  # the sensor moves during its turn, which the files have corrected
        assert (scan.labels[near] == 0).all()
        assert (np.bincount(scan.ring) == 1084).all()  # a row for each shot, as nuScenes has it
        seen |= set(scan.labels.tolist())
    assert {
        4,
        11,
        13,
        14,
        15,
        16,
    } <= seen  # car, driveable surface, sidewalk, terrain, manmade, vegetation


def test_simulated_nuscenes_drives_forward_along_y(nuscenes: Path) -> None:
    """Its LiDAR looks to the right: x is right, y is forward, and poses have x forward."""
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
    assert len(set(tokens)) == len(tokens)
    assert table(nuscenes, name)
    assert all(row[key] in tokens for row in table(nuscenes, name))


@pytest.mark.parametrize(("name", "links"), [("sample", 6), ("sample_data", 6)])
def test_scans_are_linked_in_the_order_of_time(nuscenes: Path, name: str, links: int) -> None:
    rows = {row["token"]: row for row in table(nuscenes, name)}
    assert len(rows) == links
    firsts = [row for row in rows.values() if not row["prev"]]
    assert len(firsts) == len(SCENES)
    for row in firsts:
        chain = [row]
        while chain[-1]["next"]:
            chain.append(rows[chain[-1]["next"]])
            assert chain[-1]["prev"] == chain[-2]["token"]
        times = [link["timestamp"] for link in chain]
        assert len(chain) == 3
        assert times == sorted(times)


def test_the_files_that_the_tables_name_are_there(nuscenes: Path) -> None:
    for name in ("sample_data", "lidarseg", "map"):
        assert all((nuscenes / row["filename"]).is_file() for row in table(nuscenes, name))
    labels = [
        np.fromfile(nuscenes / row["filename"], np.uint8) for row in table(nuscenes, "lidarseg")
    ]
    assert all(len(one) == 32 * 1084 for one in labels)
    assert max(one.max() for one in labels) < len(table(nuscenes, "category"))
