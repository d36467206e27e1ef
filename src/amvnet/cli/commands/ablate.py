"""The verb `ablate`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amvnet.cli.commands.train import _calm_lightning
from amvnet.cli.console import on_terminal, say
from amvnet.cli.options import describe_records, join_processes, open_data, parse_names


def ablate(
    recipe: Any,
    data: str,
    out: Path,
    train_sequences: str | None = None,
    val_sequences: str | None = None,
    device: str = "cpu",
) -> None:
    """Train the range-view network with and without GRU and class weights, and write the paper's Table 5.

    Args:
        recipe: what to train; a built-in recipe's name or a YAML file.
        data: the data set.
        out: folder for the four runs and the table; started again, it goes on.
        train_sequences: sequences or scenes to train on, with commas; default: the official split.
        val_sequences: sequences or scenes to score, with commas; default: the official split.
        device: where the trained networks are scored: cpu, cuda, cuda:1, ...
    """
    from amvnet.data.datasets.select import split_records
    from amvnet.distributed import device_of
    from amvnet.evaluation import charts
    from amvnet.training.studies import ablate as compare

    _calm_lightning()
    processes = join_processes(device_of(recipe.training.accelerator) == "cuda")
    dataset = open_data(data, None)
    learnt, val = split_records(dataset, parse_names(train_sequences), parse_names(val_sequences))
    say(f"training on {describe_records(learnt)}; scoring on {describe_records(val)}")
    rows = list(compare(recipe, dataset, learnt, val, out, say, on_terminal(), device, processes))
    if processes.first:
        files = charts.write_ablation(rows, out / "ablation")
        say(files[-1].read_text().rstrip())
