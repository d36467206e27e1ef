"""Training by the command line: its files, learning, repeating, resuming and splitting of scans."""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import PARTS
from amvnet.data.datasets import simulated
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.data.taxonomy import SEMANTICKITTI
from amvnet.scan import Scan
from amvnet.sensors.intensity import PROBABILITIES, SIMULATED_QUANTILES, TrainedIntensity
from amvnet.training import loaders, networks
from amvnet.training import run as training_run
from amvnet.training.callbacks import KeepWeights, SeedBatches
from amvnet.training.checking import check_data
from amvnet.training.curves import Curves, draw_curves, read_curves
from amvnet.training.head_points import PointGatherer
from amvnet.training.networks import NetworkStage, train_network
from amvnet.training.plan import Plan
from amvnet.weights.file import Weights, load, save

from fixtures import tiny
from fixtures.commands import contents, files, not_none, refusal, refused, run_cli, succeed
from fixtures.processes import Printed, become_cli, fork_server, start_cli
from fixtures.tiny import CAR, fresh_weights, make_streets, with_intensities, without, write_recipe

NO_AUGMENTATION = [f"--training.augment.{name}=0" for name in ("yaw", "scale", "flip")]
PART_OF = {"rv": "range_net", "bev": "polar_net", "head": "point_head"}
STAGES = pytest.mark.parametrize("stage", PART_OF)


def train(world: Path, out: Path, *options: object) -> Weights:
    arguments = train_arguments(world, out)
    if "--data" in options:
        del arguments[2:4]
    succeed(*arguments, *options)
    return load(out / "weights.safetensors")


def train_arguments(world: Path, out: Path) -> list[object]:
    return ["train", world / "recipe.yaml", "--data", world / "data", "--out", out]


def differing(a: Weights, b: Weights) -> set[str]:
    """Return the names of the parts that are not bitwise equal."""
    assert set(a.tensors) == set(b.tensors)
    parts = set()
    for name, tensor in a.tensors.items():
        if not torch.equal(tensor, b.tensors[name]):
            parts.add(name.split(".")[0])
    return parts


def scored(world: Path, folder: Path, weights: Path, *options: object) -> dict[str, Any]:
    """Return the figures of `evaluate`, which writes them into a folder."""
    figures = folder / "figures.json"
    succeed("evaluate", world / "data", "--weights", weights, "--json", figures, *options)
    return dict(json.loads(figures.read_text()))


def column(run: Path, stage: str, name: str) -> list[float]:
    """Return the values of a metric of a stage by epoch, or of the loss by step."""
    events = EventAccumulator(str(run / stage))
    events.Reload()
    if name not in events.Tags()["scalars"]:
        return []
    # A resumed run repeats the steps after its checkpoint.
    values = {event.step: event.value for event in events.Scalars(name)}
    return [values[step] for step in sorted(values)]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("world")
    make_streets(root / "data")
    write_recipe(root / "recipe.yaml")
    return root


@pytest.fixture(scope="module")
def run(world: Path) -> Path:
    train(world, world / "run")
    return world / "run"


@STAGES
def test_a_stage_writes_its_curves_and_weights_of_the_highest_miou(run: Path, stage: str) -> None:
    names = files(run / stage)
    assert {"best.safetensors", "last.safetensors"} <= names
    assert any(name.startswith("events.out.tfevents") for name in names)
    values = column(run, stage, "val/miou")
    assert len(values) == (2 if stage == "head" else 3)
    metrics = load(run / stage / "best.safetensors").metrics[PART_OF[stage]]
    assert metrics["epoch"] == int(np.argmax(values))
    assert metrics["val/miou"] == pytest.approx(max(values), abs=1e-6)


def test_an_earlier_run_is_refused_before_the_data_are_read(run: Path) -> None:
    before = (run / "recipe.yaml").read_bytes()
    error = refusal("train", "semantickitti-compact", "--data", run / "missing.yaml", "--out", run)
    assert "expected no earlier run" in error
    assert (run / "recipe.yaml").read_bytes() == before


@STAGES
def test_the_picture_of_a_run_shows_what_it_logged(run: Path, stage: str) -> None:
    epochs = 2 if stage == "head" else 3
    curves = read_curves(run / stage, SEMANTICKITTI)
    assert curves.miou == column(run, stage, "val/miou")
    assert [value for _, value in curves.loss] == column(run, stage, "train/loss")
    logged = [epoch for epoch, _ in curves.loss]
    assert 0 < logged[0] <= 1
    assert logged == sorted(logged)
    assert epochs - 1 < logged[-1] <= epochs
    metrics = load(run / stage / "last.safetensors").metrics[PART_OF[stage]]
    assert sum(curves.iou.values()) / 19 == pytest.approx(metrics["val/miou"], abs=1e-5)
    assert (run / "curves.png").read_bytes().startswith(b"\x89PNG")


