"""Simulates sequences of scans on several processes, and goes on where it was stopped."""

from __future__ import annotations

import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.simulation.drive import drive_street
from amvnet.simulation.layouts import LAYOUTS, SimulatedScan
from amvnet.simulation.lidar import require_embree
from amvnet.simulation.sensors import SENSORS, Sensor

Progress = Callable[[int, int], None]  # scans done, in all
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
DONE = (
    ".simulation"  # folder of a file for each sequence that is written: what made it, and its rows
)


@dataclass(frozen=True)
class Sequence:
    """One sequence to be written."""

    out: Path
    sensor: str
    number: int
    scans: int
    seed: int

    @property
    def made(self) -> dict[str, Any]:
        """What the bytes of the sequence depend on."""
        return {"sensor": self.sensor, "seed": self.seed, "scans": self.scans}

    @property
    def done(self) -> Path:
        """The file that says that the sequence is written."""
        return self.out / DONE / f"{self.number:04d}.json"


def simulate(
    out: Path | str,
    *,
    sensor: str = "hdl64e",
    sequences: int = 1,
    scans: int = 10,
    seed: int = 0,
    first_sequence: int = 0,
    processes: int = 1,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Write labelled scans of procedural streets; the same seed gives the same bytes on any number of processes.

    Sequences that an earlier call has written are left as they are.

    Args:
        out: folder to write to, in SemanticKITTI's layout (HDL-64E) or that of nuScenes-lidarseg (HDL-32E).
        sensor: name of a sensor in `SENSORS`.
        sequences: number of sequences; each is another street.
        scans: number of scans in each sequence.
        seed: where all randomness comes from.
        first_sequence: number of the first sequence.
        processes: so many sequences are simulated side by side; a script that asks for more than one needs
            Python's `if __name__ == "__main__"`.
        progress: called with (scans done, scans in all).

    Returns:
        The folder `out`.

    Raises:
        InputError: where the sensor is unknown, a number is too small, embreex is missing, or the folder holds
            a sequence that was simulated otherwise.
    """
    device = _sensor(sensor)
    _at_least(1, sequences=sequences, scans=scans, processes=processes)
    _at_least(0, seed=seed, first_sequence=first_sequence)
    require_embree()
    out = Path(out)
    wanted = [Sequence(out, sensor, first_sequence + i, scans, seed) for i in range(sequences)]
    missing = [sequence for sequence in wanted if not _is_written(sequence)]
    done = scans * (len(wanted) - len(missing))
    for more in _written(missing, min(processes, len(missing))):
        done += more
        progress(done, scans * sequences)
    kept = [json.loads(path.read_text())["rows"] for path in sorted((out / DONE).glob("*.json"))]
    LAYOUTS[device.layout].complete(out, kept)
    return out


def simulate_scan(sensor: str = "hdl64e", seed: int = 0) -> SimulatedScan:
    """One scan of a street in memory."""
    return next(drive_street(_sensor(sensor), 1, np.random.SeedSequence((seed, 0))))


def _is_written(sequence: Sequence) -> bool:
    """Whether an earlier call has written the sequence; raises where it was made otherwise."""
    if not sequence.done.is_file():
        return False
    found = {
        key: value for key, value in json.loads(sequence.done.read_text()).items() if key != "rows"
    }
    if found != sequence.made:
        raise InputError(
            f"{sequence.out}: expected sequence {sequence.number} of {sequence.made}, found one of {found}; "
            "give another folder"
        )
    return True


def _written(sequences: list[Sequence], processes: int) -> Iterator[int]:
    """Write sequences; yields the number of scans that have been added."""
    if processes <= 1:
        for sequence in sequences:
            yield from _write(sequence)
        return
    # Started afresh, as a copy of a process that has computed with torch may hang.
    context = multiprocessing.get_context("spawn")
    with _one_thread_each(), ProcessPoolExecutor(processes, context, _end_with_parent) as pool:
        try:
            for written in as_completed(
                [pool.submit(_write_all, sequence) for sequence in sequences]
            ):
                yield written.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Processes that are started meanwhile leave the processors to each other: a third faster on two."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _end_with_parent() -> None:
    """A pool's process would wait for ever for one that was killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _write_all(sequence: Sequence) -> int:
    return sum(_write(sequence))


def _write(sequence: Sequence) -> Iterator[int]:
    """Write one sequence; yields 1 after each scan."""
    device = SENSORS[sequence.sensor]
    layout = LAYOUTS[device.layout](sequence.out, sequence.number)
    seeds = np.random.SeedSequence((sequence.seed, sequence.number))
    for index, scan in enumerate(drive_street(device, sequence.scans, seeds)):
        layout.scan(index, scan)
        yield 1
    rows = layout.finish()
    with atomic_write(sequence.done) as part:
        part.write_text(json.dumps({**sequence.made, "rows": rows}))


def _at_least(least: int, **numbers: int) -> None:
    for name, value in numbers.items():
        if value < least:
            raise InputError(
                f"simulate: expected {name} of {least} or more, found {value}; give a larger number"
            )


def _sensor(name: str) -> Sensor:
    if name not in SENSORS:
        raise InputError(
            f"sensor: expected one of {', '.join(SENSORS)}, found {name!r}; name one of these"
        )
    return SENSORS[name]
