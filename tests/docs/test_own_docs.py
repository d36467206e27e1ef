"""Every command of the pages on own scans and sensors does what they say, on small scans."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from amvnet.data.formats.detect import ENDINGS
from amvnet.data.formats.registry import PACKAGES
from amvnet.sensors.lidars import KNOWN_SENSORS
from amvnet.weights.file import load, save
from amvnet.weights.verdict import Verdict

from fixtures.commands import files, succeed
from fixtures.marks import with_quick
from fixtures.pages import Changes, DocsPage, execute, run
from fixtures.scan_writers import write_bag1, write_pcd
from fixtures.sensors import LASERS, place
from fixtures.tiny import fresh_weights

SCANS = DocsPage("docs/own_scans.md")
SENSOR = DocsPage("docs/own_sensor.md")
COMMANDS = SCANS.commands + SENSOR.commands
QUICK = (SCANS.commands[0], SENSOR.commands[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs")
    points, _ = place(LASERS["vlp16"], 0.9)
    points.tofile(folder / "scan.bin")
    for name in ("more_scans", "scans"):
        (folder / name).mkdir()
        points.tofile(folder / name / "000000.bin")
        points.tofile(folder / name / "000001.bin")

    rows = np.column_stack([points, np.arange(len(points)) % 16, np.zeros(len(points))])
    rows.astype(np.float32).tofile(folder / "rows.bin")
    write_pcd(folder / "cloud.pcd", points * np.array([1, 1, 1, 255], np.float32), "binary")
    write_bag1(folder / "drive.bag", {"/lidar/top": [points], "/lidar/side": [points]})
    (folder / "sensor.yaml").write_text(SENSOR.blocks("yaml")[0])
    expects = load("sim-hdl64e").expects
    save(replace(fresh_weights(), expects=expects, sensor="hdl64e"), folder / "tiny.safetensors")
    return folder


@pytest.mark.parametrize("command", with_quick(COMMANDS, QUICK), ids=" ".join)
def test_every_command_runs(
    command: list[str],
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    shutil.rmtree("labels", ignore_errors=True)  # of another command
    run([command], Changes(words={"sim-hdl64e": "tiny.safetensors"}))
    if command[0] == "amvnet":
        text = capsys.readouterr().out
        assert "assumed" in text
        assert re.search(r"\d+ label files? in \w*labels", text)


@pytest.mark.full
def test_the_promised_files_are_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    inputs = "scan.bin more_scans/ drive.bag --topic /lidar/top"
    succeed(f"predict {inputs} --weights sim-hdl64e --method rv --out promised")
    assert files(Path("promised")) == {
        "scan.label",
        "000000.label",
        "000001.label",
        "drive/000000.label",
    }


@pytest.mark.full
def test_the_python_runs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    variables = execute(SCANS.blocks("python"))
    assert len(variables["result"].labels) == 16 * 360  # lasers, and firings of each


def test_the_line_that_is_shown_is_the_one_that_is_said(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    succeed("predict cloud.pcd --method bev --out labels --overwrite")
    lines = capsys.readouterr().out.splitlines()
    (printed,) = [line for line in lines if line.startswith("cloud.pcd")]
    (documented,) = re.findall(r"    (cloud\.pcd: .*)\n    (.*)\n", SCANS.text)

    # The measured height differs by some millimetres.
    heights = r"\d\.\d\d m over the ground \(moved by -\d\.\d\d m"
    assert re.sub(heights, "", printed) == re.sub(heights, "", " ".join(documented))


def test_the_table_of_formats_is_that_of_the_code() -> None:
    page = SCANS.text.partition("## Formats")[2]
    table = re.findall(r"(?:^\|.*\n)+", page, re.MULTILINE)[0]
    extras = {}
    for endings, _, needs in (row.strip("|").split(" | ") for row in table.splitlines()[2:]):
        for ending in re.findall(r"`([.\w]+)`", endings):
            extras[ending] = needs.strip("`[] ")
    expected = dict.fromkeys(ENDINGS, "")
    for ending in ENDINGS:
        if PACKAGES.get(ending):
            expected[ending] = "feather" if ending == ".feather" else "formats"
    assert {ending: extra for ending, extra in extras.items() if ending in ENDINGS} == expected
    assert extras[".gz"] == ""


def test_the_share_that_is_warned_about_is_that_of_the_weights() -> None:
    (percent,) = re.findall(r"above (\d+) % for `sim-hdl64e`", SCANS.text)
    weights = load("sim-hdl64e")
    usual = weights.usual_uncertain_at(weights.model.assertion.threshold)
    assert not Verdict(int(percent) / 100, usual).is_doubtful
    assert Verdict((int(percent) + 1) / 100, usual).is_doubtful


def test_the_names_of_sensors_are_those_that_are_known() -> None:
    pattern = r"(?s)which states the lasers and the field of view: (.*?)\.\s"
    assert re.findall(r"`([\w-]+)`", re.findall(pattern, SENSOR.text)[0]) == list(KNOWN_SENSORS)
