"""Check and time `amvnet fleet` on simulated scans in an S3 server on this machine.

    python benchmarks/fleet.py [--scans 400] [--workers 2]
    python benchmarks/fleet.py --names 10000000

The first command prints the time that `predict` and `fleet` take to start, and for each scan in a
file. Then it compares the labels that `fleet` writes to a bucket with the labels that `predict`
writes, also after a worker and the driver are killed. The second command plans a manifest of
made-up names twice, and prints the memory that it takes. Both need the packages of
`make test-full`.
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
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.parquet

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from fixtures.s3_server import Bucket, s3_server

WEIGHTS = "sim-hdl64e"
TO = ("--weights", WEIGHTS, "--out")
DRIVES = 4
FEW = 5  # number of scans of each drive from which the time of the start is told
DRIVE = 1000  # number of names in each made-up drive


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
    """Label the same scans by `predict` and on Ray, undisturbed and with kills; compare them."""
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
        on_ray = amvnet("fleet", root / name, *TO, root / f"{name}-ray", "--workers", workers)
        count = len(list((root / name).rglob("*.bin")))
        print(f"{count} files: predict {alone:.1f} s, fleet {on_ray:.1f} s", flush=True)
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
    """Print the time that a run takes at its start, and the time of each scan.

    Args:
        few, many: the number of scans, and the seconds of `predict` and of `fleet`.
    """
    slopes = []
    for name, column in (("predict", 1), ("fleet", 2)):
        slope = (many[column] - few[column]) / (many[0] - few[0])
        start = few[column] - slope * few[0]
        print(f"{name}: {start:.1f} s + {slope:.4f} s a scan")
        slopes.append(slope)
    print(f"fleet: {slopes[1] / slopes[0] - 1:+.1%} a scan, {many[2] / many[1] - 1:+.1%} in all")


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
    words = ["s3://fleet/scans", *TO, f"s3://fleet/{out}", "--workers", str(workers), *more]
    command = [sys.executable, "-m", "amvnet", "fleet", *words]
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
        if title.startswith("ray::") and "Worker" in title:
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
    """Plan a manifest of made-up names in drives of a thousand, as the driver does.

    A second time, all of them are done.
    """
    from amvnet.fleet.manifest import list_scans
    from amvnet.fleet.pipeline import Cluster, FleetRun, _windows
    from amvnet.fleet.results import Results, results_schema
    from amvnet.fleet.storage import Place
    from amvnet.inference.request import LabellingRequest
    from amvnet.weights.file import load

    with TemporaryDirectory() as folder:
        manifest = f"{folder}/fleet.parquet"
        schema = pa.schema({"path": pa.string(), "drive": pa.string()})
        with pa.parquet.ParquetWriter(manifest, schema) as writer:
            for drive in range(names // DRIVE):
                paths = [f"/car-{drive:06d}/{10**15 + index}.bin" for index in range(DRIVE)]
                values = [paths, [f"car-{drive:06d}"] * DRIVE]
                writer.write_table(pa.table(values, schema=schema))

        request = LabellingRequest(load(WEIGHTS))
        out = Place.of(f"{folder}/out")
        for resume in (False, True):
            before = peak()
            start = time.perf_counter()
            results = Results(out, request, resume=resume)
            run = FleetRun(request, results, Cluster(), {})
            remaining = 0
            for window in _windows(list_scans([manifest], out)):
                scans = run.plan(window)
                remaining += len(scans)
                if len(scans):
                    write_results(results, scans, results_schema(request.taxonomy))
            results.flush()
            seconds = time.perf_counter() - start
            print(
                f"{names:,} names, {remaining:,} to label, in {seconds:.0f} s; "
                f"peak memory {peak():.2f} GB, {before:.2f} before"
            )


def write_results(results: Any, scans: pa.Table, schema: pa.Schema) -> None:
    """Write empty label files of scans, and their rows."""
    for name in scans["name"].to_pylist():
        path = Path(f"{results.out.path}/{name}.label")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    columns = {"scan": scans["name"], "drive": scans["drive"], "path": scans["path"]}
    values = [columns.get(field.name, pa.nulls(len(scans), field.type)) for field in schema]
    results.add(pa.table(values, schema=schema))


def peak() -> float:
    """Return the peak memory of this process so far, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


if __name__ == "__main__":
    main()