def test_names_of_classes_are_no_formulas(tmp_path: Path) -> None:
    curves = Curves([(1.0, 0.5)], [0.5], {"$a_b$": 0.5, "$": 0.2})
    assert draw_curves({"rv": curves}, tmp_path / "curves.png").is_file()


def test_the_class_counts_of_a_run_are_those_of_its_training_scans(world: Path, run: Path) -> None:
    with np.load(run / "class_counts.npz") as file:
        counts = file["counts"]
        assert file["scans"].tolist() == ["00/000000", "00/000001", "01/000000", "01/000001"]

    paths = [*world.glob("data/sequences/00/labels/*"), *world.glob("data/sequences/01/labels/*")]
    raw_labels = np.concatenate([np.fromfile(path, np.uint32) for path in paths])
    raw_ids = {0: CAR, 8: tiny.ROAD, 10: tiny.SIDEWALK, 12: tiny.BUILDING}  # by index of the class
    for index, count in enumerate(counts):
        assert count == np.count_nonzero(raw_labels == raw_ids.get(index, -1))


def test_the_check_reports_ten_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amvnet.progress.QUIET_SECONDS", 0)
    dataset = open_dataset(str(make_streets(tmp_path / "data", ("00", "08"), 23)))
    data = TrainingData([Source(dataset, dataset.records(["00"]))])
    lines: list[str] = []
    plan = Plan(load_recipe("semantickitti-compact"), data, tmp_path / "run", report=lines.append)
    check_data(plan)
    checked = [line.partition(": checked")[2] for line in lines if ": checked" in line]
    assert len(checked) == 10
    assert checked[-1] == " 23 of 23 scans"


