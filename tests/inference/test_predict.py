"""Many scans: some broken, interrupted and gone on with, in little memory."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.inference.inputs import InputScan, adapter_for
from amvnet.inference.journal import Journal
from amvnet.inference.pipeline import AHEAD, ExecutionOptions, OutputOptions, Pipeline
from amvnet.inference.predict import NetworkSegmentation
from amvnet.inference.segmenter import Segmentation, Segmenter
from amvnet.scan import Scan
from amvnet.weights.file import save

from fixtures.counted_scans import Counter, counted_scans
from fixtures.worlds import files, fresh_weights, make_streets, run_cli, street

WEIGHTS = "w.safetensors"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights, and a folder of twelve lone scans from sensors at different heights."""
    root = tmp_path_factory.mktemp("world")
    save(fresh_weights(), root / WEIGHTS)
    (root / "scans").mkdir()
    for place in range(12):
        points, _ = street(place)
        points[:, 2] += 0.1 * place
        points.tofile(root / f"scans/{place:06d}.bin")
    make_streets(root / "data")
    return root


@pytest.fixture(scope="module")
def whole(world: Path) -> Path:
    """What an undisturbed run writes."""
    assert run_cli(
        "predict", world / "scans", "--weights", world / WEIGHTS, "--out", world / "whole"
    ) == (0, "")
    return world / "whole"


def same(a: Path, b: Path) -> None:
    assert files(a) == files(b)
    for name in files(a):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name


def test_broken_scans_are_listed_and_the_others_are_segmented(
    world: Path, whole: Path, tmp_path: Path
) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    for path in (world / "scans").iterdir():
        (scans / path.name).write_bytes(path.read_bytes())
    (scans / "000003.bin").write_bytes(b"123")
    (scans / "000007.bin").write_bytes(b"")
    code, error = run_cli("predict", scans, "--weights", world / WEIGHTS, "--out", tmp_path / "out")
    assert code == 3
    *faults, last = error.splitlines()
    assert [
        name in line for name, line in zip(("000003.bin", "000007.bin"), faults, strict=True)
    ] == [True, True]
    assert "10 of 12" in last
    assert files(tmp_path / "out") == files(whole) - {"000003.label", "000007.label"}


def test_only_broken_scans_are_one_line(world: Path, tmp_path: Path) -> None:
    for name in ("a.bin", "b.bin"):
        (tmp_path / name).write_bytes(b"123")
    inputs = (tmp_path / "a.bin", tmp_path / "b.bin")
    code, error = run_cli(
        "predict", *inputs, "--weights", world / WEIGHTS, "--out", tmp_path / "out"
    )
    assert (code, error.count("\n")) == (2, 1)
    assert "a.bin" in error
    assert not files(tmp_path / "out")


@pytest.mark.parametrize("kills", [1, 2])
def test_a_killed_run_goes_on_where_it_stopped(
    world: Path, whole: Path, tmp_path: Path, kills: int
) -> None:
    """SIGKILL in the midst of it, once or twice; what is done is not done again, and the end is the same."""
    out = tmp_path / "out"
    slow = """
import sys, time
from amvnet.cli.main import main
from amvnet.inference.pipeline import Pipeline

write = Pipeline._write
Pipeline._write = lambda *arguments: (time.sleep(0.1), write(*arguments))
sys.exit(main())
"""
    arguments = [
        "predict",
        str(world / "scans"),
        "--weights",
        str(world / WEIGHTS),
        "--out",
        str(out),
        "--resume",
    ]
    times: dict[str, int] = {}
    for kill in range(1, kills + 1):
        process = subprocess.Popen(
            [sys.executable, "-c", slow, *arguments], stdout=subprocess.DEVNULL
        )
        while len(list(out.glob("*.label"))) < 3 * kill and process.poll() is None:
            time.sleep(0.005)
        process.kill()
        process.wait()
        assert list(out.glob(".unfinished-*")), "the run was over before it was killed"
        written = {path.name: path.stat().st_mtime_ns for path in out.glob("*.label")}
        kept = {name for name in times if written.get(name) == times[name]}
        assert (
            len(kept) >= len(times) - 1
        )  # the last one may have been written, and not yet written down
        times = written
    assert run_cli(*arguments) == (0, "")
    same(out, whole)
    assert (
        sum((out / name).stat().st_mtime_ns == at for name, at in times.items()) >= len(times) - 1
    )


def test_an_interrupted_run_is_not_gone_on_with_by_others(world: Path, tmp_path: Path) -> None:
    arguments = (
        "predict",
        world / "scans",
        "--weights",
        world / WEIGHTS,
        "--out",
        tmp_path,
        "--resume",
    )
    Journal(tmp_path, {**settings_of(world), "method": "rv"})
    code, error = run_cli(*arguments)
    assert (code, error.count("\n")) == (2, 1)
    assert "method" in error
    assert run_cli(*arguments[:-1]) == (0, "")  # without --resume it begins anew
    assert len(files(tmp_path)) == 12


def test_a_finished_run_is_not_taken_for_an_interrupted_one(
    world: Path, whole: Path, tmp_path: Path
) -> None:
    arguments = (
        "predict",
        world / "scans",
        "--weights",
        world / WEIGHTS,
        "--out",
        tmp_path,
        "--resume",
    )
    assert run_cli(*arguments) == (0, "")
    (tmp_path / "000005.label").write_bytes(b"other")
    assert run_cli(*arguments) == (0, "")
    same(tmp_path, whole)


