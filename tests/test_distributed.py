"""Several processes, as torchrun and SLURM start them, train, predict and score as one does."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from amvnet.distributed import Processes
from amvnet.training.loaders import EpochSampler
from amvnet.training.sync_batch_norm import SyncedBatchNorm, synchronise_batch_norms
from amvnet.weights.file import Weights, load, save

from fixtures.worlds import files, make_streets, run_cli, without, write_recipe

# DropBlock draws for each process anew, and so as no single process does. In double precision, as AdamW divides each
# gradient by its size, so that of one that is next to nothing the rounding decides.
STILL = {"polar_net": {"dropblock": 0.0}}
TRAINING = {
    "rv": {"batch": 4},
    "bev": {"batch": 4},
    "head": {"points": 800, "batch": 64, "class_weights": True},
    "precision": "64-true",
}


def torchrun(*arguments: object, count: int = 2) -> subprocess.CompletedProcess[str]:
    """The command line on some processes of this machine."""
    launcher = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        str(count),
    ]
    command = [*launcher, "-m", "amvnet", *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment)


def largest_difference(a: Weights, b: Weights) -> float:
    assert set(a.tensors) == set(b.tensors)
    return max(
        float((a.tensors[k].double() - b.tensors[k].double()).abs().max()) for k in a.tensors
    )


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Streets, a recipe, and a run of one process."""
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data", scans=4)
    write_recipe(root / "recipe.yaml", model=STILL, training=TRAINING)
    assert run_cli(
        "train", root / "recipe.yaml", "--data", root / "data", "--out", root / "run"
    ) == (0, "")
    save(without(load(root / "run"), "point_head"), root / "networks.safetensors")
    return root


def arguments_of(world: Path, out: Path, stage: str) -> list[object]:
    init = ["--init", world / "networks.safetensors"] if stage == "head" else []
    return [
        "train",
        world / "recipe.yaml",
        "--data",
        world / "data",
        "--out",
        out,
        "--stage",
        stage,
        *init,
    ]


@pytest.mark.parametrize("stage", ["rv", "bev", "head"])
def test_two_processes_train_the_weights_of_one(world: Path, tmp_path: Path, stage: str) -> None:
    done = torchrun(*arguments_of(world, tmp_path / "two", stage))
    assert done.returncode == 0, done.stderr
    found, expected = (
        load(run / stage / "last.safetensors") for run in (tmp_path / "two", world / "run")
    )
    assert largest_difference(found, expected) < 1e-5
    part = found.parts[0]
    assert found.metrics[part] == pytest.approx(expected.metrics[part])
    assert done.stdout.count("epoch 2/") == 1  # one of them speaks


