"""Many scans: some broken, some runs interrupted and resumed, all in little memory."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import amvnet
from amvnet.cli.options import load_segmenter
from amvnet.data.datasets.files import ScanFiles
from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.engines.torch import TorchEngine
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.inference.journal import JOURNAL, UNFINISHED, Entry, Journal, read_journals
from amvnet.inference.listing import find_inputs
from amvnet.inference.pipeline import OutputOptions, Pipeline
from amvnet.inference.predict import segment_by
from amvnet.inference.request import LabellingRequest
from amvnet.inference.scan_stream import READ_AHEAD
from amvnet.inference.segmentation import Segmentation
from amvnet.inference.segmenter import Segmenter
from amvnet.scan import Scan
from amvnet.sensors.lidars import Sensor
from amvnet.weights.file import save

from fixtures.commands import fails, files, refused, run_cli, succeed
from fixtures.counted_scans import Counter, counted_scans
from fixtures.datasets import MAKERS
from fixtures.marks import with_full
from fixtures.processes import running
from fixtures.tiny import fresh_weights, make_streets, street
from fixtures.world import SCANS

WEIGHTS = "w.safetensors"


def predict(world: Path, out: Path, options: str = "") -> str:
    return f"predict {world}/scans --weights {world}/{WEIGHTS} --out {out} {options}"


def test_labelling_a_scan_imports_only_what_it_needs(world: Path, tmp_path: Path) -> None:
    code = """
import sys
from amvnet.__main__ import main
code = main()
unneeded = {"lidarstreets.drive", "lightning", "matplotlib", "onnxruntime", "scipy", "sympy"}
print(code, unneeded & set(sys.modules))
"""
    command = f"predict {world}/lone.bin --weights {world}/{WEIGHTS} --out {tmp_path}/out"
    process = subprocess.run(
        [sys.executable, "-c", code, *command.split()], capture_output=True, text=True, check=True
    )
    assert process.stdout.splitlines()[-1] == "0 set()"


@pytest.fixture(scope="module")
def whole(world: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    succeed(predict(world, out))
    return out


def check_same(a: Path, b: Path) -> None:
    assert files(a) == files(b)
    for name in files(a):
        assert (a / name).read_bytes() == (b / name).read_bytes(), name


def settings_of(world: Path) -> dict[str, object]:
    """Return what the journal of a run on the lone scans holds of its options."""
    weights = amvnet.load(str(world / WEIGHTS)).weights
    return {
        "weights": {part: weights.digest(part) for part in weights.parts},
        "method": "amvnet",
        "sensor": repr(Sensor()),
        "scores": False,
        "uncertain": False,
        "format": "label",
    }


# ---- broken scans


def test_broken_scans_are_listed_others_labelled(world: Path, whole: Path, tmp_path: Path) -> None:
    scans = shutil.copytree(world / "scans", tmp_path / "scans")
    (scans / "000003.bin").write_bytes(b"123")
    (scans / "000007.bin").write_bytes(b"")

    code, error = run_cli("predict", scans, "--weights", world / WEIGHTS, "--out", tmp_path / "out")
    assert code == 3
    first, second, summary = error.splitlines()
    assert "000003.bin" in first
    assert "000007.bin" in second
    assert f"{SCANS - 2} of {SCANS}" in summary
    assert files(tmp_path / "out") == files(whole) - {"000003.label", "000007.label"}


def test_only_broken_scans_are_one_line(world: Path, tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"123")
    (tmp_path / "b.bin").write_bytes(b"123")
    inputs = f"{tmp_path}/a.bin {tmp_path}/b.bin"
    refused(f"predict {inputs} --weights {world}/{WEIGHTS} --out {tmp_path}/out", "a.bin")
    assert not files(tmp_path / "out")


def no_segmentation(scan: Scan) -> Segmentation:
    n = len(scan)
    return Segmentation(np.zeros(n, np.uint8), np.zeros(n, bool), np.zeros((n, 1), np.float32))


OUT_OF_MEMORY = (
    MemoryError(),
    RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to ..."),
    RuntimeError("CUDA out of memory. Tried to allocate 20.00 MiB"),
    ImportError("libfoo.so: failed to map segment from shared object"),
)


@pytest.mark.parametrize("error", [InputError("3: broken"), *OUT_OF_MEMORY])
def test_a_scan_that_is_broken_or_takes_all_memory_breaks_no_other_of_its_batch(
    tmp_path: Path, error: Exception
) -> None:
    def segment(inputs: Sequence[ScanFile], scans: Sequence[Scan]) -> list[Segmentation]:
        if any(scan_input.name == "3" for scan_input in inputs):
            raise error
        return list(map(no_segmentation, scans))

    scans = counted_scans(8, Counter())
    pipeline = Pipeline(scans, segment, OutputOptions(tmp_path), batch=4)
    outcomes = list(pipeline.stream(scans, pipeline.write_or_explain))
    (line,) = [outcome for outcome in outcomes if isinstance(outcome, str)]
    broken = isinstance(error, InputError)
    assert line.startswith("3: broken" if broken else "3: expected enough memory")
    assert sum(isinstance(outcome, Entry) for outcome in outcomes) == 7


@pytest.mark.parametrize("error", OUT_OF_MEMORY)
def test_a_command_without_memory_ends_with_one_line(
    world: Path, tmp_path: Path, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(TorchEngine, "__init__", fail)
    refused(predict(world, tmp_path), "memory")
    monkeypatch.setattr(TorchEngine, "__init__", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_cli(*predict(world, tmp_path).split())


# ---- interrupted runs


# Labels as many scans as the first argument says, and waits to be killed.
WAITING_CLI = """
import sys, threading
from amvnet.cli.main import main
from amvnet.inference.journal import Journal
from amvnet.inference.pipeline import Pipeline

