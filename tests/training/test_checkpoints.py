"""Checkpoints are whole, and a stage is trained by one call at a time."""

from __future__ import annotations

import errno
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest
import torch

from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.files import alone_in
from amvnet.scan import Scan
from amvnet.training.stage import WholeCheckpoints

from fixtures.commands import contents, files, refused, succeed
from fixtures.tiny import make_streets, write_recipe


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with `data`, `recipe.yaml`, and `run`, which has trained both networks."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    epochs = {"rv": {"epochs": 1}, "bev": {"epochs": 1}}
    write_recipe(root / "recipe.yaml", training=epochs, stages=["rv", "bev"])
    succeed(command(root, root / "run"))
    return root


def command(world: Path, out: Path, options: str = "") -> str:
    return f"train {world}/recipe.yaml --data {world}/data --out {out} {options}"


def test_a_checkpoint_is_replaced_only_by_a_whole_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "last.ckpt"
    WholeCheckpoints().save_checkpoint({"epoch": 0}, path)
    write_bytes = Path.write_bytes

    def write_half(self: Path, content: Any) -> int:
        write_bytes(self, bytes(content)[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", write_half)
    with pytest.raises(OSError, match="No space") as caught:
        WholeCheckpoints().save_checkpoint({"epoch": 1}, path)
    assert (caught.value.filename, caught.value.strerror) == (str(path), "No space left on device")
    assert torch.load(path, weights_only=True) == {"epoch": 0}
    assert os.listdir(tmp_path) == ["last.ckpt"]


@pytest.mark.full
def test_a_training_writes_nothing_into_the_temporary_folder_of_the_system(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That folder may be on another file system, or full."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "missing"))
    succeed(command(world, tmp_path / "run", "--stage rv"))


@pytest.mark.parametrize("stage", ["rv", pytest.param("all", marks=pytest.mark.full)])
def test_a_stage_is_trained_by_one_call_at_a_time(world: Path, tmp_path: Path, stage: str) -> None:
    """A second call for the stage changes nothing; meanwhile, the other network can be trained."""
    out = tmp_path / "run"
    succeed(command(world, out, "--stage bev"))
    with alone_in(out, ".rv.lock"):  # as a call that trains the range view has it
        before = contents(out)
        options = f"--stage {stage} --resume --training.seed 2 --training.bev.epochs 1"
        refused(command(world, out, options), "another run")
        assert contents(out) == before
        succeed(command(world, out, "--stage bev --resume"))
    succeed(command(world, out, "--resume"))
    assert not [name for name in files(out) if "lock" in name]


def test_a_run_does_not_write_into_a_dataset(world: Path, tmp_path: Path) -> None:
    shutil.copytree(world / "data", tmp_path / "data")
    before = files(tmp_path)
    refused(command(world, tmp_path / "data"), f"{tmp_path}/data: expected a new folder")
    assert files(tmp_path) == before


@pytest.mark.skipif(sys.platform != "linux", reason="only forked processes have the patch")
def test_a_killed_process_that_reads_scans_is_one_line(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = SemanticKitti.read

    def read_or_die(*arguments: Any, **options: Any) -> Scan:
        if multiprocessing.parent_process() is not None:
            os.kill(os.getpid(), signal.SIGKILL)
        return read(*arguments, **options)

    monkeypatch.setattr(SemanticKitti, "read", read_or_die)
    train = command(world, tmp_path / "run", "--stage rv --training.workers 1")
    refused(train, "training.workers", "killed")


def test_a_run_that_cannot_begin_leaves_no_folder(world: Path, tmp_path: Path) -> None:
    shutil.copytree(world / "data", tmp_path / "data")
    (tmp_path / "data/sequences/00/labels/000000.label").write_bytes(b"1234")
    train = f"train {world}/recipe.yaml --data {tmp_path}/data --out {tmp_path}/run"
    refused(train, "000000.label")
    assert not (tmp_path / "run").exists()


@pytest.mark.full
def test_resume_removes_what_killed_runs_left_half_written(world: Path, tmp_path: Path) -> None:
    out = shutil.copytree(world / "run", tmp_path / "run")
    part = f".{32 * '0'}.part"  # begins the names that `atomic_write` gives
    for name in (f"{part}.yaml", f"rv/{part}.ckpt", f"bev/{part}.safetensors", "rv/.my.part"):
        (out / name).write_bytes(b"half")

    # The other network may be trained by another call, which has not finished its files.
    succeed(command(world, out, "--resume --stage rv"))
    assert not (out / f"rv/{part}.ckpt").exists()
    assert (out / f"bev/{part}.safetensors").exists()
    succeed(command(world, out, "--resume"))
    assert files(out) == files(world / "run") | {"rv/.my.part"}


def test_truncated_weights_of_a_finished_run_are_made_again(world: Path, tmp_path: Path) -> None:
    out = shutil.copytree(world / "run", tmp_path / "run")
    path = out / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    succeed(command(world, out, "--resume"))
    assert path.read_bytes() == (world / "run/weights.safetensors").read_bytes()
