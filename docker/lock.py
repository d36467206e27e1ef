"""Print the versions that pip would install, for docker/requirements.txt.

Run this with the Python of the image:

    python3.12 docker/lock.py > docker/requirements.txt
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
# The extras that the image has.
EXTRAS = ("simulate", "formats", "export", "hub")

# The beginnings of the names that are left out: torch, which constraints.txt pins, and the packages
# that torch itself pins. Some of these packages do not exist for every machine.
OF_TORCH = ("cuda-", "nvidia-", "torch", "triton")
KEPT = ("torchmetrics",)  # the packages that are kept in spite of their names
HEADER = f"""\
# What the image installs besides torch, for Python 3.12: the package with {", ".join(EXTRAS)}.
# Written by: python3.12 docker/lock.py > docker/requirements.txt"""


def main() -> None:
    """Print what pip would install."""
    package = f"{ROOT}[{','.join(EXTRAS)}]"
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    options = ["--dry-run", "--ignore-installed", "--quiet", "--report", "-"]
    command = [sys.executable, "-m", "pip", "install", *options, *constraints, package]
    report = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)

    versions = {}
    for entry in report["install"]:
        name = entry["metadata"]["name"].lower().replace("_", "-")
        is_of_torch = name.startswith(OF_TORCH) and name not in KEPT
        if name != "amvnet" and not is_of_torch:
            versions[name] = entry["metadata"]["version"].split("+")[0]

    print(HEADER)
    for name in sorted(versions):
        print(f"{name}=={versions[name]}")


if __name__ == "__main__":
    main()