def test_processes_that_slurm_has_started_find_each_other(world: Path, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    job = {"SLURM_JOB_ID": "4711", "SLURM_JOB_NAME": "amvnet", "SLURM_NTASKS": "2", "SLURM_NTASKS_PER_NODE": "2",
           "SLURM_NNODES": "1", "SLURM_NODEID": "0", "SLURM_NODELIST": "127.0.0.1", "SLURM_STEP_ID": "0",
           "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1"}  # fmt: skip
    command = [
        sys.executable,
        "-m",
        "amvnet",
        *map(str, arguments_of(world, tmp_path / "two", "rv")),
    ]
    ranks = [
        {**os.environ, **job, "SLURM_PROCID": str(rank), "SLURM_LOCALID": str(rank)}
        for rank in range(2)
    ]
    started = [
        subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for env in ranks
    ]
    said = [process.communicate()[0].decode() for process in started]
    assert [process.returncode for process in started] == [0, 0], said
    found, expected = (
        load(run / "rv/last.safetensors") for run in (tmp_path / "two", world / "run")
    )
    assert largest_difference(found, expected) < 1e-5
    assert said[1] == ""


def test_processes_share_the_scans_of_predict_and_evaluate(world: Path, tmp_path: Path) -> None:
    for name, run in (
        ("one", lambda *a: run_cli(*a)[0]),
        ("two", lambda *a: torchrun(*a).returncode),
    ):
        out = tmp_path / name
        weights = ("--weights", world / "run")
        assert (
            run(
                "predict",
                world / "data",
                *weights,
                "--out",
                out / "labels",
                "--scores",
                "--sequences",
                "00,08",
            )
            == 0
        )
        options = ("--split", "all", "--json", out / "all.json", "--pictures", out / "pictures")
        assert run("evaluate", world / "data", *weights, *options) == 0
    assert files(tmp_path / "one") == files(tmp_path / "two")
    assert len(files(tmp_path / "one/labels")) == 16
    for name in files(tmp_path / "one"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes(), (
            name
        )


@pytest.mark.parametrize(
    ("verb", "options"), [("train", ("--training.rv.batch", 3)), ("analyze", ())]
)
def test_what_cannot_be_shared_is_refused_in_one_line(
    world: Path, tmp_path: Path, verb: str, options: tuple[object, ...]
) -> None:
    first = (
        [verb, world / "recipe.yaml"]
        if verb == "train"
        else [verb, "--weights", world / "run", world / "data"]
    )
    data = ["--data", world / "data"] if verb == "train" else []
    done = torchrun(*first, *data, "--out", tmp_path / "out", *options)
    assert done.returncode != 0
    lines = [line for line in done.stderr.splitlines() if line.startswith("amvnet: ")]
    assert len(set(lines)) == 1, done.stderr
    assert "processes" in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("size", "count"), [(10, 2), (11, 2), (7, 3), (2, 4)])
def test_the_parts_of_a_batch_are_those_of_one_process(size: int, count: int) -> None:
    """However many scans there are, all processes have as many, and together take what one alone takes."""
    alone = list(EpochSampler(size, 3, True))
    parts = [list(EpochSampler(size, 3, True, Processes(rank, count))) for rank in range(count)]
    assert len({len(part) for part in parts}) == 1
    together = [key for turn in zip(*parts, strict=True) for key in turn]
    assert together[:size] == alone
    assert set(together[size:]) <= set(alone)
    assert len(together) - size < count
    validated = [
        key for rank in range(count) for key in EpochSampler(size, 3, False, Processes(rank, count))
    ]
    assert sorted(validated) == [(0, place) for place in range(size)]


def _norms_of_a_process(rank: int, port: int, folder: str) -> None:
    torch.distributed.init_process_group("gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    x = torch.load(f"{folder}/x.pt", weights_only=True)
    mine = (x[:3] if rank == 0 else x[3:]).clone().requires_grad_()
    norm = synchronise_batch_norms(_norm(), cuda=False)
    (norm(mine) ** 3).sum().backward()
    torch.save({"x": mine.grad, **norm.state_dict()}, f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


def _norm() -> nn.Sequential:
    norm = nn.BatchNorm2d(4, dtype=torch.float64)
    with torch.no_grad():
        norm.weight.copy_(torch.arange(1.0, 5))
        norm.bias.copy_(torch.arange(4.0))
    return nn.Sequential(norm)


def test_a_synced_batch_norm_is_that_of_the_whole_batch(tmp_path: Path) -> None:
    """Of unequal parts: outputs' gradients and running statistics are those of torch's own over all."""
    x = (
        torch.randn(5, 4, 6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 3
        + 100
    )
    torch.save(x, tmp_path / "x.pt")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.spawn(_norms_of_a_process, (port, str(tmp_path)), nprocs=2)
    whole, norm = x.clone().requires_grad_(), _norm()
    (norm(whole) ** 3).sum().backward()
    parts = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2)]
    assert torch.allclose(torch.cat([p["x"] for p in parts]), whole.grad, rtol=1e-9, atol=1e-9)
    for name, value in norm.state_dict().items():
        for part in parts:
            assert torch.allclose(part[name].double(), value.double(), rtol=1e-9), name


def test_a_synced_batch_norm_is_used_as_the_one_it_stands_for() -> None:
    net, x = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4)), torch.randn(8, 3)
    net(x)
    expected = net.eval()(x)
    copied = synchronise_batch_norms(net, cuda=False)
    assert isinstance(copied[1], SyncedBatchNorm)
    assert torch.equal(copied.eval()(x), expected)
    assert np.all([k in copied.state_dict() for k in ("1.weight", "1.running_mean")])
