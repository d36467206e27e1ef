"""A drive of 1,000 scans through predict: memory in its course, and whether killed runs end as an undisturbed one.

python benchmarks/long_drive.py FOLDER [SCANS] [METHOD]; the drive is simulated in FOLDER.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

from amvnet.simulation import simulate

KILLED_AT = (0.3, 0.6)  # of the scans


def run(folder: Path, out: Path, method: str, until: int) -> list[int]:
    """Segment on until so many labels are there, then kill; memory in kB after each tenth of them."""
    command = [
        "predict",
        str(folder / "drive/samples"),
        "--weights",
        "sim-hdl32e",
        "--method",
        method,
    ]
    process = subprocess.Popen(
        [sys.executable, "-m", "amvnet", *command, "--out", str(out), "--resume"],
        stdout=subprocess.DEVNULL,
    )
    memory, tenth = [], max(until // 10, 1)
    while process.poll() is None:
        done = len(list(out.glob("*.label")))
        if done >= tenth * (len(memory) + 1):
            status = Path(f"/proc/{process.pid}/status").read_text()
            memory += [
                int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")
            ]
        if done >= until and list(out.glob(".unfinished-*")):
            process.kill()
            break
        time.sleep(0.05)
    process.wait()
    return memory


def main(folder: Path, scans: int = 1000, method: str = "amvnet") -> None:
    if not (folder / "drive").exists():
        simulate(folder / "drive", sensor="hdl32e", sequences=1, scans=scans)
    samples = folder / "drive/samples"
    if not any(samples.glob("*.pcd.bin")):  # a folder of lone scans
        for path in sorted(samples.rglob("*.pcd.bin")):
            path.rename(samples / path.name)
    if not (folder / "whole").exists():
        started = time.perf_counter()
        memory = run(folder, folder / "whole", method, scans + 1)
        seconds = time.perf_counter() - started
        print(
            f"{scans} scans in {seconds:.0f} s; memory at each tenth, MiB:",
            [kb // 1024 for kb in memory],
        )
    for share in (*KILLED_AT, 2):
        run(folder, folder / "killed", method, int(share * scans))
    names = sorted(path.name for path in (folder / "whole").iterdir())
    same = all(
        (folder / "killed" / name).read_bytes() == (folder / "whole" / name).read_bytes()
        for name in names
    )
    left = sorted(path.name for path in (folder / "killed").iterdir())
    print(
        f"killed twice and gone on with: {len(names)} files, {'the same' if same and left == names else 'others'}"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), *map(int, sys.argv[2:3]), *sys.argv[3:4])
