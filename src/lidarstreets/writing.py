"""Write simulated sequences with several processes, and continue after an interruption."""

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from lidarstreets.course import SPACING, Drive
from lidarstreets.drive import drive_street
from lidarstreets.errors import SimulationError
from lidarstreets.layouts import LAYOUTS, WRITE_LOCK, write_whole
from lidarstreets.sensing.lidar import require_embree, take_one_thread
from lidarstreets.sensing.sensors import LIDAR_MODELS, LidarModel, sensor_of

Progress = Callable[[int, int], None]  # called with the number of scans written, and of all scans
# Environment variables that set the number of threads of the numerical libraries.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Folder with one file for each complete sequence: its settings and what the layout's tables need.
MARKER_FOLDER = ".simulation"
SHORTEST, LONGEST = 0.1, 50.0  # limits of the distance between two scans, metres


@dataclass(frozen=True)
class Sequence:
    """One sequence to write.

    Attributes:
        out: the folder of all sequences.
        sensor: the LiDAR.
        number: number of the sequence.
        scans: number of its scans.
        seed: seed of all sequences.
        spacing: distance between two scans, metres.
    """

    out: Path
    sensor: LidarModel
    number: int
    scans: int
    seed: int
    spacing: float = SPACING

    @property
    def drive(self) -> Drive:
        """How the sensor moves. Streets are equally long, however dense their scans are."""
        scans = round(Drive.scans_per_street * Drive.spacing / self.spacing)
        return Drive(spacing=self.spacing, scans_per_street=max(scans, 1))

    @property
    def settings(self) -> dict[str, Any]:
        """The settings that, with the number of the sequence, determine the bytes of its files."""
        name = self.sensor.name
        is_known = LIDAR_MODELS.get(name) == self.sensor
        # As JSON gives it back, with lists in the place of tuples.
        sensor = name if is_known else json.loads(json.dumps(asdict(self.sensor)))
        settings = {"sensor": sensor, "seed": self.seed, "scans": self.scans}
        return settings if self.spacing == SPACING else {**settings, "spacing": self.spacing}

    @property
    def marker(self) -> Path:
        """The file that exists once the sequence is complete."""
        return self.out / MARKER_FOLDER / f"{self.number:04d}.json"

    @property
    def begun(self) -> Path:
        """The file that exists once a call has begun to write the sequence."""
        return self.marker.with_suffix(".begun")


