"""The commands of the pages on training run, from the downloaded archives to the final table."""

from __future__ import annotations

import shutil
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest

from amvnet.config.recipes import recipe_names
from amvnet.weights.file import load, save

from fixtures.commands import files
from fixtures.pages import Changes, DocsPage, run
from fixtures.scan_writers import write_pcd
from fixtures.tiny import GOLDEN, fresh_weights, make_streets, write_recipe

TRAINING = DocsPage("docs/training.md")
FINE_TUNING = DocsPage("docs/finetuning.md")
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
    scenes = tmp_path / "data/nuscenes/v1.0-mini/scene.json"
    text = scenes.read_text()
    assert "scene-0916" in text
    scenes.write_text(text.replace("scene-0916", "scene-0061"))  # to train on
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


@pytest.mark.full
def test_the_commands_on_training_run(downloads: Path) -> None:
    commands = [words for words in TRAINING.commands if "/data/" in " ".join(words)]
    assert len(commands) >= 8
    changes = Changes(
        words={name: f"{name}.tiny.yaml" for name in recipe_names()},
        texts={"/data/": f"{downloads}/data/"},
        values={"torchrun": {"--nproc-per-node": 2, "--training.workers": 2}},
    )
    run(commands, changes)

    assert load(downloads / "runs/kitti").parts == ("range_net", "polar_net", "point_head")
    assert (downloads / "entry.zip").stat().st_size
    assert "sequences/11/predictions/000000.label" in files(downloads / "entry")
    assert (downloads / "runs/kitti/figures/methods.csv").is_file()


@pytest.mark.full
def test_the_commands_on_fine_tuning_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make_streets(tmp_path / "data/kitti/dataset", ("00", "08"))
    for sequence, site in (("00", "site_a"), ("08", "site_b")):
        scans = tmp_path / f"data/kitti/dataset/sequences/{sequence}/velodyne"
        (tmp_path / site / "clouds").mkdir(parents=True)
        for path in scans.glob("*.bin"):
            points = np.fromfile(path, np.float32).reshape(-1, 4)
            write_pcd(tmp_path / site / "clouds" / f"{path.stem}.pcd", points, "binary")
    (description,) = FINE_TUNING.blocks("yaml")
    (tmp_path / "mine.yaml").write_text(description)
    save(fresh_weights(), tmp_path / "init.safetensors")
    recipe = write_recipe(tmp_path / "tiny.yaml", "finetune", training=ONE_EPOCH)

    assert len(FINE_TUNING.commands) == 5
    changes = Changes(
        words={"finetune": str(recipe), "sim-hdl64e": "init.safetensors"},
        texts={"/data/": f"{tmp_path}/data/"},
    )
    run(FINE_TUNING.commands, changes)
    for name in ("finetuned", "mine"):
        assert load(f"runs/{name}").parts == ("range_net", "polar_net", "point_head")

    # The classes are those of the initial weights, so the head stays as it is.
    trained = load("runs/mine").tensors
    for name, values in load("init.safetensors").tensors.items():
        if name.startswith("point_head."):
            assert values.equal(trained[name]), name
