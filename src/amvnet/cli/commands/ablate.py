"""The verb `ablate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amvnet.cli.console import on_terminal, say, say_lines
from amvnet.cli.options import describe_records, join_processes, parse_names


def ablate(
    recipe: Any,
    data: str,
    out: Path,
    train_sequences: str | None = None,
    val_sequences: str | None = None,
    device: str = "auto",
) -> None:
    """Train the range-view network with and without GRU and class weights: the paper's Table 5.

    Args:
        recipe: what to train; a built-in recipe's name or a YAML file.
        data: the dataset.
        out: folder for the four runs and the table; a second call continues an interrupted one.
        train_sequences: sequences or scenes, separated by commas, to train on; default: the
            official split.
        val_sequences: sequences or scenes, separated by commas, to score; default: the official
            split.
        device: where the trained networks are scored: cpu, cuda, cuda:1, ..., or auto: cuda if
            there is a GPU.
    """
    from amvnet.data.datasets.select import split_records
    from amvnet.distributed import device_of
    from amvnet.evaluation import charts
    from amvnet.training.ablation import ablate as ablate_recipe
    from amvnet.training.plan import Plan, open_for_training

    processes = join_processes(device_of(recipe.training.accelerator) == "cuda")
    dataset = open_for_training(data, None, recipe, out)
    scans = split_records(dataset, parse_names(train_sequences), parse_names(val_sequences))
    say(f"training on {describe_records(scans.train)}; scoring on {describe_records(scans.val)}")

    plan = Plan(recipe, scans, out, resume=True, say=say, bars=on_terminal(), processes=processes)
    rows = list(ablate_recipe(plan, device))
    if processes.first:
        files = charts.write_ablation(rows, out / "ablation")
        say_lines(files[-1].read_text().rstrip())