count = int(sys.argv.pop(1))
add, write = Journal.add, Pipeline.write
added, written = [], []

def write_some(*arguments):
    if len(written) == count:
        threading.Event().wait()
    written.append(arguments)
    return write(*arguments)

def add_and_tell(*arguments):
    add(*arguments)
    added.append(arguments)
    if len(added) == count:
        print("ready", flush=True)

Journal.add, Pipeline.write = add_and_tell, write_some
sys.exit(main())
"""


@pytest.mark.full
@pytest.mark.parametrize("kills", [1, 2])
def test_a_killed_run_goes_on_later(world: Path, whole: Path, tmp_path: Path, kills: int) -> None:
    """After SIGKILL, no scan is segmented again, and the labels are the same."""
    out = tmp_path / "out"
    command = predict(world, out, "--resume")
    times: dict[str, int] = {}
    for _ in range(kills):
        with running("-c", WAITING_CLI, 3, *command.split()) as process:
            process.kill()
        assert (out / UNFINISHED).exists()
        assert len(times_of(out)) == len(times) + 3
        assert times.items() <= times_of(out).items()
        times = times_of(out)

    assert run_cli(*command.split()) == (0, "")
    check_same(out, whole)
    assert times.items() <= times_of(out).items()


@pytest.mark.parametrize("options", with_full(["", "--overwrite", "--resume"], ["--overwrite"]))
def test_the_output_is_checked_before_the_networks_are_loaded_and_when_the_run_is_alone_in_it(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str
) -> None:
    steps: list[str] = []

    def load(*arguments: Any) -> Segmenter:
        steps.append("load")
        return load_segmenter(*arguments)

    monkeypatch.setattr("amvnet.inference.pipeline.check_outputs", lambda *_: steps.append("check"))
    monkeypatch.setattr("amvnet.cli.options.load_segmenter", load)
    succeed(predict(world, tmp_path, options))
    assert steps == ["check", "load", "check"]


def test_a_run_is_not_resumed_with_other_options(world: Path, whole: Path, tmp_path: Path) -> None:
    """Neither a finished nor an interrupted run is; the line says which option differs."""
    out = shutil.copytree(whole, tmp_path / "out")
    other = save(fresh_weights(seed=1), tmp_path / "other.safetensors")
    for options, key in (
        ("--method rv", "method"),
        ("--tau 0.1", "tau"),
        ("--height 2", "sensor"),
        ("--scores", "scores"),
        (f"--weights {other}", "weights"),
    ):
        refused(predict(world, out, f"--resume {options}"), f"other values of {key};")
    check_same(out, whole)

    (out / JOURNAL).rename(out / UNFINISHED)
    refused(predict(world, out, "--resume --method rv"), "other values of method;")

    succeed(predict(world, out, "--method rv --overwrite"))
    assert files(out) == files(whole)
    assert (out / "000000.label").read_bytes() != (whole / "000000.label").read_bytes()


def times_of(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("0*.label")}


def said_by(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    succeed(command)
    lines, _, _ = capsys.readouterr().out.partition("look at them")  # which is said once
    return "\n".join(lines.splitlines()[-2:])


def test_only_new_scans_of_a_growing_folder_are_segmented(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The labels and the uncertain share are those of a whole run."""
    scans = tmp_path / "scans"
    weights = f"--weights {world}/{WEIGHTS}"
    grow(scans, range(10))
    command = f"predict {scans} {weights} --out {tmp_path}/out --resume"
    succeed(command)
    times = times_of(tmp_path / "out")
    assert len(times) == 10

    new = grow(scans, range(10, 13))
    said = said_by(command, capsys)
    later_times = times_of(tmp_path / "out")
    assert times.items() <= later_times.items()
    assert later_times.keys() - times.keys() == new

    said_of_whole = said_by(f"predict {scans} {weights} --out {tmp_path}/whole", capsys)
    assert said.replace(f"{tmp_path}/out", "OUT") == said_of_whole.replace(
        f"{tmp_path}/whole", "OUT"
    )
    check_same(tmp_path / "out", tmp_path / "whole")


