"""Exit codes of every command, and how Ctrl-C and SIGTERM end one: soon, and with one line."""

from __future__ import annotations

import inspect
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from amvnet.cli import main as command_line
from amvnet.cli.main import COMMANDS, CONTINUED_WHEN_REPEATED
from amvnet.errors import InputError, SomeBroken
from amvnet.files import atomic_write, temporary_folder, unfinished
from amvnet.weights.file import save

from fixtures.commands import run_cli
from fixtures.scan_writers import some_points, write_las
from fixtures.tiny import fresh_weights, street

SOON = 5  # seconds on a busy machine; a second on an idle one
SCANS = 24  # more than are labelled before a signal arrives

Run = Callable[[str, Sequence[str]], None]


def raising(error: BaseException) -> Run:
    """Return a command that fails."""

    def run(command: str, arguments: Sequence[str]) -> None:
        raise error

    return run


def signalled(number: int, becomes: type[BaseException] | None) -> Run:
    """Return a command that gets a signal, and may turn the interruption into `becomes`."""

    def run(command: str, arguments: Sequence[str]) -> None:
        try:
            os.kill(os.getpid(), number)
            time.sleep(60)
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


@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_the_exit_code_of_every_command(
    command: str, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, code, words = ENDS[end]
    monkeypatch.setattr(command_line, "run", run)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    actual, error = run_cli(command)

    assert actual == code
    assert words in error
    assert error.count("\n") == (code != 0) + (code == 3)
    assert before == [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    if code > 128:
        assert ("--resume" in error) == (
            "resume" in inspect.signature(COMMANDS[command]).parameters
        )
        assert ("start it again" in error) == (command in CONTINUED_WHEN_REPEATED)


def test_the_page_has_all_exit_codes() -> None:
    page = (Path(__file__).parents[2] / "docs/command_line.md").read_text()
    codes = re.findall(r"^\| (\d+) \|", page, re.M)
    assert {int(code) for code in codes} == {code for _, code, _ in ENDS.values()}


# The commands below sleep for short times, because Python looks at a signal only after the sleep if
# the signal comes just before the sleep begins.
STUBBORN = """
import sys, time
from amvnet.cli import main
from amvnet.files import atomic_write

def run(command, arguments):
    with atomic_write("{path}") as part:
        part.write_text("half")
        print("ready", flush=True)
        while True:
            try:
                time.sleep(0.1)
            except KeyboardInterrupt:
                pass

main.run = run
sys.argv = ["amvnet", "predict"]
sys.exit(main.main())
"""


@contextmanager
def running(script: str, environment: Mapping[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a script in a process of its own, and yield the process once it prints `ready`."""
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_does_not_end_is_ended(number: int, tmp_path: Path) -> None:
    """It leaves no half file, and says one line."""
    script = STUBBORN.replace("{path}", str(tmp_path / "a.txt"))
    with running(script, os.environ) as process:
        start = time.monotonic()
        process.send_signal(number)
        assert process.wait(60) == 128 + number
        assert time.monotonic() - start < SOON
        assert process.stderr is not None
        assert process.stderr.read() == "amvnet: stopped; go on with --resume\n"
    assert not list(tmp_path.iterdir())


IMPORTING = """
import os, signal, sys
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from amvnet.cli import main

class Finder(MetaPathFinder, Loader):
    def find_spec(self, name, path=None, target=None):
        return ModuleSpec(name, self) if name == "stubborn" else None
    def exec_module(self, module):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except BaseException:
            os.abort()

sys.meta_path.insert(0, Finder())
main.run = lambda command, arguments: __import__("stubborn")
sys.argv = ["amvnet", "info"]
sys.exit(main.main())
"""


def test_a_signal_during_an_import_raises_nothing_in_it() -> None:
    """Libraries in C++ abort at an exception then."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORTING], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (143, "amvnet: stopped\n")


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
        [sys.executable, "-c", STARTING], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


WITH_SEMAPHORE = """
import sys, time
from multiprocessing import get_context
from amvnet.cli import main

def wait():
    'Wait.'
    lock = get_context("spawn").Lock()
    print("ready", flush=True)
    while True:
        try:
            time.sleep(0.1)
        except KeyboardInterrupt:
            pass

main.COMMANDS["list"] = wait
sys.argv = ["amvnet", "list"]
sys.exit(main.main())
"""


@pytest.mark.parametrize("given", ["", "error::SyntaxWarning"])
def test_semaphores_of_a_stopped_command_are_cleaned_up_in_silence(given: str) -> None:
    """Pools of processes have semaphores. Python's tracker of them would warn."""
    with subprocess.Popen(
        [sys.executable, "-c", WITH_SEMAPHORE],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONWARNINGS": given},
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.stderr.read() == "amvnet: stopped\n"


IN_DESTRUCTOR = """
import os, signal, sys, time
from amvnet.cli import main

class Signals:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)

def run(command, arguments):
    Signals()
    time.sleep(60)

main.run = run
sys.argv = ["amvnet", "info"]
sys.exit(main.main())
"""


def test_a_signal_during_a_destructor_ends_the_command_with_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-c", IN_DESTRUCTOR], capture_output=True, text=True, timeout=30
    )
    assert (done.returncode, done.stderr) == (143, "amvnet: stopped\n")


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights, scans that take seconds, and the labels of `predict`."""
    root = tmp_path_factory.mktemp("world")
    save(fresh_weights(), root / "w.safetensors")
    (root / "scans").mkdir()
    for index in range(SCANS):
        street(index, 20_000)[0].tofile(root / f"scans/{index:02d}.bin")
    arguments = ["predict", root / "scans", "--weights", root / "w.safetensors"]
    assert run_cli(*arguments, "--out", root / "whole") == (0, "")
    return root


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_predict_goes_on(number: int, world: Path, tmp_path: Path) -> None:
    command = ["predict", world / "scans", "--weights", world / "w.safetensors", "--out"]
    words = [sys.executable, "-m", "amvnet", *map(str, command), str(tmp_path / "parts")]
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as process:
        while not list(tmp_path.glob("parts/[!.]*.label")) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(number)
        assert process.wait(60) == 128 + number
        assert process.stderr is not None
        assert process.stderr.read() == "amvnet: stopped; go on with --resume\n"
    assert 0 < len(list(tmp_path.glob("parts/*.label"))) < SCANS
    assert not list(tmp_path.glob("parts/.*.part*"))

    assert run_cli(*command, tmp_path / "parts", "--resume") == (0, "")
    for path in (world / "whole").glob("*.label"):
        assert path.read_bytes() == (tmp_path / "parts" / path.name).read_bytes()


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


def test_a_stopped_command_leaves_no_temporary_folder(tmp_path: Path) -> None:
    write_las(tmp_path / "a.laz", some_points())
    (tmp_path / "temporary").mkdir()
    script = TEMPORARY.replace("{scan}", str(tmp_path / "a.laz"))
    script = script.replace("{out}", str(tmp_path / "out"))
    environment = os.environ | {"TMPDIR": str(tmp_path / "temporary")}
    with running(script, environment) as process:
        assert len(list((tmp_path / "temporary").iterdir())) == 1
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 143
    assert not list((tmp_path / "temporary").iterdir())
    assert not list((tmp_path / "out").iterdir())


def test_finished_files_are_not_listed_as_unfinished(tmp_path: Path) -> None:
    before = set(unfinished)
    with atomic_write(tmp_path / "a.txt") as part, temporary_folder() as folder:
        assert unfinished - before == {part, folder}
    assert unfinished == before