def simulate(
    out: Path | str,
    *,
    sensor: LidarModel | str = "hdl64e",
    sequences: int = 1,
    scans: int = 10,
    seed: int = 0,
    first_sequence: int = 0,
    spacing: float = SPACING,
    processes: int = 1,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Write labelled scans of procedural streets.

    The same seed gives the same bytes on any number of processes. A processor with other vector
    instructions rounds the last bit differently, which may lead to other streets. Sequences that an
    earlier call has completed are kept.

    Args:
        out: folder to write to, in the layout of nuScenes-lidarseg for an HDL-32E, of a robot with
            a YAML file for a VLP-16, and of SemanticKITTI for other sensors.
        sensor: the LiDAR, or its name in `LIDAR_MODELS`.
        sequences: number of sequences, each in another street.
        scans: number of scans in each sequence.
        seed: seed of all randomness.
        first_sequence: number of the first sequence.
        spacing: distance between two scans, metres; a drive has scans every metre or so.
        processes: number of processes, each of which simulates one sequence at a time. A script
            that asks for more than one must guard its own code by `if __name__ == "__main__"`.
        progress: called with the number of scans written so far and the number of all scans.

    Returns:
        The folder `out`.

    Raises:
        SimulationError: if the sensor is unknown, a number is too small, embreex is missing, the
            folder cannot be written, or it holds a sequence that has other settings or that was
            not simulated.
    """
    model = sensor_of(sensor)
    layout = LAYOUTS[model.layout]
    _check_at_least(1, sequences=sequences, scans=scans, processes=processes)
    _check_at_least(0, seed=seed, first_sequence=first_sequence)
    if not SHORTEST <= spacing <= LONGEST:
        raise SimulationError(
            f"simulate: expected a spacing of {SHORTEST} to {LONGEST} m, found {spacing}"
        )
    require_embree()

    out = Path(out)
    missing = []
    for number in range(first_sequence, first_sequence + sequences):
        sequence = Sequence(out, model, number, scans, seed, spacing)
        if not _is_complete(sequence):
            _check_is_simulated(sequence)
            missing.append(sequence)

    done = scans * (sequences - len(missing))
    for written in _write_sequences(missing, min(processes, len(missing))):
        done += written
        progress(done, scans * sequences)

    # The layout's tables cover all sequences in the folder, including sequences of earlier calls.
    rows = []
    for path in sorted((out / MARKER_FOLDER).glob("*.json")):
        marker = _read_marker(path)
        if marker is None:
            raise SimulationError(
                f"{path}: expected the record of a complete sequence, found a broken file; "
                f"simulate sequence {path.stem} again, or choose another folder"
            )
        rows.append(marker["rows"])
    layout.complete(out, rows)
    return out


def _read_marker(path: Path) -> dict[str, Any] | None:
    """Return the content of a file in `MARKER_FOLDER`; None if it is broken, as by a power cut."""
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and isinstance(content.get("rows"), dict) else None


def _is_complete(sequence: Sequence) -> bool:
    """Return whether an earlier call has completed a sequence.

    Raises:
        SimulationError: if it did so with other settings.
    """
    settings = _read_marker(sequence.marker) if sequence.marker.is_file() else None
    if settings is None:
        return False

    del settings["rows"]
    if settings != sequence.settings:
        expected, found = _differences(sequence.settings, settings)
        raise SimulationError(
            f"{sequence.out}: expected sequence {sequence.number} with {expected}, "
            f"found it with {found}; choose another folder"
        )
    return True


def _differences(first: Any, second: Any) -> tuple[Any, Any]:
    """Return two settings without the entries that they share, also of a described sensor."""
    if not (isinstance(first, dict) and isinstance(second, dict)):
        return first, second
    differences: tuple[dict[str, Any], dict[str, Any]] = ({}, {})
    for key in (*first, *second):
        if first.get(key) != second.get(key):
            pair = _differences(first.get(key), second.get(key))
            for found, value in zip(differences, pair, strict=True):
                found[key] = value
    return differences


def _check_is_simulated(sequence: Sequence) -> None:
    """Raise if the folder of a sequence has files that were not simulated, such as real scans."""
    layout = LAYOUTS[sequence.sensor.layout]
    place, belongs_to_all = layout.owned_path(sequence.out, sequence.number)
    begun = (sequence.out / MARKER_FOLDER).glob("*") if belongs_to_all else [sequence.begun]
    if os.path.lexists(place) and not any(path.exists() for path in begun):
        raise SimulationError(
            f"{place}: expected simulated scans or nothing there, found something else; "
            "choose another folder"
        )


def _write_sequences(sequences: list[Sequence], processes: int) -> Iterator[int]:
    """Write sequences; each time that scans are written, yield their number."""
    if processes <= 1:
        for sequence in sequences:
            yield from _write(sequence)
        return

    # Workers are spawned: a fork of a process that has computed with torch may hang.
    context = multiprocessing.get_context("spawn")
    lifeline, parents_end = context.Pipe(duplex=False)
    with ProcessPoolExecutor(processes, context, _start_worker, (lifeline,)) as pool:
        try:
            with _inherited_by_workers():
                jobs = [pool.submit(_write_all, sequence) for sequence in sequences]
            for job in as_completed(jobs):
                yield job.result()
        except BaseException:
            parents_end.close()
            pool.shutdown(cancel_futures=True)
            raise


@contextmanager
def _inherited_by_workers() -> Iterator[None]:
    """Let processes started in this context compute with one thread and ignore Ctrl-C and SIGTERM.

    Ctrl-C reaches all processes of a terminal, but workers end with their parent instead: see
    `_start_worker`.
    """
    variables = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
        for name, value in variables.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _start_worker(lifeline: Connection) -> None:
    """Prepare a worker: it computes with one thread, and ends when its parent says so or dies.

    Args:
        lifeline: a pipe to the parent. The parent closes its end to stop the worker; if the parent
            is killed, the system closes it.
    """

    def watch() -> None:
        lifeline.poll(None)
        with WRITE_LOCK:  # a file that is being written is finished first
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    take_one_thread()


def _write_all(sequence: Sequence) -> int:
    return sum(_write(sequence))


def _write(sequence: Sequence) -> Iterator[int]:
    """Write one sequence; yield 1 after each scan."""
    layout = LAYOUTS[sequence.sensor.layout](sequence.out, sequence.number)
    seed = np.random.SeedSequence((sequence.seed, sequence.number))
    write_whole(sequence.begun, b"")
    scans = drive_street(sequence.sensor, sequence.scans, seed, sequence.drive)
    for index, scan in enumerate(scans):
        layout.write_scan(index, scan)
        yield 1

    rows = layout.finish()
    marker = json.dumps({**sequence.settings, "rows": rows})
    write_whole(sequence.marker, marker.encode())


def _check_at_least(least: int, **numbers: int) -> None:
    for name, value in numbers.items():
        if value < least:
            raise SimulationError(
                f"simulate: expected {name} of {least} or more, found {value}; give a larger number"
            )
