"""The commands of the pages on training run, from the downloaded archives to the final table."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

from amvnet.config.recipes import recipe_names
from amvnet.weights.file import load, save

from fixtures.commands import commands_of, files, run_cli
from fixtures.scan_writers import write_pcd
from fixtures.tiny import (
    GOLDEN,
    fresh_weights,
    make_streets,
    write_recipe,
)

TEST = tuple(str(sequence) for sequence in range(11, 22))

# What makes a recipe short: of one process, and of two that share the batches.
ONE_EPOCH = {"rv": {"epochs": 1}, "bev": {"epochs": 1}, "head": {"epochs": 1}}
ONE_EPOCH_OF_TWO = {
    "rv": {"epochs": 1, "batch": 8},
    "bev": {"epochs": 1, "batch": 2},
    "head": {"epochs": 1},
}


@pytest.fixture
def downloads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Archives like KITTI's and SemanticKITTI's, a nuScenes dataset, and tiny recipes."""
    monkeypatch.chdir(tmp_path)
    _write_archives(tmp_path)
    shutil.copytree(GOLDEN / "nuscenes", tmp_path / "data/nuscenes")
    for name in recipe_names():
        write_recipe(tmp_path / f"{name}.tiny.yaml", name, training=ONE_EPOCH_OF_TWO)
    write_recipe(tmp_path / "mine.yaml", training=ONE_EPOCH)
    return tmp_path


def _write_archives(folder: Path) -> None:
    """Write the two archives of a dataset of streets; test sequences have no labels."""
    streets = make_streets(folder / "dataset", ("00", "08", *TEST), scans=2)
    for sequence in TEST:
        shutil.rmtree(streets / "sequences" / sequence / "labels")

    for kind in ("velodyne", "labels"):
        with ZipFile(folder / f"data_odometry_{kind}.zip", "w") as archive:
            for path in sorted(streets.glob(f"sequences/*/{kind}/*")):
                archive.write(path, path.relative_to(folder))
    shutil.rmtree(streets)


def run(words: list[str], folder: Path) -> None:
    """Run a command of a page, made small.

    The recipes are tiny, /data lies in the folder of the test, and torchrun starts two processes on
    the CPU instead of eight on GPUs.
    """
    smaller = {"8": "2", "cuda": "cpu"} if words[0] == "torchrun" else {}
    if "amvnet" in words:
        for name in recipe_names():
            smaller[name] = f"{name}.tiny.yaml"

    arguments = []
    for word in words[1:]:
        arguments.append(smaller.get(word, word).replace("/data/", f"{folder}/data/"))
    if words[0] == "amvnet":
        assert run_cli(*arguments) == (0, ""), words
        return

    command = {
        "python": [sys.executable],
        "torchrun": [sys.executable, "-m", "torch.distributed.run"],
    }[words[0]]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.run(
        [*command, *arguments], capture_output=True, text=True, check=False, env=environment
    )
    assert process.returncode == 0, process.stderr


@pytest.mark.full
def test_the_commands_on_training_run(downloads: Path) -> None:
    count = 0
    for words in commands_of("docs/training.md"):
        if "/data/" in " ".join(words):
            run(words, downloads)
            count += 1
    assert count >= 8

    assert load(downloads / "runs/kitti").parts == ("range_net", "polar_net", "point_head")
    assert (downloads / "entry.zip").stat().st_size
    assert "sequences/11/predictions/000000.label" in files(downloads / "entry")
    assert (downloads / "runs/kitti/figures/methods.csv").is_file()


def test_the_commands_on_fine_tuning_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_streets(tmp_path / "data/kitti/dataset", ("00", "08"))
    for sequence, site in (("00", "site_a"), ("08", "site_b")):
        scans = tmp_path / f"data/kitti/dataset/sequences/{sequence}/velodyne"
        (tmp_path / site / "clouds").mkdir(parents=True)
        for path in scans.glob("*.bin"):
            points = np.fromfile(path, np.float32).reshape(-1, 4)
            write_pcd(tmp_path / site / "clouds" / f"{path.stem}.pcd", points, "binary")
    page = (Path(__file__).parents[2] / "docs/finetuning.md").read_text(encoding="utf-8")
    (description,) = re.findall(r"```yaml\n(.*?)```", page, re.S)
    (tmp_path / "mine.yaml").write_text(description)
    save(fresh_weights(), tmp_path / "sim-hdl64e")
    write_recipe(tmp_path / "finetune.tiny.yaml", "finetune", training=ONE_EPOCH)

    commands = commands_of("docs/finetuning.md")
    assert len(commands) == 5
    for words in commands:
        run([word.replace("sim-hdl64e", "./sim-hdl64e") for word in words], tmp_path)
    for name in ("finetuned", "mine"):
        assert load(f"runs/{name}").parts == ("range_net", "polar_net", "point_head")

    # The classes are those of the initial weights, so the head stays as it is.
    trained = load("runs/mine").tensors
    for name, values in load("./sim-hdl64e").tensors.items():
        if name.startswith("point_head."):
            assert values.equal(trained[name]), name
