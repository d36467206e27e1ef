"""The commands of the documentation on training run, from the archives that are downloaded to the final table."""

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
ONCE = {name: {"epochs": 1} for name in ("rv", "bev", "head")}
SPLIT = {"rv": {"epochs": 1, "batch": 8}, "bev": {"epochs": 1, "batch": 2}, "head": {"epochs": 1}}


@pytest.fixture
def downloads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Archives of made-up streets as KITTI's and SemanticKITTI's are, a nuScenes set, and tiny recipes."""
    monkeypatch.chdir(tmp_path)
    streets = make_streets(tmp_path / "dataset", ("00", "08", *TEST), scans=2)
    for sequence in TEST:
        shutil.rmtree(streets / "sequences" / sequence / "labels")
    for kind in ("velodyne", "labels"):
        with ZipFile(f"data_odometry_{kind}.zip", "w") as archive:
            for path in sorted(streets.glob(f"sequences/*/{kind}/*")):
                archive.write(path, path.relative_to(tmp_path))
    shutil.rmtree(streets)
    shutil.copytree(GOLDEN / "nuscenes", tmp_path / "data/nuscenes")
    for name in recipe_names():
        write_recipe(tmp_path / f"{name}.tiny.yaml", name, training=SPLIT)
    write_recipe(tmp_path / "mine.yaml", training=ONCE)
    return tmp_path


def run(words: list[str], folder: Path) -> None:
    """One command of a page, with tiny recipes, the test's folder for /data, and two processes for eight."""
    words = [word.replace("/data/", f"{folder}/data/") for word in words]
    words = [
        f"{word}.tiny.yaml" if word in recipe_names() and "amvnet" in words else word
        for word in words
    ]
    if words[0] == "amvnet":
        assert run_cli(*words[1:]) == (0, ""), words
        return
    if words[0] == "torchrun":
        words = [
            sys.executable,
            "-m",
            "torch.distributed.run",
            *("2" if word == "8" else word for word in words[1:]),
        ]
        words = ["cpu" if word == "cuda" else word for word in words]
    else:
        words[0] = {"python": sys.executable}[words[0]]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", ["README.md", "docs/training.md"])
def test_the_commands_on_training_run(page: str, downloads: Path) -> None:
    commands = [words for words in commands_of(page) if any("/data/" in word for word in words)]
    assert len(commands) >= (8 if page == "docs/training.md" else 4)
    for words in commands:
        run(words, downloads)
    assert load(downloads / "runs/kitti").parts == ("range_net", "polar_net", "point_head")
    if page == "docs/training.md":
        assert (downloads / "entry.zip").stat().st_size
        assert "sequences/11/predictions/000000.label" in files(downloads / "entry")
        assert (downloads / "runs/kitti/figures/methods.md").is_file()
