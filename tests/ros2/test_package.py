"""The files that ROS reads agree with the code, with each other, and with the package amvnet."""

from __future__ import annotations

import ast
import runpy
import sys
import tomllib
from dataclasses import fields
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from amvnet_ros.segmentation import Settings

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "ros2/amvnet_ros"
MANIFEST = ElementTree.parse(PACKAGE / "package.xml").getroot()


@pytest.fixture
def setup_arguments(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The arguments of `setup` in setup.py."""
    calls: list[dict[str, Any]] = []
    monkeypatch.setattr("setuptools.setup", lambda **arguments: calls.append(arguments))
    runpy.run_path(str(PACKAGE / "setup.py"))
    (arguments,) = calls
    return arguments


def text(tag: str) -> str:
    (element,) = MANIFEST.findall(tag)
    return element.text or ""


def test_both_manifests_agree_with_each_and_with_amvnet(setup_arguments: dict[str, Any]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert text("name") == setup_arguments["name"] == "amvnet_ros"
    assert text("version") == setup_arguments["version"] == project["version"]
    assert text("license") == setup_arguments["license"] == project["license"]
    assert text("description") == setup_arguments["description"]
    assert text("maintainer") == setup_arguments["maintainer"]
    assert text("export/build_type") == "ament_python"


def test_the_manifest_names_every_package_that_is_imported() -> None:
    imported = set()
    for path in [*PACKAGE.glob("amvnet_ros/*.py"), *PACKAGE.glob("launch/*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            if isinstance(node, ast.ImportFrom):
                imported.add((node.module or "").split(".")[0])

    # torch comes with amvnet, which pip installs.
    imported -= {"amvnet", "amvnet_ros", "torch", *sys.stdlib_module_names}
    of_import = {"numpy": "python3-numpy", "tf2_ros": "tf2_ros_py"}
    imported = {of_import.get(name, name) for name in imported}
    assert imported == {element.text for element in MANIFEST.findall("exec_depend")}


def test_the_parameters_in_the_yaml_file_are_the_defaults() -> None:
    tree = yaml.safe_load((PACKAGE / "config/segment.yaml").read_text())
    parameters = tree["/**"]["ros__parameters"]
    defaults = {field.name: field.default for field in fields(Settings)}
    assert parameters == defaults
    for name, value in parameters.items():  # ROS takes no whole number for a fraction
        assert type(value) is type(defaults[name]), name


def test_the_page_lists_every_parameter_and_topic() -> None:
    page = (PACKAGE / "README.md").read_text()
    for field in fields(Settings):
        assert f"`{field.name}`" in page
    for topic in ("points", "~/labels", "~/cloud", "~/classes", "/diagnostics"):
        assert f"`{topic}`" in page


def test_the_launch_file_starts_the_node(monkeypatch: pytest.MonkeyPatch) -> None:
    def describe(kind: str) -> Any:
        return lambda *positional, **named: SimpleNamespace(kind=kind, args=positional, **named)

    names = {
        "launch": "LaunchDescription",
        "launch.actions": "DeclareLaunchArgument",
        "launch.substitutions": "LaunchConfiguration",
        "launch_ros": "",
        "launch_ros.actions": "Node",
    }
    for module_name, name in names.items():
        module = ModuleType(module_name)
        setattr(module, name or "none", describe(name))
        monkeypatch.setitem(sys.modules, module_name, module)

    scope = runpy.run_path(str(PACKAGE / "launch/segment.launch.py"))
    (entities,) = scope["generate_launch_description"]().args
    (node,) = [entity for entity in entities if entity.kind == "Node"]
    assert (node.package, node.executable) == ("amvnet_ros", "segment")
    ((source, target),) = node.remappings
    assert source == "points"

    # Every substitution is of an argument that is declared.
    declared = {e.args[0]: e for e in entities if e.kind == "DeclareLaunchArgument"}
    assert {target.args[0], node.parameters[0].args[0]} == set(declared)
    assert Path(declared["params"].default_value).is_file()
