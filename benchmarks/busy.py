"""Measure a call of the segmenter and the commands while other programs use the processors.

    python benchmarks/busy.py [--scan FILE] [--calls N] [--scans N] [--busy 0,1,2]
        [--settings "passive,one thread"] [--commands predict,evaluate]

The last table has the time of each command in the default setting, next to its time with passive
waiting.

Each setting runs in its own process. Each busy process keeps one processor busy with an empty loop.
Run this on a machine that has nothing else to do.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from rich.console import Console
from rich.table import Table

from amvnet.runtime.threads import WAITING
from lidarstreets import simulate

WARM_UP = 2  # number of calls that do not count
WEIGHTS = "sim-hdl64e"

# The environment of each setting. The command line makes its default passive.
SETTINGS: dict[str, dict[str, str]] = {
    "default": {},
    "spin 1000 times": {"GOMP_SPINCOUNT": "1000"},
    "passive": {"OMP_WAIT_POLICY": "passive"},
    "one thread": {"OMP_NUM_THREADS": "1"},
}

# The commands that compute, with places for labelled scans, their files, and an output folder.
COMMANDS = {
    "predict": "predict {files} --weights {weights} --out {out} --scores",
    "evaluate": "evaluate semantickitti:{data} --split all --weights {weights}",
    "rank": "rank semantickitti:{data} --split all --weights {weights} --out {out}/rank.json",
    "analyze": "analyze semantickitti:{data} --split all --weights {weights} --out {out}",
    "view": "view {files} --weights {weights} --html {out}/view.html",
    "export": "export --weights {weights} --out {out}",
    "train": "train simulated-compact --data semantickitti:{data} --train-sequences 00"
    " --val-sequences 01 --stage rv --training.rv.epochs 1 --out {out}",
}

# Prints the seconds of each call.
CALLS = """
import json, sys, time
import amvnet
from amvnet import read as read_scan

scan, weights, count = sys.argv[1:]
segmenter = amvnet.load(weights)
points = read_scan(scan)
seconds = []
for _ in range(int(count)):
    start = time.perf_counter()
    segmenter(points)
    seconds.append(time.perf_counter() - start)
print(json.dumps(seconds))
"""


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Keep `count` processors busy within the block."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def environment(setting: str) -> dict[str, str]:
    """Return this process's environment, in which only the setting concerns threads."""
    names = {*WAITING, "OMP_NUM_THREADS"}
    inherited = {key: value for key, value in os.environ.items() if key not in names}
    return {**inherited, **SETTINGS[setting]}


def time_calls(scan: Path, setting: str, calls: int) -> float:
    """Return the median seconds of a call of the segmenter."""
    command = [sys.executable, "-c", CALLS, str(scan), WEIGHTS, str(WARM_UP + calls)]
    process = subprocess.run(
        command, env=environment(setting), stdout=subprocess.PIPE, text=True, check=True
    )
    return statistics.median(json.loads(process.stdout)[WARM_UP:])


def time_predict(scan: Path, setting: str, scans: int) -> float:
    """Return the seconds of `amvnet predict` per scan, with its start."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "scans"
        folder.mkdir()
        for index in range(scans):
            shutil.copy(scan, folder / f"{index:06d}{scan.suffix}")

        command = [sys.executable, "-m", "amvnet", "predict", str(folder)]
        command += ["--weights", WEIGHTS, "--out", f"{temporary}/labels"]
        start = time.perf_counter()
        subprocess.run(command, env=environment(setting), stdout=subprocess.DEVNULL, check=True)
        return (time.perf_counter() - start) / scans


def time_command(command: str, data: Path, setting: str) -> float:
    """Return the seconds of a command, with its start."""
    with TemporaryDirectory() as out:
        text = COMMANDS[command].format(
            data=data, files=data / "sequences/00/velodyne", weights=WEIGHTS, out=out
        )
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, "-m", "amvnet", *text.split()],
            env=environment(setting),
            stdout=subprocess.DEVNULL,
            check=True,
        )
        return time.perf_counter() - start


def compare_commands(commands: list[str], scans: int, busy: list[int]) -> Table:
    """Return a table of the seconds of each command, by default and with passive waiting."""
    title = "seconds by default / with OMP_WAIT_POLICY=passive, and their ratio"
    table = Table("command", *[f"{count} busy" for count in busy], title=title)
    with TemporaryDirectory() as temporary:
        data = simulate(Path(temporary), sequences=2, scans=scans)
        for command in commands:
            cells = []
            for count in busy:
                with busy_processes(count):
                    plain = time_command(command, data, "default")
                    passive = time_command(command, data, "passive")
                cells.append(f"{plain:.1f} / {passive:.1f}, {plain / passive:.2f}")
            table.add_row(command, *cells)
    return table


def measure(
    scan: Path, settings: list[str], calls: int, scans: int, busy: list[int]
) -> list[Table]:
    """Return the tables of the calls and of `predict`, seconds."""
    tables = []
    for title in ("a call of the segmenter, s", "amvnet predict, s per scan with its start"):
        table = Table("threads", *[f"{count} busy" for count in busy], title=title)
        tables.append(table)

    for setting in settings:
        call_cells = []
        predict_cells = []
        for count in busy:
            with busy_processes(count):
                call_cells.append(f"{time_calls(scan, setting, calls):.2f}")
                predict_cells.append(f"{time_predict(scan, setting, scans):.2f}")
        tables[0].add_row(setting, *call_cells)
        tables[1].add_row(setting, *predict_cells)
    return tables


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scan", type=Path, help="default: a simulated one")
    parser.add_argument("--calls", type=int, default=7)
    parser.add_argument("--scans", type=int, default=12, help="that predict segments")
    parser.add_argument("--busy", default="0,1,2", help="numbers of busy processes")
    parser.add_argument("--settings", default=",".join(SETTINGS), help="which of them")
    parser.add_argument("--commands", default=",".join(COMMANDS), help="which of them")
    options = parser.parse_args()

    with TemporaryDirectory() as temporary:
        scan = options.scan
        if scan is None:
            simulate(Path(temporary), scans=1)
            scan = Path(temporary) / "sequences/00/velodyne/000000.bin"
        busy = [int(count) for count in options.busy.split(",")]
        settings = [setting for setting in options.settings.split(",") if setting]
        tables = measure(scan, settings, options.calls, options.scans, busy=busy)
    commands = [command for command in options.commands.split(",") if command]
    if commands:
        tables.append(compare_commands(commands, options.scans, busy))

    console = Console()
    for table in tables:
        console.print(table)


if __name__ == "__main__":
    main()
