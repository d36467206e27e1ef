"""The conda recipe says what pyproject.toml says."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).parents[2]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]

# Names on conda-forge, if they differ.
CONDA_NAMES = {"torch": "pytorch", "matplotlib": "matplotlib-base", "ray": "ray-data"}


def read_recipe() -> dict[str, Any]:
    """Return the recipe with the variables of its context filled in."""
    text = (ROOT / "conda/recipe.yaml").read_text()
    for name, value in yaml.safe_load(text)["context"].items():
        text = text.replace(f"${{{{ {name} }}}}", value)
    recipe: dict[str, Any] = yaml.safe_load(text)
    return recipe


RECIPE = read_recipe()


def from_conda(lines: list[str]) -> dict[str, SpecifierSet]:
    """Return the versions by name that lines of a recipe ask for."""
    requirements = {}
    for line in lines:
        name, _, versions = line.partition(" ")
        requirements[name] = SpecifierSet(versions)
    return requirements


def from_pip(lines: list[str]) -> dict[str, SpecifierSet]:
    """Return the same for requirements of pip, by the names of conda."""
    requirements = {}
    for line in lines:
        requirement = Requirement(line)
        name = CONDA_NAMES.get(requirement.name, requirement.name)
        requirements[name] = requirement.specifier
    return requirements


def test_the_package_requires_what_pip_would_install() -> None:
    run = from_conda(RECIPE["requirements"]["run"])
    assert run.pop("python") == SpecifierSet(PROJECT["requires-python"])

    assert run == from_pip(PROJECT["dependencies"])


def test_the_versions_of_optional_packages_are_those_of_the_extras() -> None:
    lines = []
    for extra, requirements in PROJECT["optional-dependencies"].items():
        if extra not in ("test", "docs"):
            lines += requirements
    assert from_conda(RECIPE["requirements"]["run_constraints"]) == from_pip(lines)


def test_name_version_license_and_command_are_those_of_the_project() -> None:
    assert RECIPE["package"] == {"name": PROJECT["name"], "version": PROJECT["version"]}
    assert RECIPE["about"]["license"] == PROJECT["license"]
    assert (ROOT / RECIPE["about"]["license_file"]).is_file()
    assert (ROOT / "conda" / RECIPE["source"]["path"]).resolve() == ROOT
    entry_points = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert RECIPE["build"]["python"]["entry_points"] == entry_points


def test_it_is_built_with_the_build_system_of_the_project() -> None:
    python, *tools = RECIPE["requirements"]["host"]
    assert python == f"python {PROJECT['requires-python'].removeprefix('>=')}.*"
    expected = from_pip(PYPROJECT["build-system"]["requires"])
    assert from_conda(tools) == expected | {"pip": SpecifierSet()}
    assert RECIPE["build"]["noarch"] == "python"
    for option in ("--no-deps", "--no-build-isolation"):
        assert option in RECIPE["build"]["script"]


def test_rattler_build_accepts_it() -> None:
    rattler_build = pytest.importorskip("rattler_build")
    recipe = rattler_build.Stage0Recipe.from_file(str(ROOT / "conda/recipe.yaml"))
    (variant,) = recipe.render(rattler_build.VariantConfig())
    assert str(variant.recipe.package.version) == PROJECT["version"]
    run = from_conda([str(line) for line in variant.recipe.requirements.run])
    assert run == from_conda(RECIPE["requirements"]["run"])
