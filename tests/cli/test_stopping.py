"""Exit codes of every command, and how Ctrl-C and SIGTERM end one: soon, and with one line."""

from __future__ import annotations

import inspect
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from amvnet.cli import main as command_line
from amvnet.cli.main import COMMANDS, CONTINUED_WHEN_REPEATED
from amvnet.errors import InputError, SomeBroken
from amvnet.files import atomic_write, temporary_folder, unfinished
from amvnet.inference.journal import Entry, Journal

from fixtures.commands import STOPPED, new_file, run_cli
from fixtures.processes import PATIENCE, running, said_at_the_end
from fixtures.scan_writers import some_points, write_las
from fixtures.world import SCANS

Run = Callable[[str, Sequence[str]], None]


def raising(error: BaseException) -> Run:
    def run(command: str, arguments: Sequence[str]) -> None:
        raise error

    return run


def signalled(number: int, becomes: type[BaseException] | None) -> Run:
    """Return a command that gets a signal, and may turn the interruption into `becomes`."""

    def run(command: str, arguments: Sequence[str]) -> None:
        try:
            signal.raise_signal(number)
        except KeyboardInterrupt:
            if becomes is not None:
                raise becomes from None

    return run


ENDS: dict[str, tuple[Run, int, str]] = {
    "done": (lambda command, arguments: None, 0, ""),
    "wrong input": (raising(InputError("expected a, found b; c")), 2, "expected a, found b; c"),
    "some broken": (raising(SomeBroken("1 of 2 scans", ["a: broken"])), 3, "a: broken"),
    "full disk": (raising(OSError(28, "No space left on device", "out")), 1, "No space left"),
    "Ctrl-C": (signalled(signal.SIGINT, KeyboardInterrupt), 130, "stopped"),
    "SIGTERM": (signalled(signal.SIGTERM, KeyboardInterrupt), 143, "stopped"),
    "a library that exits": (signalled(signal.SIGTERM, SystemExit), 143, "stopped"),
    "a library that fails": (signalled(signal.SIGINT, RuntimeError), 130, "stopped"),
    "a library that returns": (signalled(signal.SIGTERM, None), 143, "stopped"),
}


# Each end of a command, and each command that a signal ends.
CASES = [("predict", end) for end in ENDS]
CASES += [(command, "SIGTERM") for command in COMMANDS if command != "predict"]


