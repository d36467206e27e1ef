"""Print the part of CHANGELOG.md on a version, for the release of its tag.

    python .ci/release_notes.py v0.3.0

Exit with 2 if the tag is not the version of pyproject.toml, or the changelog has no dated part on
that version.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]


def notes(tag: str, root: Path = ROOT) -> str:
    """Return the part of the changelog on the version of a tag; raise ValueError if they differ."""
    version = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "version"
    ]
    if tag != f"v{version}":
        raise ValueError(
            f"expected the tag v{version}, found {tag}; set the version in pyproject.toml"
        )

    changelog = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    heading = rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d\n(.*?)(?=^## |\Z)"
    part = re.search(heading, changelog, re.S | re.M)
    if part is None or not part[1].strip():
        raise ValueError(
            f"CHANGELOG.md: expected a part [{version}] with its date, found none; write it"
        )
    return part[1].strip() + "\n"


def main() -> int:
    try:
        print(notes(sys.argv[1]), end="")
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