@pytest.mark.parametrize("end", ['"a"\n"b"\n', '"a"\n"b"', '"a"\n"b', '"a"\n\x00\n"b"\n{}\n'])
def test_a_journal_reads_what_was_written_to_the_end(tmp_path: Path, end: str) -> None:
    """A name that was not finished is not done."""
    journal = Journal(tmp_path, {"x": 1})
    with journal.path.open("a") as file:
        file.write(end)
    assert Journal(tmp_path, {"x": 1}, resume=True).done == (
        {"a", "b"} if end.count('"b"\n') else {"a"}
    )
    kept = [
        json.loads(line) for line in (tmp_path / ".unfinished-0.jsonl").read_text().splitlines()
    ]
    assert kept[0] == {"x": 1}


def test_a_part_of_a_folder_is_labelled_as_in_the_whole(
    world: Path, whole: Path, tmp_path: Path
) -> None:
    """What is measured of a sensor comes of a folder's first scans, whichever are left to segment."""
    journal = Journal(tmp_path, settings_of(world))
    for place in range(9):
        journal.add(f"{place:06d}.npz")
    arguments = (
        "predict",
        world / "scans",
        "--weights",
        world / WEIGHTS,
        "--out",
        tmp_path,
        "--resume",
    )
    assert run_cli(*arguments) == (0, "")
    assert files(tmp_path) == {f"{place:06d}.label" for place in (9, 10, 11)}
    for name in files(tmp_path):
        assert (tmp_path / name).read_bytes() == (whole / name).read_bytes()


def settings_of(world: Path) -> dict[str, object]:
    weights = Segmenter(str(world / WEIGHTS)).weights
    parts = {part: weights.digest(part) for part in weights.parts}
    sensor = repr(adapter_for(weights).sensor)
    kept = {"scores": False, "uncertain": False, "format": "label"}
    return {"weights": parts, "method": "amvnet", "sensor": sensor, **kept}


@pytest.mark.parametrize("at_once", [1, 3])
def test_few_scans_are_in_memory_however_many_there_are(
    world: Path, tmp_path: Path, at_once: int
) -> None:
    """Counted: those that are read and not yet written."""
    counter = Counter()
    scans = counted_scans(30, counter, seconds_to_write=0.02)  # slower than the reading
    pipeline = Pipeline(
        NetworkSegmentation(Segmenter(str(world / WEIGHTS))),
        OutputOptions(tmp_path),
        SEMANTICKITTI,
        ExecutionOptions(at_once=at_once),
    )
    done = [scan.name for scan, fault in pipeline.stream(scans) if fault is None]
    assert done == [str(index) for index in range(30)]
    assert counter.most <= 2 * AHEAD + 2 * at_once
    assert not counter.held


def test_what_a_killed_run_left_half_written_is_taken_away(
    world: Path, whole: Path, tmp_path: Path
) -> None:
    (tmp_path / ".notes.part").write_text("of somebody else")
    with atomic_write(tmp_path / "000000.label") as part:
        part.write_bytes(b"whole")
    part.write_bytes(b"half")  # under the name that it has until it is whole
    arguments = ("predict", world / "scans", "--weights", world / WEIGHTS, "--out", tmp_path)
    Journal(tmp_path, settings_of(world)).add("000000.npz")
    assert run_cli(*arguments) == (0, "")
    assert files(tmp_path) == files(whole) | {".notes.part"}


@pytest.mark.parametrize("at_once", [2, 5])
def test_scans_side_by_side_get_the_labels_they_get_one_by_one(
    world: Path, whole: Path, tmp_path: Path, at_once: int
) -> None:
    arguments = (
        "predict",
        world / "scans",
        "--weights",
        world / WEIGHTS,
        "--out",
        tmp_path,
        "--at-once",
        at_once,
    )
    threads = torch.get_num_threads()
    assert run_cli(*arguments) == (0, "")
    same(tmp_path, whole)
    assert torch.get_num_threads() == threads


def test_scans_side_by_side_really_run_at_the_same_time(tmp_path: Path) -> None:
    """Each waits for the other."""
    both = threading.Barrier(2, timeout=30)

    def segment(inputs: Sequence[InputScan], scans: Sequence[Scan]) -> list[Segmentation]:
        both.wait()
        return [Segmentation(*np.zeros((3, len(scan)))) for scan in scans]

    pipeline = Pipeline(
        segment, OutputOptions(tmp_path), SEMANTICKITTI, ExecutionOptions(at_once=2)
    )
    scans = counted_scans(2, Counter())
    assert [fault for _, fault in pipeline.stream(scans)] == [None, None]


def test_a_broken_scan_of_a_batch_does_not_break_the_others(tmp_path: Path) -> None:
    def segment(inputs: Sequence[InputScan], scans: Sequence[Scan]) -> list[Segmentation]:
        if any(scan_input.name == "3" for scan_input in inputs):
            raise InputError("3: broken")
        return [Segmentation(*np.zeros((3, len(scan)))) for scan in scans]

    output = OutputOptions(tmp_path)
    pipeline = Pipeline(segment, output, SEMANTICKITTI, ExecutionOptions(batch=4))
    faults = {scan.name: fault for scan, fault in pipeline.stream(counted_scans(8, Counter()))}
    assert {name for name, fault in faults.items() if fault} == {"3"}
    assert faults["3"] == "3: broken"
