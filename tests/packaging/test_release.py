"""One version, in one place; a tag releases its part of the changelog."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTES = ROOT / ".ci/release_notes.py"
AUTHOR = {
    f"GIT_{who}_{what}": "a@b.example"
    for who in ("AUTHOR", "COMMITTER")
    for what in ("NAME", "EMAIL")
}


def run_notes(root: Path, tag: str) -> subprocess.CompletedProcess[str]:
    """Run the program on a copy of what it reads, below `root`."""
    (root / ".ci").mkdir(exist_ok=True)
    (root / ".ci/release_notes.py").write_text(NOTES.read_text())
    command = [sys.executable, str(root / ".ci/release_notes.py"), tag]
    return subprocess.run(command, capture_output=True, text=True)


def make_project(root: Path, changelog: str) -> None:
    (root / "pyproject.toml").write_text('[project]\nversion = "1.2.3"\n')
    (root / "CHANGELOG.md").write_text(changelog)


def test_the_notes_are_the_part_on_the_version(tmp_path: Path) -> None:
    newest = "## [Unreleased]\n\n- not yet\n\n## [1.2.3] - 2026-01-02\n\n### Added\n\n- this\n\n"
    make_project(tmp_path, f"# Changelog\n\n{newest}## [1.2.2] - 2025-01-02\n\n- that\n")
    result = run_notes(tmp_path, "v1.2.3")
    assert (result.returncode, result.stdout) == (0, "### Added\n\n- this\n")


def test_a_tag_of_another_version_is_not_released(tmp_path: Path) -> None:
    make_project(tmp_path, "## [1.2.4] - 2026-01-02\n\n- this\n")
    result = run_notes(tmp_path, "v1.2.4")
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)


@pytest.mark.parametrize("changelog", ["## [Unreleased]\n\n- a\n", "## [1.2.3] - 2026-01-02\n"])
def test_a_version_without_a_dated_part_is_not_released(changelog: str, tmp_path: Path) -> None:
    make_project(tmp_path, changelog)
    result = run_notes(tmp_path, "v1.2.3")
    assert (result.returncode, result.stderr.count("\n")) == (2, 1)


def run_release(root: Path, version: str) -> subprocess.CompletedProcess[str]:
    """Release a version of a copy of the project, which is a repository below `root`."""
    names = ("pyproject.toml", "CHANGELOG.md", "ros2/amvnet_ros/package.xml", ".ci/release.py")
    if not (root / ".git").exists():
        for name in names:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes((ROOT / name).read_bytes())
        changelog = root / "CHANGELOG.md"
        text = changelog.read_text().replace("[Unreleased]\n", "[Unreleased]\n\n- new\n", 1)
        changelog.write_text(text)
        git(root, "init", "--quiet")
        git(root, "add", *names)
        git(root, "commit", "--quiet", "--message", "first")
    command = [sys.executable, str(root / ".ci/release.py"), version]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | AUTHOR)


def git(root: Path, *words: str) -> str:
    command = ["git", "-C", str(root), *words]
    return subprocess.run(command, capture_output=True, text=True, env=os.environ | AUTHOR).stdout


def test_a_release_is_a_tagged_commit_whose_notes_are_those_of_the_tag(tmp_path: Path) -> None:
    result = run_release(tmp_path, "99.0.0")
    assert result.returncode == 0, result.stderr
    assert git(tmp_path, "status", "--porcelain") == ""
    assert git(tmp_path, "tag", "--points-at", "HEAD") == "v99.0.0\n"
    assert git(tmp_path, "diff", "--name-only", "HEAD~").split() == [
        *("CHANGELOG.md", "pyproject.toml", "ros2/amvnet_ros/package.xml")
    ]
    assert "<version>99.0.0</version>" in (tmp_path / "ros2/amvnet_ros/package.xml").read_text()
    assert run_notes(tmp_path, "v99.0.0").stdout.startswith("- new\n")

    # What came before is released, so that there is nothing to release again.
    again = run_release(tmp_path, "99.0.1")
    assert again.returncode == 2
    assert "Unreleased" in again.stderr


def test_a_release_that_is_refused_changes_nothing(tmp_path: Path) -> None:
    for version, word in (("v99", "1.2.3"), ("0.0.1", "above"), ("", "1.2.3")):
        result = run_release(tmp_path, version)
        assert (result.returncode, result.stderr.count("\n")) == (2, 1)
        assert word in result.stderr

    (tmp_path / "new.txt").write_text("not committed")
    result = run_release(tmp_path, "99.0.0")
    assert result.returncode == 2
    assert "commit" in result.stderr
    assert git(tmp_path, "log", "--format=%s") == "first\n"
    assert git(tmp_path, "diff") == git(tmp_path, "tag") == ""