@pytest.mark.usefixtures("hears_sigint")
@pytest.mark.parametrize(("command", "end"), CASES)
def test_the_exit_code_of_commands(command: str, end: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run, code, words = ENDS[end]
    monkeypatch.setattr(command_line, "run", run)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    actual, error = run_cli(command, stops_itself=True)

    assert actual == code
    assert words in error
    assert error.count("\n") == (code != 0) + (code == 3)
    assert before == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    if code > STOPPED:
        assert ("--resume" in error) == (
            "resume" in inspect.signature(COMMANDS[command]).parameters
        )
        assert ("start it again" in error) == (command in CONTINUED_WHEN_REPEATED)


# The commands below sleep until a signal ends them. They sleep for short times, because Python
# looks at a signal only after the sleep if the signal comes just before the sleep begins.
STUBBORN = """
import sys, time
from amvnet.cli import main
from amvnet.files import atomic_write

def stay():
    try:
        while True:
            print("ready", flush=True)
            time.sleep(0.1)
    finally:
        stay()

def run(command, arguments):
    with atomic_write("{path}") as part:
        part.write_text("half")
        stay()

main.run = run
sys.argv = ["amvnet", "predict"]
sys.exit(main.main())
"""


@pytest.mark.usefixtures("hears_sigint")
def test_a_second_signal_ends_a_command_that_does_not_end(tmp_path: Path) -> None:
    """It leaves no half file, and says one line."""
    with running("-c", STUBBORN.replace("{path}", str(tmp_path / "a.txt"))) as process:
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        assert said_at_the_end(process) == (143, "amvnet: stopped; go on with --resume\n")
    assert not list(tmp_path.iterdir())


STARTING = """
import signal, sys
from importlib.abc import MetaPathFinder

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have it ignored

class Finder(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "amvnet.cli.main":
            signal.raise_signal(signal.SIGINT)

from amvnet.__main__ import main
sys.meta_path.insert(0, Finder())
sys.argv = ["amvnet", "list"]
sys.exit(main())
"""


def test_an_interrupted_start_has_no_traceback() -> None:
    """A process that a signal has ended has the exit code 130 in a shell."""
    done = subprocess.run(
        [sys.executable, "-c", STARTING], capture_output=True, text=True, timeout=PATIENCE
    )
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


WITH_SEMAPHORE = """
import sys, time
from multiprocessing import get_context
from amvnet.cli import main

def wait():
    'Wait.'
    main.lock = get_context("spawn").Lock()
    print("ready", flush=True)
    while True:
        time.sleep(0.1)

main.COMMANDS["list"] = wait
sys.argv = ["amvnet", "list"]
sys.exit(main.main())
"""


@pytest.mark.full
def test_semaphores_of_a_stopped_command_are_cleaned_up_in_silence() -> None:
    """Pools of processes have semaphores. Python's tracker of them would warn."""
    with running("-c", WITH_SEMAPHORE) as process:
        process.send_signal(signal.SIGTERM)
        assert said_at_the_end(process) == (143, "amvnet: stopped\n")


# ---- a run that goes on

WRITTEN = 3  # scans that are labelled before the signal arrives


def predict(world: Path, out: Path, *options: str) -> list[str]:
    words = ["predict", world / "scans", "--weights", world / "w.safetensors", "--out", out]
    return [*map(str, words), "--at-once", "1", *options]


def check_it_goes_on(world: Path, folder: Path) -> None:
    """Check that the run into `parts` has stopped half-way, and gives all labels if resumed."""
    parts = folder / "parts"
    assert WRITTEN <= len(list(parts.glob("*.label"))) < SCANS
    assert not list(parts.glob(".*.part*"))
    assert run_cli(*predict(world, parts, "--resume")) == (0, "")
    assert run_cli(*predict(world, folder / "whole")) == (0, "")
    for path in (folder / "whole").glob("*.label"):
        assert path.read_bytes() == (parts / path.name).read_bytes()


def test_predict_is_resumable(world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add = Journal.add
    added: list[Entry] = []

    def add_and_stop(journal: Journal, entry: Entry) -> None:
        add(journal, entry)
        added.append(entry)
        if len(added) == WRITTEN:
            signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "add", add_and_stop)
        stopped = run_cli(*predict(world, tmp_path / "parts"), stops_itself=True)
    assert stopped == (143, "amvnet: stopped; go on with --resume\n")
    check_it_goes_on(world, tmp_path)


TEMPORARY = """
import sys, time
from pathlib import Path
from amvnet import read
from amvnet.cli import main
from amvnet.files import temporary_folder

def run(command, arguments):
    read("{scan}")  # in a process of its own, which has a temporary folder
    with temporary_folder(Path("{out}")) as folder:
        (folder / "graph").write_text("half")
        print("ready", flush=True)
        while True:
            time.sleep(0.1)

main.run = run
sys.argv = ["amvnet", "export"]
sys.exit(main.main())
"""


@pytest.mark.full
def test_a_stopped_command_leaves_no_temporary_folder(tmp_path: Path) -> None:
    write_las(tmp_path / "a.laz", some_points())
    (tmp_path / "temporary").mkdir()
    script = TEMPORARY.replace("{scan}", str(tmp_path / "a.laz"))
    script = script.replace("{out}", str(tmp_path / "out"))
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    with running("-c", script, environment=environment) as process:
        assert len(list((tmp_path / "temporary").iterdir())) == 1
        process.send_signal(signal.SIGTERM)
        assert said_at_the_end(process) == (143, "amvnet: stopped\n")
    assert not list((tmp_path / "temporary").iterdir())
    assert not list((tmp_path / "out").iterdir())


def test_finished_files_are_not_listed_as_unfinished(tmp_path: Path) -> None:
    before = set(unfinished)
    with atomic_write(tmp_path / "a.txt") as part, temporary_folder() as folder:
        assert unfinished - before == {part, folder}
    assert unfinished == before


# ---- pytest itself

LONG = """
from pathlib import Path
import time

from amvnet.cli import main
from fixtures.commands import run_cli

def wait(command, arguments):
    print("\\nready", flush=True)
    while True:
        time.sleep(0.1)

def test_a_long_command(monkeypatch):
    monkeypatch.setattr(main, "run", wait)
    run_cli("predict")

def test_what_follows():
    Path("{started}").touch()
"""


def test_a_signal_ends_pytest_also_while_a_command_runs_in_it(tmp_path: Path) -> None:
    path = new_file(tmp_path / "test_long.py", LONG.replace("{started}", str(tmp_path / "started")))
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    words = ("-m", "pytest", "-s", "-p", "no:cacheprovider", path)
    with running(*words, environment=environment) as process:
        process.send_signal(signal.SIGTERM)
        code, _ = said_at_the_end(process)
    assert code != 0
    assert not (tmp_path / "started").exists()
