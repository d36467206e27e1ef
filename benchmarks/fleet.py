"""Check and time `predict --ray` on simulated scans in an S3 server on this machine.

    python benchmarks/fleet.py [--scans 400] [--workers 2]
    python benchmarks/fleet.py --names 10000000

The first prints what `predict` and `--ray` take to start and for each scan, from files; then it
compares the labels in a bucket with those of `predict`, also after a worker and the driver are
killed. The second lists and plans made-up names, and prints the memory that it takes. Needs
the packages of `make test-slow`.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.parquet
from pyarrow.fs import FileType

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from fixtures.s3_server import Bucket, s3_server

WEIGHTS = "sim-hdl64e"
TO = ("--weights", WEIGHTS, "--out")
DRIVES = 4
FEW = 5  # scans of each drive, to tell the time of the start
DRIVE = 1000  # names of each made-up drive


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=400)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--names", type=int)
    options = parser.parse_args()
    if options.names:
        plan(options.names)
        return
    with TemporaryDirectory() as folder, s3_server() as bucket:
        compare(Path(folder), bucket, options.scans, options.workers)


def compare(root: Path, bucket: Bucket, scans: int, workers: int) -> None:
    """Label the same scans by `predict`, and on Ray undisturbed and with kills; print both."""
    simulated = root / "streets"
    amvnet("simulate", simulated, "--sequences", DRIVES, "--scans", scans // DRIVES)
    for folder in sorted(simulated.glob("sequences/*/velodyne")):
        drive = folder.parent.name
        shutil.copytree(folder, root / "scans" / drive)
        (root / "few" / drive).mkdir(parents=True)
        for path in sorted(folder.iterdir())[:FEW]:
            shutil.copy(path, root / "few" / drive)
    bucket.upload(root / "scans", "scans")

    for name in ("few", "scans"):
        alone = amvnet("predict", f"{root / name}/*/*.bin", *TO, root / f"{name}-alone")
        on_ray = amvnet(
            *("predict", root / name, *TO, root / f"{name}-ray"), "--workers", workers, "--ray"
        )
        count = len(list((root / name).rglob("*.bin")))
        print(f"{count} files: predict {alone:.1f} s, --ray {on_ray:.1f} s", flush=True)
        if name == "few":
            few = (count, alone, on_ray)
    print_costs(few, (count, alone, on_ray))

    expected = root / "scans-alone"
    print(f"from the S3 server on the same cores: {in_bucket(bucket, 'whole', workers):.1f} s")
    check(expected, bucket, "whole")
    in_bucket(bucket, "worker", workers, kill_worker)
    check(expected, bucket, "worker")
    in_bucket(bucket, "driver", workers, subprocess.Popen.kill)
    in_bucket(bucket, "driver", workers, None, "--resume")
    check(expected, bucket, "driver")


def print_costs(few: tuple[int, float, float], many: tuple[int, float, float]) -> None:
    """Print what a run takes at its start, and what each scan takes.

    Args:
        few, many: the number of scans, and the seconds of `predict` and of `--ray`.
    """
    slopes = []
    for name, column in (("predict", 1), ("--ray", 2)):
        slope = (many[column] - few[column]) / (many[0] - few[0])
        start = few[column] - slope * few[0]
        print(f"{name}: {start:.1f} s + {slope:.4f} s a scan")
        slopes.append(slope)
    print(f"--ray: {slopes[1] / slopes[0] - 1:+.1%} a scan, {many[2] / many[1] - 1:+.1%} in all")


def amvnet(*words: object) -> float:
    """Run a command; return the seconds."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "amvnet", *map(str, words)], check=True)
    return time.perf_counter() - start


