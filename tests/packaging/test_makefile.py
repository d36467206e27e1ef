"""The targets with which a user begins end with what to type next."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize("target", ["install", "demo"])
def test_a_target_ends_with_the_line_that_activates_the_environment(
    target: str, tmp_path: Path
) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    command = tmp_path / ".venv/bin/amvnet"
    command.parent.mkdir(parents=True)
    command.write_text("#!/bin/sh\necho done\n")
    command.chmod(0o755)
    (tmp_path / ".venv/installed").touch()
    os.utime(tmp_path / ".venv/installed", (2**33, 2**33))  # newer than what it is made of

    # `make test` runs this, and a make inside another one says which folder it enters and leaves.
    make = ["make", "--no-print-directory", target]
    lines = subprocess.check_output(make, cwd=tmp_path, text=True).splitlines()
    assert lines[-2].split("#")[0].strip() == "source .venv/bin/activate"
    assert lines[-1].split("#")[0].strip() == "amvnet predict scan.bin"
