"""Run predict on a drive of 1,000 scans, measure its memory, and compare it with a killed run.

    python benchmarks/long_drive.py FOLDER [SCANS] [METHOD]

The drive is simulated in FOLDER. One run is left alone, another is killed twice and resumed.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

from lidarstreets import simulate

KILLED_AT = (0.3, 0.6)  # shares of the scans that are done when a run is killed


def predict(folder: Path, out: Path, method: str, until: int) -> list[int]:
    """Resume a run, and kill it once `until` scans are segmented.

    Returns:
        Memory in kB after each tenth of `until`.
    """
    command = [sys.executable, "-m", "amvnet", "predict", str(folder / "drive/samples")]
    options = ["--weights", "sim-hdl32e", "--method", method, "--out", str(out), "--resume"]
    process = subprocess.Popen([*command, *options], stdout=subprocess.DEVNULL)

    memory: list[int] = []
    tenth = max(until // 10, 1)
    while process.poll() is None:
        done = len(list(out.glob("*.label")))
        if done >= tenth * (len(memory) + 1):
            memory += resident_memory(process.pid)
        if done >= until and list(out.glob(".unfinished-*")):
            process.kill()
            break
        time.sleep(0.05)
    process.wait()
    return memory


def resident_memory(pid: int) -> list[int]:
    """Return the resident memory of a process in kB; empty if the process has just ended."""
    status = Path(f"/proc/{pid}/status").read_text()
    lines = [line for line in status.splitlines() if line.startswith("VmRSS")]
    return [int(line.split()[1]) for line in lines]


def simulate_drive(folder: Path, scans: int) -> None:
    """Simulate one drive, as a flat folder of scans."""
    if not (folder / "drive").exists():
        simulate(folder / "drive", sensor="hdl32e", sequences=1, scans=scans)

    samples = folder / "drive/samples"
    if not any(samples.glob("*.pcd.bin")):
        for path in sorted(samples.rglob("*.pcd.bin")):
            path.rename(samples / path.name)


def have_same_files(folder: Path, other: Path) -> bool:
    """Return whether two folders hold the same files."""
    names = sorted(path.name for path in folder.iterdir())
    if names != sorted(path.name for path in other.iterdir()):
        return False
    return all((folder / name).read_bytes() == (other / name).read_bytes() for name in names)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("scans", type=int, nargs="?", default=1000)
    parser.add_argument("method", nargs="?", default="amvnet")
    arguments = parser.parse_args()
    measure(arguments.folder, arguments.scans, arguments.method)


def measure(folder: Path, scans: int, method: str) -> None:
    simulate_drive(folder, scans)
    whole = folder / "whole"
    if not whole.exists():
        start = time.perf_counter()
        memory = predict(folder, whole, method, until=scans + 1)
        seconds = time.perf_counter() - start
        mebibytes = [kilobytes // 1024 for kilobytes in memory]
        print(f"{scans} scans in {seconds:.0f} s; memory at each tenth, MiB:", mebibytes)

    killed = folder / "killed"
    for share in (*KILLED_AT, 2):  # 2: never killed
        predict(folder, killed, method, until=int(share * scans))

    files = len(list(whole.iterdir()))
    verdict = "the same" if have_same_files(whole, killed) else "others"
    print(f"killed twice and resumed: {files} files, {verdict}")


if __name__ == "__main__":
    main()
