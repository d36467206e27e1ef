"""Several processes, started by torchrun or SLURM, train and evaluate like one."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.runtime.distributed import Processes
from amvnet.sensors.expectation import Expectation
from amvnet.training.loaders import EpochSampler, ScanSet, make_loader
from amvnet.training.sync_batch_norm import SyncedBatchNorm, synchronise_batch_norms
from amvnet.weights.file import Weights, load

from fixtures.commands import files, not_none, run_cli
from fixtures.marks import with_full
from fixtures.processes import Printed, become_cli, fork_server, start_cli
from fixtures.tiny import write_recipe

# No DropBlock, as each process draws its own blocks. Double precision, as AdamW divides each
# gradient by its size, which turns the rounding of a tiny gradient into a full step.
MODEL = {"polar_net": {"dropblock": 0.0}}
TRAINING = {
    "rv": {"batch": 4},
    "bev": {"batch": 4},
    "head": {"points": 800, "batch": 64},
    "precision": "64-true",
}


def output_of_torchrun(folder: Path, *arguments: object) -> str:
    """Run the command line in two processes; return what they print."""
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command = [sys.executable, *launcher, "-m", "amvnet", *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


def output_of_launch(folder: Path, *arguments: object) -> str:
    """Run the command line in two processes by the function that torchrun calls.

    The processes have imported torch already, which saves ten seconds. torchrun would end with
    them, but this process goes on, with its own handlers of signals.
    """
    fork_server()
    handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=2,
        run_id=folder.name,
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=0,
        start_method="forkserver",
    )
    try:
        elastic_launch(config, _become_rank)(list(map(str, arguments)), folder)
    finally:
        for number, handler in handlers.items():
            if signal.getsignal(number) != handler:
                signal.signal(number, handler)
    return "".join(printed_by(rank, folder).text for rank in range(2))


def _become_rank(words: list[str], folder: Path) -> None:
    become_cli(words, printed_by(int(os.environ["RANK"]), folder))


def printed_by(rank: int, folder: Path) -> Printed:
    return Printed(folder / f"printed by {rank}")


def slurm(folder: Path, *arguments: object) -> list[tuple[int | None, str]]:
    """Run the command line in two processes as srun does; return exit codes and what is printed."""
    job = {
        "SLURM_JOB_ID": "4711",
        "SLURM_JOB_NAME": "amvnet",
        "SLURM_NTASKS": "2",
        "SLURM_NTASKS_PER_NODE": "2",
        "SLURM_NNODES": "1",
        "SLURM_NODEID": "0",
        "SLURM_NODELIST": "127.0.0.1",
        "SLURM_STEP_ID": "0",
        "MASTER_PORT": str(free_port()),
        "OMP_NUM_THREADS": "1",
    }
    words = list(map(str, arguments))
    processes = []
    for rank in range(2):
        ranks = {"SLURM_PROCID": str(rank), "SLURM_LOCALID": str(rank)}
        processes.append(start_cli(words, printed_by(rank, folder), os.environ | job | ranks))
    for process in processes:
        process.join()
    return [
        (process.exitcode, printed_by(rank, folder).text) for rank, process in enumerate(processes)
    ]


def output_of_srun(folder: Path, *arguments: object) -> str:
    """Run the command line in two processes; return what the first prints, and alone prints."""
    results = slurm(folder, *arguments)
    assert [code for code, _ in results] == [0, 0], results
    assert results[1][1] == ""
    return results[0][1]


def largest_difference(a: Weights, b: Weights) -> float:
    assert set(a.tensors) == set(b.tensors)
    largest = 0.0
    for name, tensor in a.tensors.items():
        largest = max(largest, float((tensor.double() - b.tensors[name].double()).abs().max()))
    return largest


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def train_arguments(world: Path, out: Path, stage: str) -> list[object]:
    out.mkdir()
    recipe = write_recipe(out / "tiny.yaml", model=MODEL, training=TRAINING)
    arguments = ["train", recipe, "--data", world / "data", "--out", out / "run", "--stage", stage]
    if stage == "head":
        arguments += ["--init", world / "headless.safetensors"]
    return arguments


@pytest.mark.full
@pytest.mark.parametrize(
    ("stage", "launcher"), [("rv", "launch"), ("bev", "torchrun"), ("head", "srun"), ("rv", "srun")]
)
def test_two_processes_train_as_one(world: Path, tmp_path: Path, stage: str, launcher: str) -> None:
    launchers = {"launch": output_of_launch, "torchrun": output_of_torchrun, "srun": output_of_srun}
    printed = launchers[launcher](tmp_path, *train_arguments(world, tmp_path / "two", stage))
    assert printed.count("epoch 2/") == 1  # only one of them prints

    assert run_cli(*train_arguments(world, tmp_path / "one", stage)) == (0, "")

    weights = load(tmp_path / "two/run" / stage / "last.safetensors")
    expected = load(tmp_path / "one/run" / stage / "last.safetensors")
    assert largest_difference(weights, expected) < 1e-5
    part = weights.parts[0]
    assert weights.metrics[part] == pytest.approx(expected.metrics[part])


@pytest.mark.parametrize("draws", with_full([False, True], [True]))
def test_processes_share_the_scans_of_evaluate(world: Path, tmp_path: Path, draws: bool) -> None:
    data = world / "data"
    weights = ["--weights", world / "w.safetensors"]
    for name in ("one", "two"):
        out = tmp_path / name
        written = ["--json", out / "all.json"]
        if draws:
            written += ["--pictures", out / "pictures"]
        arguments = ["evaluate", data, *weights, "--sequences", "08", *written]
        if name == "one":
            assert run_cli(*arguments) == (0, "")
        else:
            output_of_srun(tmp_path, *arguments)

    names = files(tmp_path / "one")
    assert files(tmp_path / "two") == names
    for name in names:
        contents = (tmp_path / "one" / name).read_bytes()
        assert (tmp_path / "two" / name).read_bytes() == contents, name


@pytest.mark.parametrize("command", ["train", "analyze"])
def test_work_that_cannot_be_shared_is_refused(world: Path, tmp_path: Path, command: str) -> None:
    data = world / "data"
    arguments = {
        "train": [world / "recipe.yaml", "--data", data, "--training.rv.batch", 3],
        "analyze": [data, "--weights", world / "w.safetensors"],
    }
    results = slurm(tmp_path, command, *arguments[command], "--out", tmp_path / "out")
    assert [code for code, _ in results] == [2, 2], results

    lines = [
        line for _, text in results for line in text.splitlines() if line.startswith("amvnet: ")
    ]
    assert len(set(lines)) == 1, results
    assert "processes" in lines[0]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("size", "count"), [(10, 2), (11, 2), (7, 3), (2, 4)])
def test_the_parts_of_the_processes_make_up_those_of_one_process(size: int, count: int) -> None:
    """All processes draw equally many scans, however many there are; only the first repeat."""
    alone = list(EpochSampler(size, 3))
    parts = [list(EpochSampler(size, 3, processes=Processes(rank, count))) for rank in range(count)]
    assert len({len(part) for part in parts}) == 1

    together: list[tuple[int, int]] = []
    for turn in zip(*parts, strict=True):
        together += turn
    assert together[:size] == alone
    assert set(together[size:]) <= set(alone)
    assert len(together) - size < count


@pytest.mark.parametrize(("size", "count"), [(10, 2), (11, 2), (7, 3), (2, 4)])
def test_processes_validate_every_scan_once(size: int, count: int) -> None:
    dataset: Any = SimpleNamespace(taxonomy=SEMANTICKITTI)
    records: Any = [SimpleNamespace(name=index) for index in range(size)]
    scans = ScanSet(TrainingData([Source(dataset, records)]), Expectation())
    keys: list[tuple[int, int]] = []
    for rank in range(count):
        keys += make_loader(scans, 1, 0, shuffle=False, processes=Processes(rank, count)).sampler
    assert sorted(keys) == [(0, index) for index in range(size)]


def test_a_synced_batch_norm_is_that_of_the_whole_batch(tmp_path: Path) -> None:
    """With unequal parts, gradients and running statistics are those of PyTorch's batch norm."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(5, 4, 6, 7, dtype=torch.float64, generator=generator) * 3 + 100
    torch.save(x, tmp_path / "x.pt")
    arguments = (free_port(), tmp_path)
    fork_server()
    torch.multiprocessing.start_processes(
        _train_batch_norm, arguments, nprocs=2, start_method="forkserver"
    )

    whole = x.clone().requires_grad_()
    norm = _batch_norm()
    (norm(whole) ** 3).sum().backward()

    parts = [torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2)]
    gradient = torch.cat([part.pop("x") for part in parts])
    assert torch.allclose(gradient, not_none(whole.grad), rtol=1e-9, atol=1e-9)
    for part in parts:
        for name, value in norm.state_dict().items():
            assert torch.allclose(part[name].double(), value.double(), rtol=1e-9), name


