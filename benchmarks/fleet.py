"""Check and time `predict --ray` on simulated scans in an S3 server on this machine.

python benchmarks/fleet.py [--scans 400] [--workers 2]
python benchmarks/fleet.py --names 10000000

The first compares the labels with those of `predict`, also after a worker and the driver are
killed. The second lists and plans made-up names, and prints the memory that it takes. Needs
the packages of `make test-slow`.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.parquet
from pyarrow.fs import FileType

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from fixtures.s3_server import Bucket, s3_server

WEIGHTS = "sim-hdl64e"
DRIVES = 4
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
    amvnet("simulate", root / "streets", "--sequences", DRIVES, "--scans", scans // DRIVES)
    bucket.upload(root / "streets/sequences", "scans")

    start = time.perf_counter()
    pattern = f"{root}/streets/sequences/*/velodyne/*.bin"
    amvnet("predict", pattern, "--weights", WEIGHTS, "--out", root / "labels")
    alone = time.perf_counter() - start

    whole = on_ray(bucket, "whole", workers)
    print(f"predict {alone:.0f} s, --ray {whole:.0f} s, {whole / alone - 1:+.1%} with its start")
    check(root / "labels", bucket, "whole")

    on_ray(bucket, "worker", workers, kill_worker)
    check(root / "labels", bucket, "worker")
    on_ray(bucket, "driver", workers, subprocess.Popen.kill)
    on_ray(bucket, "driver", workers, None, "--resume")
    check(root / "labels", bucket, "driver")


def amvnet(*words: object) -> None:
    subprocess.run([sys.executable, "-m", "amvnet", *map(str, words)], check=True)


def on_ray(
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
    words = ["s3://fleet/scans", "--weights", WEIGHTS, "--out", f"s3://fleet/{out}", *more]
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
    from amvnet.fleet.drives import describe_drive
    from amvnet.fleet.manifest import list_blocks, windows
    from amvnet.fleet.results import Results
    from amvnet.fleet.storage import Place
    from amvnet.weights.file import load

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
        run = FleetRun(labelling, Results(Place.of(folder), {}), (1, 1), {})
        Place.of = classmethod(lambda cls, url: MadeUp(url, None, ""))  # type: ignore[method-assign, assignment]
        before = peak()
        start = time.perf_counter()
        total = 0
        for window in windows(run.plan(list_blocks(["s3://fleet"])), cluster.WINDOW):
            run.results.drives.add([describe_drive(drive, "", "", []) for drive in run.first])
            run.first.clear()
            tables = [run.to_table(block) for block in window]
            total += sum(map(len, tables))
        seconds = time.perf_counter() - start
    print(f"{total:,} names in {seconds:.0f} s; peak memory {peak():.2f} GB, {before:.2f} before")


def peak() -> float:
    """Return the peak memory of this process so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


if __name__ == "__main__":
    main()
