"""Give the project a new version: set it, date its part of the changelog, commit and tag it.

    python .ci/release.py 0.4.0

Exit with 2, and change nothing, if the version is not above the present one, the changelog has
nothing unreleased, or files are not committed. Nothing is pushed: the tag publishes the release.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parents[1]
UNRELEASED = "## [Unreleased]\n"


def git(*words: str) -> str:
    """Run git in the project; return what it prints."""
    command = ["git", "-C", str(ROOT), *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def numbers(version: str) -> tuple[int, ...]:
    """Return the numbers of X.Y.Z; raise ValueError if a version is something else."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        raise ValueError(f"expected a version like 1.2.3, found {version!r}; correct it")
    return tuple(map(int, version.split(".")))


def new_texts(version: str) -> dict[Path, str]:
    """Return the contents that files have with a version; raise ValueError if it cannot be one."""
    texts = {}
    for name in ("pyproject.toml", "ros2/amvnet_ros/package.xml", "CHANGELOG.md"):
        texts[ROOT / name] = (ROOT / name).read_text(encoding="utf-8")
    project, package, changelog = texts

    present = tomllib.loads(texts[project])["project"]["version"]
    if numbers(version) <= numbers(present):
        raise ValueError(f"expected a version above {present}, found {version}; choose another one")

    unreleased = re.search(
        rf"^{re.escape(UNRELEASED)}(.*?)(?=^## |\Z)", texts[changelog], re.S | re.M
    )
    if unreleased is None or not unreleased[1].strip():
        raise ValueError("CHANGELOG.md: expected a part [Unreleased] with text; write it")

    day = datetime.now(UTC).date()
    dated = f"{UNRELEASED}\n## [{version}] - {day}\n"
    texts[project] = texts[project].replace(f'version = "{present}"', f'version = "{version}"', 1)
    texts[package] = texts[package].replace(
        f"<version>{present}</version>", f"<version>{version}</version>", 1
    )
    texts[changelog] = texts[changelog].replace(UNRELEASED, dated, 1)
    return texts


def release(version: str) -> None:
    """Commit and tag a version; raise ValueError if that is not possible."""
    texts = new_texts(version)
    if git("status", "--porcelain"):
        raise ValueError("expected all changes committed, found others; commit or stash them")
    if git("tag", "--list", f"v{version}"):
        raise ValueError(f"expected a new version, found the tag v{version}; choose another one")

    for path, text in texts.items():
        path.write_text(text, encoding="utf-8")
    git("commit", "--quiet", "--message", f"Version {version}", "--", *map(str, texts))
    git("tag", f"v{version}")


def main() -> int:
    try:
        release(sys.argv[1] if len(sys.argv) == 2 else "")
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    print(
        f"v{sys.argv[1]} is committed and tagged; git push origin HEAD v{sys.argv[1]} publishes it"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