def test_an_epoch_without_a_labelled_point_is_an_error_and_writes_no_weights(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = itertools.count()

    def ignore(scan: Scan, first: int) -> Scan:
        is_empty = next(drawn) >= first
        return replace(scan, labels=np.zeros_like(scan.labels)) if is_empty else scan

    options = ("--stage", "rv", "--training.rv.epochs", 1, "--training.rv.batch", 1)
    monkeypatch.setattr(loaders, "augment", lambda scan, *_: ignore(scan, 0))
    refused((*train_arguments(world, tmp_path / "none"), *options), "none in 4 batches")
    kept = (".safetensors", ".ckpt")
    assert not {name for name in files(tmp_path / "none") if name.endswith(kept)}

    drawn = itertools.count()
    monkeypatch.setattr(loaders, "augment", lambda scan, *_: ignore(scan, 3))
    train(world, tmp_path / "some", *options)
    assert "1 of 4 batches had no labelled point" in capsys.readouterr().out


def test_the_weights_describe_their_training(run: Path) -> None:
    weights = load(run / "weights.safetensors")
    for part in PARTS:
        training = weights.training[part]
        assert (training["sequences"], training["validated_on"]) == (["00", "01"], ["08"])
        assert training["seed"] == 0
    assert weights.training["range_net"]["rv"]["epochs"] == 3
    assert weights.model.range_view.width == 64
    assert weights.expects.as_is
    assert not_none(weights.expects.intensity).are_fractions


def test_values_on_the_command_line_override_the_recipe(world: Path, tmp_path: Path) -> None:
    epochs = ("--training.rv.epochs", 1)
    decoder = ("--model.range_net.decoder", 24)
    seed = ("--training.seed", 7)
    weights = train(world, tmp_path / "run", "--stage", "rv", *epochs, *decoder, *seed)

    training = weights.training["range_net"]
    assert (training["rv"]["epochs"], training["seed"], training["rv"]["lr"]) == (1, 7, 0.02)
    assert (weights.model.range_net.decoder, weights.parts) == (24, ("range_net",))
    recipe = yaml.safe_load((tmp_path / "run/recipe.yaml").read_text())
    assert recipe["training"]["rv"]["epochs"] == 1


def test_a_decoder_of_own_channels_is_trained_and_labels(world: Path, tmp_path: Path) -> None:
    options = ("--model.polar_net.decoder", "[12]", "--model.polar_net.input_norm", "true")
    weights = train(world, tmp_path / "run", "--stage", "bev", *options)
    assert weights.model.polar_net.decoder == (12,)
    assert weights.tensors["polar_net.norm.running_mean"].any()
    assert weights.tensors["polar_net.scores.weight"].shape[1] == 12

    succeed("predict", world / "data", "--weights", tmp_path / "run", "--out", tmp_path / "labels")


@pytest.mark.parametrize("stage", [pytest.param("rv", marks=pytest.mark.full), "bev"])
def test_a_network_learns_a_tiny_dataset_by_heart(world: Path, tmp_path: Path, stage: str) -> None:
    epochs = (f"--training.{stage}.epochs", 20)
    train(world, tmp_path / "run", "--stage", stage, *epochs, *NO_AUGMENTATION)
    losses = column(tmp_path / "run", stage, "train/loss")
    assert losses[-1] < 0.5 * losses[0]
    assert max(column(tmp_path / "run", stage, "val/acc")) > 0.6


@pytest.mark.full
def test_another_seed_gives_other_weights(world: Path, run: Path, tmp_path: Path) -> None:
    weights = train(world, tmp_path / "other", "--training.seed", 1)
    assert differing(weights, load(run)) == set(PARTS)


def train_interrupted(stage: str, epoch: int, world: Path, out: Path, *options: object) -> None:
    """Stop a run after the validation of an epoch of a stage, before its weights are written."""
    on_train_epoch_end = KeepWeights.on_train_epoch_end

    def stop(self: KeepWeights, trainer: Any, module: Any) -> None:
        if self.folder.path.name == stage and trainer.current_epoch == epoch:
            raise RuntimeError("the power is gone")
        on_train_epoch_end(self, trainer, module)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(KeepWeights, "on_train_epoch_end", stop)
        with pytest.raises(RuntimeError, match="power"):
            train(world, out, *options)


@pytest.mark.full
@pytest.mark.parametrize(
    ("stage", "epoch"),
    [
        pytest.param("rv", 0, marks=pytest.mark.full),
        pytest.param("rv", 2, marks=pytest.mark.full),
        pytest.param("bev", 1, marks=pytest.mark.full),
        ("head", 1),
    ],
)
def test_an_interrupted_run_resumes_to_the_same_weights(
    world: Path, run: Path, tmp_path: Path, stage: str, epoch: int
) -> None:
    train_interrupted(stage, epoch, world, tmp_path / "run")
    assert not differing(train(world, tmp_path / "run", "--resume"), load(run))
    for name in ("best", "last"):
        path = f"{stage}/{name}.safetensors"
        assert not differing(load(tmp_path / "run" / path), load(run / path))
    assert len(column(tmp_path / "run", stage, "val/miou")) == len(column(run, stage, "val/miou"))


@pytest.mark.full
def test_averaged_weights_are_validated_and_written_and_resume_to_the_bit(
    world: Path, run: Path, tmp_path: Path
) -> None:
    options = ("--stage", "rv", "--training.rv.ema", 0.8)
    whole = train(world, tmp_path / "whole", *options)
    last = tmp_path / "whole/rv/last.safetensors"
    assert differing(load(last), load(run / "rv/last.safetensors")) == {"range_net"}

    # The training itself is that without the average.
    assert column(tmp_path / "whole", "rv", "train/loss") == column(run, "rv", "train/loss")
    accuracies = column(tmp_path / "whole", "rv", "val/acc")
    assert accuracies != column(run, "rv", "val/acc")

    figures = scored(world, tmp_path, last, "--methods", "rv")["methods"]["rv"]
    assert figures["accuracy"] == pytest.approx(accuracies[-1], abs=2e-3)

    train_interrupted("rv", 1, world, tmp_path / "cut", *options)
    assert not differing(train(world, tmp_path / "cut", *options, "--resume"), whole)


@pytest.mark.full
def test_some_initial_weights_are_kept_and_resumed(world: Path, run: Path, tmp_path: Path) -> None:
    init = run / "weights.safetensors"
    options = ("--stage", "bev", "--init", init)
    trained = train(world, tmp_path / "trained", *options).part("polar_net")
    kept = train(world, tmp_path / "kept", *options, "--training.bev.initial", 0.25)
    initial = load(init).part("polar_net")
    for name, tensor in kept.part("polar_net").items():
        if tensor.is_floating_point():
            torch.testing.assert_close(tensor, 0.75 * trained[name] + 0.25 * initial[name])
    assert differing(load(tmp_path / "kept"), load(tmp_path / "trained")) == {"polar_net"}

    averaged = (*options, "--training.bev.initial", 0.25, "--training.bev.ema", 0.8)
    whole = train(world, tmp_path / "whole", *averaged)
    train_interrupted("bev", 1, world, tmp_path / "cut", *averaged)
    assert not differing(train(world, tmp_path / "cut", *averaged, "--resume"), whole)


@pytest.mark.parametrize("option", ["initial", "distill"])
def test_a_part_that_the_initial_weights_lack_is_missed_before_the_first_stage(
    world: Path, tmp_path: Path, option: str
) -> None:
    save(without(fresh_weights(), "polar_net"), tmp_path / "rv.safetensors")
    command = (*train_arguments(world, tmp_path / "run"), f"--training.bev.{option}", 0.5)
    error = refusal(*command, "--init", tmp_path / "rv.safetensors")
    assert "polar_net to begin with, found range_net, point_head in --init" in error
    refused((*command,), "polar_net to begin with, found none; give --init")
    assert not (tmp_path / "run").exists()


@pytest.mark.full
def test_a_run_is_not_resumed_from_other_initial_weights(world: Path, tmp_path: Path) -> None:
    command = [*train_arguments(world, tmp_path / "run"), "--stage", "rv", "--init"]
    for seed in (1, 2):
        save(fresh_weights(seed=seed), tmp_path / f"{seed}.safetensors")
    assert run_cli(*command, tmp_path / "1.safetensors")[0] == 0
    refused((*command, tmp_path / "2.safetensors", "--resume"), "other weights to begin with")
    assert run_cli(*command, tmp_path / "1.safetensors", "--resume")[0] == 0


@pytest.mark.full
def test_epochs_on_simulated_streets_have_fresh_ones_resumed_or_not(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulated, "drive_street", tiny.fake_drive)
    monkeypatch.setattr(simulated, "SCANS", 2)
    options = ("--stage", "rv", "--train-sequences", "0,1", "--val-sequences", "900000")
    data = ("--data", f"simulated-hdl64e:{tmp_path / 'cache'}")
    whole = train(world, tmp_path / "whole", *options, *data)
    streets = {path.name for path in tmp_path.glob("cache/streets-*/*")}
    trained = {f"{epoch:03d}00{street}" for epoch in range(3) for street in range(2)}
    assert streets == trained | {"900000"}
    with np.load(tmp_path / "whole/class_counts.npz") as file:
        assert {name[:6] for name in file["scans"].tolist()} == {"000000", "000001"}

    # The intensities of all scans were brought to those that predictions are brought to.
    assert whole.expects.intensity == TrainedIntensity(
        SIMULATED_QUANTILES["hdl64e"], is_matched=True
    )

    # Another cache, which a worker fills.
    others = ("--data", f"simulated-hdl64e:{tmp_path / 'other'}", "--training.workers", 1)
    train_interrupted("rv", 1, world, tmp_path / "cut", *options, *others)
    shutil.rmtree(tmp_path / "other")
    assert not differing(train(world, tmp_path / "cut", *options, *others, "--resume"), whole)

    record = yaml.safe_load((tmp_path / "cut/run.yaml").read_text())["rv"]
    assert record["data"] == f"simulated-hdl64e:{tmp_path / 'other'}"


@pytest.mark.full
def test_tuning_weights_of_matched_intensities_matches_the_other_scans_too(
    world: Path, run: Path, tmp_path: Path
) -> None:
    weights = load(run / "weights.safetensors")
    quantiles = (np.linspace(0, 1, len(PROBABILITIES)) ** 3).tolist()
    matched = with_intensities(weights, quantiles, is_matched=True)
    save(matched, tmp_path / "init.safetensors")

    options = ("--stage", "rv", "--init", tmp_path / "init.safetensors")
    assert train(world, tmp_path / "run", *options).expects.intensity == matched.expects.intensity

    # In training, the network is validated on what it gets in a prediction.
    figures = scored(world, tmp_path, tmp_path / "run", "--methods", "rv")["methods"]["rv"]
    accuracies = column(tmp_path / "run", "rv", "val/acc")
    assert figures["accuracy"] == pytest.approx(accuracies[-1], abs=1e-4)


@pytest.mark.full
def test_reading_in_workers_changes_nothing_at_all(world: Path, run: Path, tmp_path: Path) -> None:
    options = ("--stage", "rv", "--training.workers", 1)
    train_interrupted("rv", 2, world, tmp_path / "run", *options)
    interrupted = load(tmp_path / "run/rv/last.safetensors")
    expected = column(run, "rv", "val/acc")[1]
    assert interrupted.metrics["range_net"]["val/acc"] == pytest.approx(expected, abs=1e-6)

    train(world, tmp_path / "run", *options, "--resume")
    resumed = load(tmp_path / "run/rv/last.safetensors")
    assert not differing(resumed, load(run / "rv/last.safetensors"))


@pytest.mark.parametrize(
    "other",
    [("--training.rv.epochs", 5), ("--model.range_net.decoder", 24), ("--training.seed", 4)],
)
def test_other_values_resume_no_run(world: Path, run: Path, other: tuple[str, object]) -> None:
    names = ("recipe.yaml", "run.yaml", "weights.safetensors")
    before = {name: (run / name).read_bytes() for name in names}
    refused((*train_arguments(world, run), "--resume", *other), "stage.yaml")
    assert {name: (run / name).read_bytes() for name in names} == before


@pytest.mark.full
def test_a_broken_checkpoint_is_named(world: Path, tmp_path: Path) -> None:
    train_interrupted("rv", 2, world, tmp_path, "--stage", "rv")
    checkpoint = tmp_path / "rv/last.ckpt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    refused((*train_arguments(world, tmp_path), "--stage", "rv", "--resume"), "last.ckpt")


def test_a_broken_label_file_is_one_line_from_a_worker_too(world: Path, tmp_path: Path) -> None:
    data = shutil.copytree(world / "data", tmp_path / "data")
    np.full(499, CAR, np.uint32).tofile(data / "sequences/00/labels/000001.label")  # of 500 points

    options = ("--stage", "rv", "--training.rv.class_weights", 0, "--training.workers", 1)
    refused(
        ("train", world / "recipe.yaml", "--data", data, "--out", tmp_path / "run", *options), "499"
    )


def test_a_run_leaves_no_temporary_files_and_no_points_of_its_head(run: Path) -> None:
    assert not [name for name in files(run) if ".part" in name]
    assert not (run / "head/train").exists()
    assert not (run / "head/val").exists()


def test_resuming_a_finished_run_changes_nothing(world: Path, run: Path, tmp_path: Path) -> None:
    shutil.copytree(run, tmp_path / "run")
    before = {name: (run / name).read_bytes() for name in files(run) if "safetensors" in name}
    train(world, tmp_path / "run", "--resume")
    assert {name: (tmp_path / "run" / name).read_bytes() for name in before} == before


@pytest.mark.full
def test_a_finished_stage_needs_no_checkpoint(world: Path, run: Path, tmp_path: Path) -> None:
    out = shutil.copytree(run, tmp_path / "run")
    for stage in PART_OF:
        (out / stage / "last.ckpt").unlink()
    before = contents(out)
    refused((*train_arguments(world, out),), "--resume")
    assert contents(out) == before
    assert not differing(train(world, out, "--resume"), load(run))


def test_the_head_stage_keeps_the_networks_bits(world: Path, run: Path, tmp_path: Path) -> None:
    before = load(run)
    after = train(world, tmp_path / "head", "--stage", "head", "--init", run, "--training.seed", 5)
    assert differing(before, after) == {"point_head"}


@pytest.mark.full
def test_a_head_may_learn_from_points_of_another_tau(
    world: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shares: dict[str, list[float]] = {"train": [], "val": []}
    gather = PointGatherer.gather

    def watched(self: PointGatherer, records: Any, folder: Path, *more: Any, **named: Any) -> Any:
        points = gather(self, records, folder, *more, **named)
        shares[folder.name].append(points.uncertain_share)
        return points

    monkeypatch.setattr(PointGatherer, "gather", watched)
    options = ("--stage", "head", "--init", run, "--training.head.epochs", 1)
    train(world, tmp_path / "own", *options)
    weights = train(world, tmp_path / "few", *options, "--training.head.tau", 0.9)

    # It validates at the model's tau, which stays.
    assert 0 < shares["train"][1] < shares["train"][0]
    assert shares["val"][0] == shares["val"][1]
    assert weights.model.assertion == load(run).model.assertion


def test_a_stage_takes_the_other_parts_from_init(world: Path, run: Path, tmp_path: Path) -> None:
    after = train(world, tmp_path / "rv", "--stage", "rv", "--init", run, "--training.rv.epochs", 1)
    assert differing(load(run), after) == {"range_net"}
    assert after.training["range_net"]["rv"]["epochs"] == 1
    assert after.training["polar_net"] == load(run).training["polar_net"]


@pytest.mark.full
def test_stages_one_by_one_equal_all_at_once(world: Path, run: Path, tmp_path: Path) -> None:
    for stage in PART_OF:
        weights = train(world, tmp_path / "run", "--stage", stage)
    assert not differing(weights, load(run))


@pytest.mark.full
def test_two_stages_trained_at_the_same_time_are_both_kept(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other stage begins after this one and ends before it, as if by another process."""
    save(fresh_weights(), tmp_path / "start.safetensors")
    options = ["--init", tmp_path / "start.safetensors", "--training.rv.epochs", 1]

    def train_beside(*stage: Any) -> None:
        monkeypatch.setattr(training_run, "train_network", train_network)
        train(world, tmp_path / "run", "--stage", "rv", *options)
        train_network(*stage)

    monkeypatch.setattr(training_run, "train_network", train_beside)
    weights = train(world, tmp_path / "run", "--stage", "bev", *options)
    for stage in ("rv", "bev"):
        trained = load(tmp_path / "run" / stage / "last.safetensors")
        assert weights.digest(PART_OF[stage]) == trained.digest(PART_OF[stage])


@pytest.mark.full
@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_an_incomplete_batch_of_parts_is_the_mean_of_its_scans(
    world: Path, tmp_path: Path, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four scans in batches of three: a batch of one follows, whether or not it has parts."""
    # Without batch norm's statistics, which depend on the parts.
    monkeypatch.setattr(NetworkStage, "on_train_epoch_start", lambda self: self.trained.eval())
    options = ["--stage", stage, f"--training.{stage}.batch", 3, f"--training.{stage}.epochs", 1]
    options += [f"--training.{stage}.clip", 9e5, "--model.polar_net.dropblock", 0]
    options += ["--training.precision", "64-true", "--training.keep", "last"]

    norms: dict[int, list[float]] = {1: [], 3: []}
    for parts, of_steps in norms.items():

        def note(self: NetworkStage, optimizer: Any, of_steps: list[float] = of_steps) -> None:
            gradients = [p.grad.norm() for p in self.trained.parameters() if p.grad is not None]
            of_steps.append(float(torch.stack(gradients).norm()))

        monkeypatch.setattr(NetworkStage, "on_before_optimizer_step", note)
        train(world, tmp_path / str(parts), *options, f"--training.{stage}.accumulate", parts)
    assert len(norms[1]) == 2
    assert norms[3] == pytest.approx(norms[1], rel=1e-9)


@pytest.mark.full
def test_nuscenes_is_trained_predicted_and_evaluated(tmp_path: Path) -> None:
    recipe = write_recipe(tmp_path / "recipe.yaml", "nuscenes-compact")
    data = tiny.GOLDEN / "nuscenes"
    run = tmp_path / "run"
    scenes = ("--train-sequences", "scene-0103", "--val-sequences", "scene-0916")
    assert run_cli("train", recipe, "--data", data, "--out", run, *scenes) == (0, "")
    assert load(run).model.range_view.rows == "ring"

    out = tmp_path / "out"
    scene = ("--sequences", "scene-0916")
    assert run_cli("predict", data, "--weights", run, "--out", out, *scene)[0] == 0
    paths = sorted((out / "lidarseg/mini_val").glob("*_lidarseg.bin"))
    labels = [np.fromfile(path, np.uint8) for path in paths]
    assert sorted(map(len, labels)) == [2622, 2683]
    for ids in labels:
        assert ids.min() >= 1
        assert ids.max() <= 16

    assert run_cli("evaluate", data, "--predictions", out, *scene)[0] == 0
    assert run_cli("evaluate", data, "--weights", run, *scene)[0] == 0


@pytest.mark.full
def test_if_the_networks_agree_everywhere_the_head_learns_from_all_points(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own: list[float] = []
    keep = KeepWeights.on_train_epoch_end

    def watch(self: KeepWeights, trainer: Any, stage: Any) -> None:
        if stage.name == "head":
            own.append(stage.own_miou)
        keep(self, trainer, stage)

    monkeypatch.setattr(KeepWeights, "on_train_epoch_end", watch)
    weights = train(world, tmp_path / "run", "--model.assertion.threshold", 0)
    assert (weights.parts, weights.usual_uncertain) == (PARTS, 0)

    # The figure of the head is AMVNet's: the ensemble's wherever the networks agree.
    expected = scored(world, tmp_path, tmp_path / "run")["methods"]["amvnet"]["miou"]
    mious = column(tmp_path / "run", "head", "val/miou")
    assert mious[-1] == pytest.approx(expected, abs=1e-3)

    # AMVNet's figure never changes, so the head's own labels choose its best weights.
    assert len(set(mious)) == 1
    best = load(tmp_path / "run/head/best.safetensors")
    assert best.metrics["point_head"]["epoch"] == np.argmax(own)


@pytest.mark.full
def test_a_new_head_is_trained_on_the_networks_of_weights_with_another_one(
    world: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--stage", "head", "--init", run, "--model.point_head.fc", 12)
    weights = train(world, tmp_path / "run", *options)
    line = "head: new, because the head of the initial weights has other sizes"
    assert line in capsys.readouterr().out
    assert weights.model.point_head.fc == 12
    assert differing(load(run), weights) == {"point_head"}

    # A finished stage is not trained again; one of another head is refused.
    assert not differing(weights, train(world, tmp_path / "run", *options, "--resume"))
    arguments = (*train_arguments(world, tmp_path / "run"), "--stage", "head", "--resume")
    refused((*arguments, "--model.point_head.fc", 16), "point_head.fc")


@pytest.mark.full
def test_the_networks_of_a_head_keep_their_settings_and_the_run_says_so(
    world: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--stage", "head", "--init", run, "--training.head.epochs", 1)
    weights = train(world, tmp_path / "same", *options)
    assert "stays as in --init" not in capsys.readouterr().out

    others = ("--model.range_view.hidden", 0.25, "--model.polar_view.vertical", 3)
    weights = train(world, tmp_path / "other", *options, *others)
    out = capsys.readouterr().out
    begun = load(run).model
    assert weights.model.range_view == begun.range_view
    assert weights.model.polar_view == begun.polar_view
    line = "range_net: is not trained, so it stays as in --init: model.range_view.hidden is"
    assert f"{line} {begun.range_view.hidden:g}, not 0.25\n" in out
    line = "polar_net: is not trained, so it stays as in --init: model.polar_view.vertical is"
    assert f"{line} {begun.polar_view.vertical}, not 3\n" in out


@pytest.mark.parametrize("stage", ["rv", "bev"])
def test_a_loss_that_is_not_finite_stops_with_the_names_of_the_scans(
    world: Path, tmp_path: Path, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    loss = NetworkStage.loss
    steps: list[object] = []

    def diverging(self: NetworkStage, scored: Any) -> Any:
        steps.append(scored)
        return loss(self, scored) * (math.inf if len(steps) == 3 else 1)

    monkeypatch.setattr(NetworkStage, "loss", diverging)
    error = refusal(*train_arguments(world, out), "--stage", stage)
    assert "finite" in error
    assert "00/0" in error or "01/0" in error
    assert not (out / "weights.safetensors").exists()


@pytest.mark.full
def test_a_run_of_several_calls_records_what_each_trained_on(world: Path, tmp_path: Path) -> None:
    val = ("--val-sequences", "08")
    train(world, tmp_path, "--stage", "rv", "--train-sequences", "00", *val)
    train(world, tmp_path, "--stage", "bev", "--train-sequences", "01", *val)

    records = yaml.safe_load((tmp_path / "run.yaml").read_text())
    trained = {name: record["train"] for name, record in records.items()}
    assert trained == {"rv": ["00"], "bev": ["01"]}
    assert (records["rv"]["val"], records["rv"]["versions"]["torch"]) == (["08"], torch.__version__)


def train_until_signal(words: list[str], printed: Printed, number: int) -> None:
    """Train in this process, which gets a signal at the beginning of the second epoch."""

    seed = SeedBatches.on_train_batch_start

    def signalled(self: SeedBatches, trainer: Any, *arguments: Any) -> None:
        if trainer.current_epoch == 1:
            os.kill(os.getpid(), number)
        seed(self, trainer, *arguments)

    SeedBatches.on_train_batch_start = signalled  # type: ignore[assignment, method-assign]
    become_cli(words, printed)


def train_with_signal(
    world: Path, out: Path, stage: str, number: int
) -> tuple[int | None, Printed]:
    """Train in a process that gets a signal after an epoch; return its exit code and output."""
    printed = Printed(out.with_name(f"printed by {out.name}"))
    words = [*map(str, train_arguments(world, out)), "--stage", stage]
    process = fork_server().Process(target=train_until_signal, args=(words, printed, number))
    process.start()
    process.join()
    return process.exitcode, printed


@pytest.mark.full
@STAGES
def test_a_killed_run_resumes_exactly(world: Path, run: Path, tmp_path: Path, stage: str) -> None:
    out = tmp_path / "run"
    if stage == "head":
        for earlier in ("rv", "bev"):
            shutil.copytree(run / earlier, out / earlier)

    assert train_with_signal(world, out, stage, signal.SIGKILL)[0] == -signal.SIGKILL
    train(world, out, "--stage", stage, "--resume")
    weights = load(out / stage / "last.safetensors")
    assert not differing(weights, load(run / stage / "last.safetensors"))


@pytest.mark.full
def test_sigterm_is_143_and_one_line_until_resumed(world: Path, run: Path, tmp_path: Path) -> None:
    """Lightning has a handler of its own, under which the training would end as if it were done."""
    code, printed = train_with_signal(world, tmp_path / "run", "rv", signal.SIGTERM)
    assert code == 143, printed.text
    assert printed.stderr.read_text() == "amvnet: stopped; go on with --resume\n"
    assert "weights in" not in printed.stdout.read_text()

    train(world, tmp_path / "run", "--stage", "rv", "--resume")
    resumed = load(tmp_path / "run/rv/last.safetensors")
    assert not differing(resumed, load(run / "rv/last.safetensors"))


def test_the_handler_of_sigterm_during_a_training_is_that_of_the_process(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handlers: dict[str, Any] = {}

    def note(*stage: Any) -> None:
        handlers["before"] = signal.getsignal(signal.SIGTERM)
        train_network(*stage)

    def note_within(self: NetworkStage, optimizer: Any) -> None:
        handlers["within"] = signal.getsignal(signal.SIGTERM)

    monkeypatch.setattr(training_run, "train_network", note)
    monkeypatch.setattr(NetworkStage, "on_before_optimizer_step", note_within)
    train(world, tmp_path / "run", "--stage", "rv", "--training.rv.epochs", 1)
    assert handlers["within"] == handlers["before"] != signal.SIG_DFL


@pytest.mark.full
@pytest.mark.parametrize("room", [pytest.param(1_000, marks=pytest.mark.full), 40_000])
def test_a_full_disk_is_one_line_and_keeps_weights(world: Path, tmp_path: Path, room: int) -> None:
    """No file may exceed `room` bytes, which is what a full disk looks like to a program."""
    out = tmp_path / "run"
    train_interrupted("rv", 1, world, out, "--stage", "rv")
    before = load(out / "rv" / "last.safetensors")

    printed = Printed(tmp_path / "printed")
    words = [*map(str, train_arguments(world, out)), "--stage", "rv", "--resume"]
    process = start_cli(words, printed, largest_file=room)
    process.join()
    assert process.exitcode in (1, 2), printed.text
    assert len(printed.stderr.read_text().splitlines()) == 1, printed.text
    assert not differing(load(out / "rv" / "last.safetensors"), before)
    assert not [name for name in files(out) if ".part" in name]

    train(world, out, "--stage", "rv", "--resume")


@pytest.mark.full
def test_a_run_that_fails_is_one_line_and_keeps_its_stages(world: Path, tmp_path: Path) -> None:
    """The notes of libraries stay out of stderr, which only a process of its own shows."""
    data = shutil.copytree(world / "data", tmp_path / "data")
    arguments = ["train", world / "recipe.yaml", "--data", data, "--out", tmp_path / "run"]
    assert run_cli(*arguments, "--stage", "rv") == (0, "")

    # Read in the validation, after an epoch of training.
    (data / "sequences/08/labels/000001.label").write_bytes(b"1234")
    printed = Printed(tmp_path / "printed")
    process = start_cli([*map(str, arguments), "--stage", "bev"], printed)
    process.join()
    assert process.exitcode == 2
    assert "000001.label" in printed.stderr.read_text()
    assert len(printed.stderr.read_text().splitlines()) == 1, printed.text
    assert load(tmp_path / "run").parts == ("range_net",)


@pytest.mark.full
@pytest.mark.parametrize("stage", ["bev", "rv"])
def test_a_baseline_is_trained_and_evaluated_alone(world: Path, tmp_path: Path, stage: str) -> None:
    recipe = write_recipe(tmp_path / "recipe.yaml", "semantickitti-compact")
    run = tmp_path / "run"
    options = ("--stage", stage, "--model.range_net.gru", "false")
    succeed("train", recipe, "--data", world / "data", "--out", run, *options)
    weights = load(run)
    assert weights.parts == (PART_OF[stage],)
    assert not [name for name in weights.tensors if "gru" in name]

    assert list(scored(world, tmp_path, run)["methods"]) == [stage]


@pytest.mark.full
def test_the_validation_scans_can_be_learnt_too(world: Path, tmp_path: Path) -> None:
    """For an entry to a benchmark: there is no validation, and the last weights are the best."""
    run = tmp_path / "run"
    weights = train(world, run, "--with-val")
    for stage, part in PART_OF.items():
        assert weights.training[part]["sequences"] == ["00", "01", "08"]
        assert weights.training[part]["validated_on"] == []
        best = load(run / stage / "best.safetensors")
        assert not differing(best, load(run / stage / "last.safetensors"))
        assert column(run, stage, "train/loss")
        assert not column(run, stage, "val/miou")


def test_a_step_that_does_not_fit_into_the_memory_says_what_to_set(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fill_memory(*arguments: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(networks, "fit", fill_memory)
    error = refusal(*train_arguments(world, tmp_path / "run"), "--stage", "rv")
    assert "--training.rv.accumulate" in error


def test_the_uncertain_share_is_the_networks_own(world: Path, run: Path, tmp_path: Path) -> None:
    share = scored(world, tmp_path, run)["uncertain_fraction"]
    # The evaluation counts unlabelled points, too: two in a hundred.
    assert column(run, "head", "val/uncertain")[0] == pytest.approx(share, abs=0.02)


@pytest.mark.full
def test_networks_with_few_channels_train_without_a_crash() -> None:
    """PyTorch 2.13 corrupts the heap in the backward pass of some strided 1 x 1 convolutions.

    Namely of those with stride (1, 2) and fewer than 16 channels.
    """
    code = """
import torch
from amvnet.models.layers import ResidualBlock
block = ResidualBlock(8, 8, (1, 2))
for _ in range(100):
    image = torch.randn(2, 32, 64, 8).permute(0, 3, 1, 2).requires_grad_()
    block(image).sum().backward()
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert result.returncode == 0
