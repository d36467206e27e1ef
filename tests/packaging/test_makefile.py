"""The targets with which a user begins check Python first, and end with what to type next."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="needs make")


def run_make(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run make as a user does, though `make test` may run this: make inside make says more."""
    alone = {name: value for name, value in os.environ.items() if "MAKE" not in name}
    return subprocess.run(
        ["make", *words], cwd=folder, env=alone, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("target", ["install", "demo"])
def test_a_target_ends_with_the_line_to_activate_its_venv(target: str, tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    command = tmp_path / ".venv/bin/amvnet"
    command.parent.mkdir(parents=True)
    command.write_text("#!/bin/sh\necho done\n")
    command.chmod(0o755)
    (tmp_path / ".venv/installed").touch()
    os.utime(tmp_path / ".venv/installed", (2**33, 2**33))  # newer than what it is made of

    done = run_make(tmp_path, target)
    assert done.returncode == 0
    lines = done.stdout.splitlines()
    assert lines[-2].split("#")[0].strip() == "source .venv/bin/activate"
    assert lines[-1].split("#")[0].strip() == "amvnet predict scan.bin"


@pytest.mark.parametrize("version", ["2.7.18", "3.10.13", None])
def test_an_old_or_no_python_is_refused_before_all(version: str | None, tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt"):
        (tmp_path / name).touch()
    python = tmp_path / "python"
    if version is not None:
        numbers = tuple(map(int, version.split(".")))
        pretend = f"import sys; sys.version_info = {numbers}; sys.version = '{version} (old)'"
        python.write_text(
            f'#!/bin/sh\nexec {sys.executable} -c "{pretend}; exec(sys.argv[1])" "$2"\n'
        )
        python.chmod(0o755)

    done = run_make(tmp_path, "install", f"PYTHON={python}")
    assert done.returncode != 0
    assert done.stdout == ""
    found = version or f"no {python}"
    line = f"expected Python 3.11 or newer, found {found}; make install PYTHON=python3.12"
    assert done.stderr.splitlines()[0] == line
    assert not (tmp_path / ".venv").exists()


def test_other_extras_are_installed_into_a_venv_that_exists(tmp_path: Path) -> None:
    shutil.copy(ROOT / "Makefile", tmp_path)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    (tmp_path / "constraints.txt").touch()
    python = tmp_path / "python"
    python.write_text(f"""#!/bin/sh
case "$2" in
venv) mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
pip) echo "$@" >> pip.txt ;;
*) exec {sys.executable} "$@" ;;
esac
""")
    python.chmod(0o755)

    def installed(*words: str) -> list[str]:
        (tmp_path / "pip.txt").write_text("")
        assert run_make(tmp_path, "install", f"PYTHON={python}", *words).returncode == 0
        return [line.split()[-1] for line in (tmp_path / "pip.txt").read_text().splitlines()]

    assert installed() == ["torch", ".[simulate,formats,export,drives,test]"]
    assert installed() == []
    assert installed("EXTRAS=hub,drives") == ["torch", ".[hub,drives]"]
    assert installed("EXTRAS=hub,drives") == installed() == []

    done = run_make(tmp_path, "install", f"PYTHON={python}", "EXTRAS=hub,formts")
    assert done.returncode != 0
    assert done.stderr.startswith("expected EXTRAS of simulate,export,")
    assert "found formts; make install" in done.stderr.splitlines()[0]
    assert installed("EXTRAS=hub,drives") == []