def grow(folder: Path, seeds: Iterable[int]) -> set[str]:
    """Write a scan for each seed into a folder; return the names of their labels."""
    folder.mkdir(exist_ok=True)
    for seed in seeds:
        street(seed, count=200)[0].tofile(folder / f"{seed:06d}.bin")
    return {f"{seed:06d}.label" for seed in seeds}


def test_a_finished_run_makes_only_lost_labels(world: Path, whole: Path, tmp_path: Path) -> None:
    out = shutil.copytree(whole, tmp_path / "out")
    command = predict(world, out, "--resume")
    times = times_of(out)
    succeed(command)
    assert times_of(out) == times

    (out / "000003.label").unlink()
    succeed(command)
    check_same(out, whole)
    assert {name for name, time in times_of(out).items() if time != times[name]} == {"000003.label"}


def test_a_run_repeats_scans_and_keeps_the_others(world: Path, whole: Path, tmp_path: Path) -> None:
    out = shutil.copytree(whole, tmp_path / "out")
    succeed(f"predict {world}/scans/000003.bin --weights {world}/{WEIGHTS} --out {out} --overwrite")
    times = times_of(out)
    succeed(predict(world, out, "--resume"))
    check_same(out, whole)
    changed = {name for name, time in times_of(out).items() if time != times[name]}
    assert changed <= {"000003.label"}  # its folder is another recording if it is alone


def test_a_scan_that_lacks_one_of_its_files_is_segmented_again(world: Path, tmp_path: Path) -> None:
    scan = shutil.copy(world / "scans/000003.bin", tmp_path)
    command = f"predict {scan} --weights {world}/{WEIGHTS} --scores --uncertain --resume"
    command += f" --out {tmp_path}/out"
    succeed(command)
    written = files(tmp_path / "out")
    assert len(written) == 3
    for name in written:
        (tmp_path / "out" / name).unlink()
        succeed(command)
        assert files(tmp_path / "out") == written


