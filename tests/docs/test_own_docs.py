"""Every command of the pages on own scans and own sensors does what it says, on small made scans."""

from __future__ import annotations

import re
import shlex
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

from amvnet.cli.main import main

from fixtures.scan_writers import write_bag1, write_pcd
from fixtures.sensors import LASERS, place

DOCS = Path(__file__).parents[2] / "docs"
PAGES = ("own_scans.md", "own_sensor.md")


def blocks(page: str, language: str) -> list[str]:
    """The blocks of a page in a language, indented ones too."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return [re.sub(r"(?m)^ +", "", b) for b in re.findall(rf"(?s)```{language}\n(.*?)```", text)]


def commands(page: str) -> list[str]:
    return [line for block in blocks(page, "bash") for line in block.splitlines()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the pages speak of."""
    folder = tmp_path_factory.mktemp("docs")
    points, _ = place(LASERS["vlp16"], 0.9)
    for name in ("more_scans", "robot"):
        (folder / name).mkdir()
        for i in range(2):
            points.tofile(folder / name / f"{i:06d}.bin")
    points.tofile(folder / "scan.bin")
    write_pcd(folder / "cloud.pcd", points * np.array([1, 1, 1, 255], np.float32), "binary")
    write_bag1(folder / "drive.bag", {"/lidar/top": [points], "/lidar/side": [points]})
    (folder / "robot.yaml").write_text(blocks("own_sensor.md", "yaml")[0])
    return folder


@pytest.mark.parametrize("command", [c for page in PAGES for c in commands(page)])
def test_every_command_runs(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = shlex.split(command)
    if words[0] == "pip":
        (extra,) = re.findall(r"\[(\w+)\]", command)
        assert extra in (metadata.metadata("amvnet").get_all("Provides-Extra") or [])
        return
    assert words[0] == "amvnet"
    monkeypatch.chdir(folder)
    assert main(words[1:]) == 0
    shown = capsys.readouterr().out
    assert "assumed" in shown
    assert "label files in labels" in shown


def test_the_promised_files_are_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    inputs = ["scan.bin", "more_scans/", "drive.bag", "--topic", "/lidar/top"]
    assert (
        main(["predict", *inputs, "--weights", "sim-hdl64e", "--method", "rv", "--out", "promised"])
        == 0
    )
    names = {str(path.relative_to("promised")) for path in Path("promised").rglob("*.label")}
    assert names == {"scan.label", "000000.label", "000001.label", "drive/000000.label"}


def test_the_python_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    scope: dict[str, object] = {}
    for block in blocks("own_scans.md", "python"):
        exec(block, scope)
    assert len(scope["result"].labels) == 16 * 360  # type: ignore[attr-defined]


def test_the_line_that_is_shown_is_the_one_that_is_said(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert (
        main(
            [
                "predict",
                "cloud.pcd",
                "--weights",
                "sim-hdl64e",
                "--method",
                "bev",
                "--out",
                "labels",
            ]
        )
        == 0
    )
    said = capsys.readouterr().out.splitlines()[0]
    text = (DOCS / "own_scans.md").read_text(encoding="utf-8")
    shown = " ".join(re.findall(r"    (cloud\.pcd: .*)\n    (.*)\n", text)[0])
    heights = (
        r"\d\.\d\d m over the ground \(moved by -\d\.\d\d m"  # which differ by some millimetres
    )
    assert re.sub(heights, "", said) == re.sub(heights, "", shown)


def test_the_names_of_sensors_are_those_that_are_known() -> None:
    from amvnet.sensors.lidars import SENSORS

    text = (DOCS / "own_sensor.md").read_text(encoding="utf-8")
    listed = re.findall(r"(?s)A name states lasers and field of view: (.*?)\. Where", text)[0]
    assert re.findall(r"`([\w-]+)`", listed) == list(SENSORS)
