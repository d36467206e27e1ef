"""The simulator and the package that uses it know little of each other."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import amvnet
import lidarstreets

SHARED = {
    "ANY",
    "LIDAR_MODELS",
    "LidarModel",
    "SimulationError",
    "drive_street",
    "evenly_spaced",
    "simulate",
}  # what amvnet may use of lidarstreets


def imports(package: Path, name: str = "") -> Iterator[tuple[str, list[str]]]:
    """Yield each imported module of a package's files, and the names that are taken from it.

    Args:
        name: a name that the files have to mention.
    """
    for path in package.rglob("*.py"):
        text = path.read_text()
        for node in ast.walk(ast.parse(text if name in text else "")):
            if isinstance(node, ast.ImportFrom):
                yield node.module or "", [alias.name for alias in node.names]
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    yield alias.name, []


def test_the_simulator_imports_nothing_of_amvnet() -> None:
    modules = {module.partition(".")[0] for module, _ in imports(Path(lidarstreets.__path__[0]))}
    assert "numpy" in modules
    assert "amvnet" not in modules


def test_amvnet_imports_few_names_of_the_simulator() -> None:
    names: set[str] = set()
    for module, imported in imports(Path(amvnet.__path__[0]), "lidarstreets"):
        if module.partition(".")[0] == "lidarstreets":
            assert module == "lidarstreets"
            assert imported
            names.update(imported)
    assert names == SHARED
    assert set(lidarstreets.__all__) >= SHARED