def test_scans_before_the_first_normalise_all(world: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    scans = shutil.copytree(world / "scans", tmp_path / "scans")
    (scans / "000000.bin").unlink()
    command = f"predict {scans} --weights {world}/{WEIGHTS} --out {out} --resume"
    succeed(command)
    shutil.copy(world / "scans/000000.bin", scans)
    succeed(command)
    check_same(out, whole)


def test_a_scan_that_was_rewritten_is_segmented_again(world: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    scans = shutil.copytree(world / "scans", tmp_path / "scans")
    command = f"predict {scans} --weights {world}/{WEIGHTS} --out {out} --resume"
    succeed(command)

    times = times_of(out)
    shutil.copy(scans / "000005.bin", scans / "000008.bin")
    succeed(command)
    assert {name for name, time in times_of(out).items() if time != times[name]} == {"000008.label"}
    assert (out / "000008.label").read_bytes() == (out / "000005.label").read_bytes()


def test_a_broken_scan_is_tried_again(world: Path, whole: Path, tmp_path: Path) -> None:
    """A folder grows while a scan is still being copied."""
    scans = shutil.copytree(world / "scans", tmp_path / "scans")
    (scans / "000008.bin").write_bytes(b"123")
    command = f"predict {scans} --weights {world}/{WEIGHTS} --out {tmp_path}/out --resume"
    assert run_cli(*command.split())[0] == 3
    shutil.copy(world / "scans/000008.bin", scans)
    succeed(command)
    check_same(tmp_path / "out", whole)


def test_a_run_is_not_resumed_with_a_scan_of_the_same_name_from_elsewhere(
    world: Path, tmp_path: Path
) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        shutil.copy(world / f"scans/00000{'ab'.index(folder)}.bin", tmp_path / folder / "x.bin")
    options = f"--weights {world}/{WEIGHTS} --out"
    succeed(f"predict {tmp_path}/a/x.bin {options} {tmp_path}/out")
    before = (tmp_path / "out/x.label").stat().st_mtime_ns
    command = f"predict {tmp_path}/b/x.bin {options} {tmp_path}/out --resume"
    refused(command, f"{tmp_path}/b/x.bin", f"those of {tmp_path.resolve()}/a/x.bin")

    # The scan itself may move. A journal of an earlier version does not know the place.
    (tmp_path / "a").rename(tmp_path / "moved")
    succeed(f"predict {tmp_path}/moved/x.bin {options} {tmp_path}/out --resume")
    assert (tmp_path / "out/x.label").stat().st_mtime_ns == before
    journal = tmp_path / "out" / JOURNAL
    settings, entry = map(json.loads, journal.read_text().splitlines())
    journal.write_text("".join(f"{json.dumps(line)}\n" for line in (settings, entry[:-1])))
    succeed(f"predict {tmp_path}/moved/x.bin {options} {tmp_path}/out --resume")
    assert (tmp_path / "out/x.label").stat().st_mtime_ns == before
    succeed(command)
    assert (tmp_path / "out/x.label").stat().st_mtime_ns != before


ENTRIES = [Entry(name, "0f", "drive", 10, 3, [1]) for name in "ab"]


def test_a_folder_mixes_runs_of_other_settings_only_if_told_so(world: Path, tmp_path: Path) -> None:
    command = f"--weights {world}/{WEIGHTS} --out {tmp_path}"
    succeed(f"predict {world}/scans/000000.bin {command}")
    succeed(f"predict {world}/scans/000001.bin {command}")
    assert read_journals(tmp_path).entries.keys() == {"000000.npz", "000001.npz"}

    other = f"predict {world}/scans/000002.bin {command}"
    before = files(tmp_path)
    refused(f"predict {world}/scans/000001.bin {command}", "000001.label", "found one")
    for option in ("--method rv", "--drive"):
        refused(f"{other} {option}", "2 scans of an earlier run")
    assert files(tmp_path) == before
    (tmp_path / JOURNAL).rename(tmp_path / UNFINISHED)
    refused(other, "2 scans of an earlier run")
    succeed(f"{other} --resume")
    assert read_journals(tmp_path).entries.keys() == {f"00000{index}.npz" for index in range(3)}
    succeed(f"predict {world}/scans/000003.bin {command} --overwrite --method rv")
    assert {f"00000{index}.label" for index in range(4)} <= files(tmp_path)


def test_the_end_counts_the_classes_of_the_label_files_and_names_commands_that_run(
    world: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("webbrowser.open", lambda url: None)
    out = tmp_path / "labels of a drive"
    arguments = [f"{world}/scans", "--weights", f"{world}/{WEIGHTS}", "--out", str(out)]
    columns = ["--columns", "x,y,z,intensity"]
    assert run_cli("predict", *arguments, *columns)[0] == 0
    first = capsys.readouterr().out
    assert run_cli("predict", *arguments, *columns, "--resume")[0] == 0  # only counts
    printed = capsys.readouterr().out

    counts: dict[str, int] = {}
    for path in out.glob("*.label"):
        ids = SEMANTICKITTI.to_train(np.fromfile(path, np.uint32))
        for name in np.asarray(SEMANTICKITTI.names)[ids]:
            counts[name] = counts.get(name, 0) + 1
    rows = re.findall(r"^ ([\w-]+) +│ +([\d,]+) │ +([\d.]+)", printed, re.M)
    assert {name: int(points.replace(",", "")) for name, points, _ in rows} == counts
    assert sum(float(share) for *_, share in rows) == pytest.approx(100, abs=1)

    view = re.search(r"^look at them: amvnet (.*)$", first, re.M)
    train = re.search(r"^train on your labels.*: amvnet (train .*)$", first, re.M)
    assert view is not None
    assert train is not None
    assert run_cli(*shlex.split(view[1]))[0] == 0
    assert "--data YOURS.yaml" in train[1]


@pytest.mark.parametrize(
    ("text", "done"),
    [
        ('["a","0f","drive",10,3,[1],0]\n["b","0f","drive",10,3,[1],0]\n', 2),
        ('["a","0f","drive",10,3,[1],0]\n["b","0f","drive",10,3,[1],0]', 1),
        ('["a","0f","drive",10,3,[1],0]\n["b","0f', 1),
        ('["a","0f","drive",10,3,[1],0]\n\x00\n["b","0f","drive",10,3,[1],0]\n{}\n', 2),
        ('["a","0f","drive",10,3,[1],0]\n["b","0f","drive","10",3,[1],0]\n"b"\n', 1),
        ('["a","0f","drive",10,3,[1],0]\n["b","0f","drive",10,3,["1"],0]\n', 1),
        ('["a","0f","drive",10,3,[1],0]\n' + "[" * 100_000 + "\n", 1),
    ],
)
def test_a_journal_reads_what_was_written_to_the_end(tmp_path: Path, text: str, done: int) -> None:
    """A scan whose line was not written to the end is not done."""
    with Journal(tmp_path, {"x": 1}) as journal, journal.path.open("a") as file:
        file.write(text)

    read = read_journals(tmp_path).entries
    assert list(read.values()) == ENTRIES[:done]
    with Journal(tmp_path, {"x": 1}, read.values()) as journal:
        lines = journal.path.read_text().splitlines()
    assert json.loads(lines[0]) == {"x": 1}
    assert [Entry(*json.loads(line)) for line in lines[1:]] == ENTRIES[:done]


def test_a_killed_run_leaves_no_journal_of_the_run_before(tmp_path: Path) -> None:
    """Its labels may have been replaced since."""
    with Journal(tmp_path, {"x": 1}) as journal:
        journal.add(ENTRIES[0])
        journal.close()
    with Journal(tmp_path, {"x": 2}) as journal:  # is not closed
        journal.add(ENTRIES[1])
    run = read_journals(tmp_path)
    assert run.settings == [{"x": 2}]
    assert list(run.entries.values()) == ENTRIES[1:2]


def test_the_journal_is_at_most_as_late_as_the_writing(tmp_path: Path) -> None:
    """Scans that are written are in the journal when the next but one is segmented."""
    lines: list[int] = []
    counter = Counter()
    scans = counted_scans(8, counter)

    def segment(inputs: Sequence[ScanFile], loaded: Sequence[Scan]) -> list[Segmentation]:
        if lines:
            counter.wait_for(scans[len(lines) - 1].name)
        lines.append(len((tmp_path / UNFINISHED).read_text().splitlines()) - 1)
        return list(map(no_segmentation, loaded))

    Pipeline(scans, segment, OutputOptions(tmp_path)).run({})
    assert all(line >= scan - 2 for scan, line in enumerate(lines))


HOLD = """
import sys
from pathlib import Path
from amvnet.files import alone_in

with alone_in(Path(sys.argv[1])):
    print("ready", flush=True)
    sys.stdin.read()
"""


def test_a_folder_belongs_to_one_run_at_a_time(world: Path, tmp_path: Path) -> None:
    """A second run says so and touches nothing; after the first is killed, it may begin."""
    pytest.importorskip("fcntl")
    with running("-c", HOLD, tmp_path) as first:
        before = files(tmp_path)
        refused(predict(world, tmp_path), "another run")
        assert files(tmp_path) == before
        first.kill()

    succeed(predict(world, tmp_path))
    assert len(files(tmp_path)) == SCANS


def test_a_run_replaces_no_labels_of_a_run_that_ended_while_it_loaded_its_networks(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = load_segmenter

    def load_slowly(*arguments: Any) -> Segmenter:
        monkeypatch.undo()
        succeed(predict(world, tmp_path, "--method rv"))
        return load(*arguments)

    monkeypatch.setattr("amvnet.cli.options.load_segmenter", load_slowly)
    refused(predict(world, tmp_path), "expected no file")
    (settings,) = read_journals(tmp_path).settings
    assert settings["method"] == "rv"


def test_what_is_left_half_written_is_taken_away(world: Path, whole: Path, tmp_path: Path) -> None:
    (tmp_path / ".notes.part").write_text("a user's own file")
    with atomic_write(tmp_path / "000000.label") as part:
        part.write_bytes(b"complete")
    part.write_bytes(b"half")  # under the name that a file has until it is whole
    with Journal(tmp_path, settings_of(world)) as journal:
        journal.add(Entry("000000.npz", "", "", 1, 0, []))

    succeed(predict(world, tmp_path, "--overwrite"))
    assert files(tmp_path) == files(whole) | {".notes.part"}


# ---- several scans at once


@pytest.mark.parametrize("at_once", with_full([1, 3], [3]))
def test_few_scans_are_in_memory_at_a_time(world: Path, tmp_path: Path, at_once: int) -> None:
    """Count the scans that are read and not written yet."""
    counter = Counter()
    scans = counted_scans(20, counter, seconds_to_write=0.02)  # slower than the reading
    pipeline = Pipeline(
        scans,
        segment_by(amvnet.load(str(world / WEIGHTS))),
        OutputOptions(tmp_path),
        at_once=at_once,
    )
    outcomes = pipeline.stream(scans, pipeline.write_or_explain)
    done = [entry.scan for entry in outcomes if isinstance(entry, Entry)]
    assert done == [f"{index}.npz" for index in range(20)]
    assert counter.most <= 2 * READ_AHEAD + 2 * at_once
    assert not counter.in_memory


@pytest.mark.parametrize("at_once", with_full([2, 5], [5]))
def test_scans_side_by_side_get_the_labels_they_get_one_by_one(
    world: Path, whole: Path, tmp_path: Path, at_once: int
) -> None:
    threads = torch.get_num_threads()
    succeed(predict(world, tmp_path, f"--at-once {at_once}"))
    check_same(tmp_path, whole)
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize(("options", "expected"), [("", 2), ("--at-once 3", 3), ("--batch 2", 2)])
def test_predict_segments_as_many_scans_at_a_time_as_asked_or_as_there_are_threads(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str, expected: int
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    seen = []

    def note(self: Pipeline, *arguments: object) -> tuple[list[Entry], list[str]]:
        seen.append(self.at_once)
        return [], []

    monkeypatch.setattr(Pipeline, "run", note)
    succeed(predict(world, tmp_path, options))
    assert seen == [expected]


# ---- scans that vanish, or cannot be read any more, after they were listed


@pytest.mark.parametrize("number", [errno.EACCES, errno.ESTALE, errno.EIO, errno.ENOENT])
@pytest.mark.parametrize("layout", ["", *MAKERS])
def test_a_scan_that_the_system_refuses_is_a_broken_one(
    layout: str, number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if layout:
        MAKERS[layout](tmp_path)
    else:
        street(0)[0].tofile(tmp_path / "a.bin")
    scan, *_ = find_inputs([f"{layout}:{tmp_path}" if layout else str(tmp_path)]).scans()[0]

    def refuse(path: Path, *arguments: object, **options: object) -> None:
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(np, "fromfile", refuse)
    fails(scan.load, scan.path, os.strerror(number), "; check it")


def test_that_the_process_has_too_many_files_open_is_no_fault_of_a_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    street(0)[0].tofile(tmp_path / "a.bin")
    (scan,), _ = find_inputs([str(tmp_path)]).scans()

    def refuse(*arguments: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(np, "fromfile", refuse)
    with pytest.raises(OSError, match="Too many open files"):
        scan.load()


@pytest.mark.parametrize("spec", ["{root}", "semantickitti:{root}"])
def test_scans_that_vanish_during_a_run_are_listed_and_the_others_are_done(
    spec: str, world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "data"
    folder = root
    if "kitti" in spec:
        make_streets(root, ("08",), scans=4)
        folder = root / "sequences/08/velodyne"
    else:
        root.mkdir()
        for index in range(4):
            street(index)[0].tofile(root / f"{index:06d}.bin")
    run = Pipeline.run

    def vanish_and_run(pipeline: Pipeline, *arguments: Any) -> Any:
        (folder / "000000.bin").unlink()  # the first is also measured
        (folder / "000002.bin").unlink()
        return run(pipeline, *arguments)

    monkeypatch.setattr(Pipeline, "run", vanish_and_run)
    command = f"predict {spec.format(root=root)} --weights {world}/{WEIGHTS} --out {tmp_path}/out"
    code, error = run_cli(*command.split())
    assert code == 3
    *faults, last = error.splitlines()
    assert "2 of 4 scans are labelled, 2 cannot be used" in last
    for name, fault in zip(("000000", "000002"), faults, strict=True):
        assert f"{folder / name}.bin: expected" in fault
    assert sorted(path.stem for path in (tmp_path / "out").rglob("*.label")) == ["000001", "000003"]


def test_a_scan_that_vanishes_after_it_was_read_has_its_labels(world: Path, tmp_path: Path) -> None:
    make_streets(tmp_path / "data", ("08",), scans=1)
    (scan,), _ = find_inputs([str(tmp_path / "data")]).scans()
    loaded = scan.load()
    ids = np.ones(len(loaded), np.uint8)
    scan.path.unlink()
    path = scan.dataset.write_labels(scan, tmp_path / "out", loaded, ids)
    assert np.fromfile(path, np.uint32).shape == ids.shape


def test_a_bag_in_a_folder_is_labelled_again_if_one_of_its_files_changed(tmp_path: Path) -> None:
    bag = tmp_path / "drive"
    bag.mkdir()
    scan = ScanFile(
        "drive/000000",
        Recording("drive"),
        bag,
        prediction="drive/000000.label",
        dataset=ScanFiles([]),
    )
    origins = []
    for content in (b"1", b"22"):
        (bag / "drive.mcap").write_bytes(content)
        os.utime(bag, (0, 0))  # the folder says nothing of what is in its files
        origins.append(Pipeline([scan], lambda *_: [], OutputOptions(tmp_path / "out"))._origins)
    assert origins[0] != origins[1]


def test_scans_are_labelled_again_if_the_description_reads_them_otherwise(tmp_path: Path) -> None:
    (tmp_path / "scans").mkdir()
    for number in range(2):
        street(number)[0].tofile(tmp_path / f"scans/{number}.bin")
    output = OutputOptions(tmp_path / "out")
    request = LabellingRequest(fresh_weights())
    digests: list[object] = []
    origins: list[object] = []
    for says in (
        "",
        "sensor: {height: 1.0}",
        "sensor: {height: 2.0}",
        "sensor: vlp16",
        "columns: [x, y, z, intensity]",
    ):
        path = tmp_path / "own.yaml"
        path.write_text(f"scans: scans/*.bin\nclasses: {{road: 1}}\n{says}\n")
        scans, _ = find_inputs([str(path)]).scans()
        digests.append(request.digest_of(scans, None))
        origins.append(tuple(Pipeline(scans, lambda *_: [], output)._origins.values()))
    assert len(set(digests)) == len(set(origins)) == 5


def test_the_disk_is_named_that_has_no_space(tmp_path: Path) -> None:
    """NumPy says only how many bytes were written."""
    with pytest.raises(OSError, match="1024 written") as caught, atomic_write(tmp_path / "a"):
        raise OSError("2067 requested and 1024 written")
    assert caught.value.filename == str(tmp_path / "a")
