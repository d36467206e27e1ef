"""The commands of the pages on training run, from the downloaded archives to the final table."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

from amvnet.config.recipes import recipe_names
from amvnet.weights.file import load

from fixtures.worlds import GOLDEN, commands_of, files, make_streets, run_cli, write_recipe

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
    words = [word.replace("/data/", f"{folder}/data/") for word in words]
    if "amvnet" in words:
        words = [f"{word}.tiny.yaml" if word in recipe_names() else word for word in words]

    program, *rest = words
    if program == "amvnet":
        assert run_cli(*rest) == (0, ""), words
        return
    if program == "torchrun":
        smaller = {"8": "2", "cuda": "cpu"}
        rest = ["-m", "torch.distributed.run", *(smaller.get(word, word) for word in rest)]
    else:
        assert program == "python", words

    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    process = subprocess.run(
        [sys.executable, *rest], capture_output=True, text=True, check=False, env=environment
    )
    assert process.returncode == 0, process.stderr


@pytest.mark.parametrize(("page", "least"), [("README.md", 4), ("docs/training.md", 8)])
def test_the_commands_on_training_run(page: str, least: int, downloads: Path) -> None:
    commands = [words for words in commands_of(page) if "/data/" in " ".join(words)]
    assert len(commands) >= least
    for words in commands:
        run(words, downloads)

    assert load(downloads / "runs/kitti").parts == ("range_net", "polar_net", "point_head")
    if page == "docs/training.md":
        assert (downloads / "entry.zip").stat().st_size
        assert "sequences/11/predictions/000000.label" in files(downloads / "entry")
        assert (downloads / "runs/kitti/figures/methods.md").is_file()
