"""The process that reads files is replaced if it ends, and ends with the one that needs it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from amvnet import read as read_scan
from amvnet.data.formats import reader_process
from amvnet.data.formats.find import list_scans

from fixtures.commands import fails, not_none
from fixtures.scan_writers import some_points, write_bag2, write_las
from fixtures.waiting import wait_for_end

CLOUDS = [some_points(60, seed) for seed in range(6)]


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag2(tmp_path / "drive", {"/lidar": CLOUDS}, StoragePlugin.MCAP)


def process_id() -> int:
    return not_none(reader_process._process)._popen.pid


def test_one_process_serves_all_files_and_threads(bag: Path, tmp_path: Path) -> None:
    read_scan(write_las(tmp_path / "a.las", some_points()))
    first = process_id()
    scans = list(list_scans(bag))
    with ThreadPoolExecutor(8) as threads:
        for _ in range(3):
            clouds = list(threads.map(lambda scan: scan.read(), scans))
            for cloud, points in zip(clouds, CLOUDS, strict=True):
                np.testing.assert_array_equal(cloud.to_scan().points, points)
    assert process_id() == first


def test_relative_paths_are_this_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        write_las(folder / "scan.las", some_points(40 + len(list(tmp_path.iterdir()))))
        monkeypatch.chdir(folder)
        assert len(read_scan("scan.las")) == 40 + len(list(tmp_path.iterdir()))


@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGKILL, marks=pytest.mark.full), signal.SIGXCPU]
)
def test_a_file_that_ends_its_process_spares_the_next(bag: Path, number: signal.Signals) -> None:
    scans = list(list_scans(bag))
    scans[0].read()
    os.kill(process_id(), signal.SIGSTOP)
    with ThreadPoolExecutor(1) as threads:
        reading = threads.submit(scans[1].read)
        os.kill(process_id(), number)
        os.kill(process_id(), signal.SIGCONT)
        fails(reading.result, bag, "too long" if number == signal.SIGXCPU else "stops")

    for scan, points in zip(scans, CLOUDS, strict=True):
        np.testing.assert_array_equal(scan.read().to_scan().points, points)


def test_an_interruption_mixes_up_no_replies(bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second, *_ = list_scans(bag)

    def interrupt(text: str) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(json, "loads", interrupt)
        with pytest.raises(KeyboardInterrupt):
            first.read()
    np.testing.assert_array_equal(second.read().to_scan().points, CLOUDS[1])


@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.full)])
def test_scans_are_read_by_worker_processes_too(bag: Path, method: str) -> None:
    scans = list(list_scans(bag))
    scans[0].read()
    with get_context(method).Pool(2) as pool:
        clouds = pool.map(_read, scans)
    for cloud, points in zip(clouds, CLOUDS, strict=True):
        np.testing.assert_array_equal(cloud, points)
    np.testing.assert_array_equal(scans[1].read().to_scan().points, CLOUDS[1])


def _read(scan: object) -> np.ndarray:
    return scan.read().to_scan().points  # type: ignore[attr-defined]


@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's descriptors of processes")
@pytest.mark.parametrize("ends", ["by itself", pytest.param("by SIGKILL", marks=pytest.mark.full)])
def test_the_process_ends_with_the_one_that_started_it(tmp_path: Path, ends: str) -> None:
    path = write_las(tmp_path / "a.las", some_points())
    code = (
        "import sys\n"
        "from amvnet.data.formats import reader_process\n"
        "from amvnet.data.formats.find import read_cloud\n"
        "read_cloud(sys.argv[1])\n"
        "print(reader_process._process._popen.pid, reader_process._process._folder, flush=True)\n"
        "sys.stdin.read()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        number, folder = not_none(parent.stdout).readline().split()
        if ends == "by SIGKILL":
            parent.kill()
        else:
            not_none(parent.stdin).close()

    wait_for_end(int(number))
    if ends == "by itself":
        assert not Path(folder).exists()
