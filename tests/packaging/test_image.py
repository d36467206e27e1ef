"""The image can be built as far as its files tell, without a container engine."""

from __future__ import annotations

import fnmatch
import re
import shlex
import subprocess
import tomllib
from pathlib import Path
from typing import NamedTuple

import pytest
from packaging.requirements import Requirement

from amvnet.cli.main import COMMANDS

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = ("simulate", "formats", "export", "hub")  # of the image


class Instruction(NamedTuple):
    """An instruction of a Dockerfile: its name, and the rest of its (joined) line."""

    name: str
    rest: str


def parse(text: str) -> list[Instruction]:
    """Return the instructions of a Dockerfile without comments, with lines joined."""
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    instructions = []
    for line in joined.splitlines():
        if line.strip():
            name, rest = line.split(maxsplit=1)
            instructions.append(Instruction(name, rest))
    return instructions


INSTRUCTIONS = parse((ROOT / "Dockerfile").read_text())


def rests(name: str) -> list[str]:
    return [instruction.rest for instruction in INSTRUCTIONS if instruction.name == name]


def arguments() -> dict[str, str]:
    """Return the build arguments and their defaults."""
    return dict(rest.split("=", 1) for rest in rests("ARG"))


def base_images() -> list[str]:
    images = []
    for rest in rests("FROM"):
        image = rest.split()[0]
        for name, default in arguments().items():
            image = image.replace(f"${{{name}}}", default)
        images.append(image)
    return images


def copied() -> list[str]:
    """Return the sources of COPY that are files of the project."""
    sources = []
    for rest in rests("COPY"):
        words = shlex.split(rest)
        if not words[0].startswith("--from="):
            sources += words[:-1]
    return sources


def is_sent(path: str) -> bool:
    """Return whether .dockerignore lets a path through: the last line that matches it decides."""
    sent = True
    parts = Path(path).parts
    ancestors = ["/".join(parts[: count + 1]) for count in range(len(parts))]
    for line in (ROOT / ".dockerignore").read_text().splitlines():
        if not line or line.startswith("#"):
            continue
        pattern = line.removeprefix("!")
        anywhere = pattern.removeprefix("**/")
        for ancestor in ancestors:
            name = ancestor.split("/")[-1] if pattern.startswith("**/") else ancestor
            if fnmatch.fnmatchcase(name, anywhere) and (pattern != "*" or "/" not in ancestor):
                sent = line.startswith("!")
    return sent


def normalize(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def locked() -> dict[str, str]:
    """Return the versions that the image installs, by name."""
    versions = {}
    for path in ("docker/requirements.txt", "constraints.txt"):
        for line in (ROOT / path).read_text().splitlines():
            if line and not line.startswith("#"):
                name, version = line.split("==")
                versions[normalize(name)] = version
    return versions


def test_base_images_are_pinned_to_a_release_of_python_that_amvnet_supports() -> None:
    images = base_images()
    assert len(images) == 2
    for image in images:
        match = re.fullmatch(r"python:(\d+\.\d+)\.\d+-slim-[a-z]+(@sha256:[0-9a-f]{64})?", image)
        assert match is not None, image
        assert f"Programming Language :: Python :: {match[1]}" in PROJECT["classifiers"]


@pytest.mark.parametrize("source", copied())
def test_what_is_copied_is_there_and_not_ignored(source: str) -> None:
    assert (ROOT / source).exists()
    assert is_sent(source)
    command = ["git", "ls-files", "--error-unmatch", source]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, check=False).returncode == 0


def test_the_weights_and_all_that_the_package_needs_are_sent_and_nothing_else() -> None:
    for weights in (ROOT / "src/amvnet/pretrained").glob("*.safetensors"):
        assert is_sent(str(weights.relative_to(ROOT)))
    assert {PROJECT["readme"], *PROJECT["license-files"]} <= set(copied())

    for path in (
        ".git/config",
        "tests/conftest.py",
        "docs/page.png",
        "demo/a",
        "runs/a",
        ".venv/a",
    ):
        assert not is_sent(path), path
    for path in ("src/amvnet/__pycache__/scan.pyc", "src/amvnet.egg-info/PKG-INFO"):
        assert not is_sent(path), path


@pytest.mark.parametrize("command", rests("RUN"))
def test_every_command_is_one_that_the_shell_can_parse(command: str) -> None:
    subprocess.run(["sh", "-n", "-c", command], check=True)


@pytest.mark.parametrize(("device", "index"), [("cpu", "whl/cpu"), ("cuda", ""), ("tpu", None)])
def test_the_build_argument_chooses_the_index_of_torch(device: str, index: str | None) -> None:
    (command,) = [rest for rest in rests("RUN") if rest.split()[0] == "case"]
    script = f'pip() {{ echo "index=$PIP_EXTRA_INDEX_URL"; }}\n{command}'
    environment = {"PATH": "/usr/bin:/bin", "DEVICE": device}
    process = subprocess.run(
        ["sh", "-c", script], env=environment, capture_output=True, text=True, check=False
    )
    if index is None:
        assert process.returncode == 2
        assert "expected cpu or cuda, found tpu" in process.stderr
    else:
        assert process.stdout.strip().endswith(index)
        assert ("https" in process.stdout) == bool(index)


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


def test_the_page_runs_commands_that_there_are() -> None:
    page = (ROOT / "docs/deployment.md").read_text()
    commands = re.findall(r"docker run .*? (amvnet(?::\w+)?) (\w+)|run --rm \w+ (\w+)", page)
    assert len(commands) >= 3
    for _, command, composed_command in commands:
        assert command + composed_command in COMMANDS
    for path in re.findall(r"(?:docker|ros2)/[\w./]+\w", page):
        assert (ROOT / path).exists(), path