def in_bucket(
    bucket: Bucket,
    out: str,
    workers: int,
    kill: Callable[[subprocess.Popen[bytes]], Any] | None = None,
    *more: str,
) -> float:
    """Label the scans of the bucket; return the seconds.

    Args:
        kill: kills something when a quarter of the labels is there.
    """
    words = ["s3://fleet/scans", *TO, f"s3://fleet/{out}", *more]
    words += ["--workers", str(workers), "--ray"]
    command = [sys.executable, "-m", "amvnet", "predict", *words]
    start = time.perf_counter()
    process = subprocess.Popen(command)
    if kill is not None:
        total = len([key for key in bucket.keys("scans") if key.endswith(".bin")])
        while len(label_keys(bucket, out)) < total // 4 and process.poll() is None:
            time.sleep(0.2)
        kill(process)
    process.wait()
    return time.perf_counter() - start


def kill_worker(driver: subprocess.Popen[bytes]) -> None:
    """Kill one of the workers of a driver on this machine."""
    listing = subprocess.run(["ps", "-eo", "pid,args"], capture_output=True, text=True, check=True)
    for line in listing.stdout.splitlines():
        pid, _, title = line.strip().partition(" ")
        if title.startswith("ray::") and "LabelScans" in title:
            os.kill(int(pid), signal.SIGKILL)
            return


def label_keys(bucket: Bucket, out: str) -> list[str]:
    return [key for key in bucket.keys(out) if key.endswith(".label")]


def check(folder: Path, bucket: Bucket, out: str) -> None:
    """Print how many labels differ, and whether the table has each scan once."""
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*.label")}
    keys = set(label_keys(bucket, out))
    differing = 0
    for name in names & keys:
        differing += (folder / name).read_bytes() != bucket[f"{out}/{name}"]

    parts = [key for key in bucket.keys(out) if "part-" in key]
    tables = [pa.parquet.read_table(BytesIO(bucket[f"{out}/{part}"])) for part in parts]
    scans = pa.concat_tables(tables)["scan"].to_pylist()
    print(
        f"{out}: {len(names ^ keys)} labels missing, {differing} of {len(names)} differ, "
        f"{len(scans) - len(set(scans))} rows twice, {len(names) - len(set(scans))} missing"
    )


def plan(names: int) -> None:
    """List and plan made-up names in drives of a thousand, as the driver does before it labels."""
    from amvnet.fleet import cluster
    from amvnet.fleet.actors import Labelling
    from amvnet.fleet.cluster import FleetRun
    from amvnet.fleet.manifest import list_blocks
    from amvnet.fleet.results import Results, describe_drive
    from amvnet.fleet.storage import Place
    from amvnet.weights.file import load

    class Measuring:
        """Workers that find nothing to measure."""

        def run(self, method: str, tables: list[pa.Table]) -> Iterator[tuple[pa.Table, Any]]:
            for table in tables:
                yield table, describe_drive(table["drive"][0].as_py(), "", None)

    class MadeUp(Place):
        def kind(self) -> FileType:
            return FileType.Directory

        def children(self) -> tuple[list[str], list[str]]:
            if self.url == "s3://fleet":
                return [], [f"car-{index:06d}" for index in range(names // DRIVE)]
            return [f"{1_700_000_000_000_000 + index}.bin" for index in range(DRIVE)], []

        def __truediv__(self, name: str) -> Place:
            return MadeUp(f"{self.url}/{name}", self.filesystem, "")

    with TemporaryDirectory() as folder:
        labelling = Labelling(load(WEIGHTS), folder)
        run = FleetRun(labelling, Results(Place.of(folder), {}), Measuring())  # type: ignore[arg-type]
        Place.of = classmethod(lambda cls, url: MadeUp(url, None, ""))  # type: ignore[method-assign, assignment]
        before = peak()
        start = time.perf_counter()
        total = 0
        blocks = list_blocks(["s3://fleet"])
        while window := list(islice(blocks, cluster.WINDOW)):
            total += sum(map(len, run.plan(window)))
            run.measure()
        seconds = time.perf_counter() - start
    print(f"{total:,} names in {seconds:.0f} s; peak memory {peak():.2f} GB, {before:.2f} before")


def peak() -> float:
    """Return the peak memory of this process so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


if __name__ == "__main__":
    main()
