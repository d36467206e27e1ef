"""The image installs what the package requires."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = ("simulate", "formats", "export", "hub")  # of the image


def normalize(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def locked() -> dict[str, str]:
    versions = {}
    for path in ("docker/requirements.txt", "constraints.txt"):
        for line in (ROOT / path).read_text().splitlines():
            if line and not line.startswith("#"):
                name, version = line.split("==")
                versions[normalize(name)] = version
    return versions


def test_every_requirement_has_a_pinned_version_that_satisfies_it() -> None:
    texts = list(PROJECT["dependencies"])
    for extra in EXTRAS:
        texts += PROJECT["optional-dependencies"][extra]

    versions = locked()
    for text in texts:
        requirement = Requirement(text)
        version = versions.get(normalize(requirement.name))
        assert version is not None, f"{text}: run docker/lock.py"
        assert requirement.specifier.contains(version), f"{text}: run docker/lock.py"
    assert "setuptools" in versions  # builds the package, without isolation
