"""What is printed: escaped, short, and never a reason to fail; progress in at most ten lines."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.table import Table

from amvnet import progress
from amvnet.cli import console
from amvnet.progress import QUIET_SECONDS

from fixtures.commands import files
from fixtures.marks import with_full, with_quick
from fixtures.processes import PATIENCE

PROGRESS_LINE = r"segmenting: (\d+) of \d+, .*, \d+:\d\d:\d\d left"


# ---- progress without a terminal

LinesAt = Callable[[float, int], list[tuple[float, str]]]


@pytest.fixture
def lines_at(monkeypatch: pytest.MonkeyPatch) -> LinesAt:
    """Return what says which lines appear, and when, at a pace of seconds per item."""

    def run(seconds: float, total: int) -> list[tuple[float, str]]:
        now = [0.0]
        lines: list[tuple[float, str]] = []
        for module in (console, progress):
            monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
        monkeypatch.setattr(console, "report", lambda line: lines.append((now[0], line)))
        step = console.ProgressLines("segmenting")
        for done in range(total + 1):
            now[0] = seconds * done
            step(done, total)
        return lines

    return run


@pytest.mark.parametrize("seconds", [0.001, 0.1, 1, 20, 500])
@pytest.mark.parametrize("total", [1, 7, 300])
def test_a_step_has_ten_lines_at_most_and_none_at_the_beginning(
    lines_at: LinesAt, seconds: float, total: int
) -> None:
    lines = lines_at(seconds, total)
    assert len(lines) <= 10
    assert all(time >= QUIET_SECONDS for time, _ in lines)
    assert bool(lines) == (seconds * total >= QUIET_SECONDS)


def test_a_line_has_the_pace_and_the_time_left(lines_at: LinesAt) -> None:
    texts = [text for _, text in lines_at(10, 100)]
    assert texts[0] == "segmenting: 10 of 100, 10 s each, 0:15:00 left"
    done = [int(re.fullmatch(PROGRESS_LINE, text)[1]) for text in texts]  # type: ignore[index]
    assert done == list(range(10, 101, 10))
    assert "2 a second" in lines_at(0.5, 100)[0][1]
    # A few things, such as the graphs of an export, are not alike.
    assert lines_at(30, 6)[0][1] == "segmenting: 1 of 6"


# ---- what reaches the terminal


@given(st.text(max_size=50))
def test_a_printed_text_is_one_line_that_is_printable(text: str) -> None:
    line = console.printable(text)
    assert line.isprintable()
    assert text.isprintable() == (line == text)


def test_escapes_in_names_do_not_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    name = "a\x1b[2J\nb\u202e :warning: [red]"
    console.report(name)
    console.report_fault(name)
    table = Table(title=name)
    table.add_row(name)
    console.show(table)

    out, err = capsys.readouterr()
    assert "\x1b" not in out + err
    assert "\u202e" not in out + err
    assert out.startswith("a\\x1b[2J\\nb\\u202e :warning: [red]\n")
    assert err == "amvnet: a\\x1b[2J\\nb\\u202e :warning: [red]\n"


def test_long_texts_are_shortened(capsys: pytest.CaptureFixture[str]) -> None:
    console.report("x" * 3_000_000)
    console.report_lines("x\n" * 100_000)
    out = capsys.readouterr().out
    assert "(3,000,000 characters)" in out
    assert "more lines)" in out
    assert len(out) < 20_000


# ---- streams that fail


def amvnet(shell: str, **environment: str) -> tuple[int, str, str]:
    """Run a line of bash in which $AMVNET is the command; return its exit code and output."""
    done = subprocess.run(
        ["bash", "-c", shell],
        env=os.environ | {"AMVNET": f"{sys.executable} -m amvnet", **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    return done.returncode, done.stdout, done.stderr


# `submit` needs no torch, whose import takes seconds.
COMMANDS = {
    "submit": "{w}/data --predictions {w}/predictions --split val --out {out}/entry.zip",
    "predict": "{w}/lone.bin --weights {w}/w.safetensors --out {out}",
}
WRITTEN = {"submit": {"entry.zip"}, "predict": {"lone.label"}}
SINKS = ("> /dev/full", "| true", ">&-", "> /dev/full 2> /dev/full")


@pytest.mark.parametrize("sink", with_quick(SINKS, SINKS[:2]))
@pytest.mark.parametrize("command", with_full(COMMANDS, ["predict"]))
def test_work_goes_on_without_reader(command: str, sink: str, world: Path, tmp_path: Path) -> None:
    words = COMMANDS[command].format(w=world, out=tmp_path)
    code, _, error = amvnet(f"set -o pipefail; $AMVNET {command} {words} {sink}")
    assert code == 0
    assert files(tmp_path) == WRITTEN[command]
    expected = "stdout cannot be written" if sink == "> /dev/full" else ""
    assert error.count("\n") == bool(expected)
    assert expected in error


@pytest.mark.parametrize("command", ["--version", "--help", "predict --help"])
def test_what_only_speaks_does_not_fail_either(command: str) -> None:
    code, _, error = amvnet(f"$AMVNET {command} > /dev/full")
    assert code == 0
    assert error.count("\n") == 1


def test_letters_that_the_terminal_does_not_have_are_escaped() -> None:
    code, _, error = amvnet("$AMVNET münchen", PYTHONIOENCODING="ascii")
    assert code == 2
    assert "m\\xfcnchen" in error