def _train_batch_norm(rank: int, port: int, folder: Path) -> None:
    """Run a batch norm on this process's part of x.pt; save the gradient and the norm's state."""
    torch.distributed.init_process_group("gloo", f"tcp://127.0.0.1:{port}", rank=rank, world_size=2)
    x = torch.load(folder / "x.pt", weights_only=True)
    part = (x[:3] if rank == 0 else x[3:]).clone().requires_grad_()
    norm = synchronise_batch_norms(_batch_norm(), cuda=False)
    (norm(part) ** 3).sum().backward()

    torch.save({"x": part.grad, **norm.state_dict()}, folder / f"{rank}.pt")
    torch.distributed.destroy_process_group()


def _batch_norm() -> nn.Sequential:
    norm = nn.BatchNorm2d(4, dtype=torch.float64)
    with torch.no_grad():
        norm.weight.copy_(torch.arange(1.0, 5))
        norm.bias.copy_(torch.arange(4.0))
    return nn.Sequential(norm)


def test_a_synced_batch_norm_evaluates_like_the_one_it_replaces() -> None:
    net = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4))
    x = torch.randn(8, 3)
    net(x)
    expected = net.eval()(x)

    synced = synchronise_batch_norms(net, cuda=False)
    assert isinstance(synced, nn.Sequential)
    assert isinstance(synced[1], SyncedBatchNorm)
    assert torch.equal(synced.eval()(x), expected)
    assert {"1.weight", "1.running_mean"} <= set(synced.state_dict())


def test_the_death_of_another_process_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is an error of the system, which the command line prints without a traceback."""

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("Connection closed by peer")

    monkeypatch.setattr(torch.distributed, "all_gather_object", fail)
    with pytest.raises(OSError, match="another process ended") as caught:
        Processes(rank=0, size=2).wait()
    assert "\n" not in f"{caught.value.filename} {caught.value.strerror}"
