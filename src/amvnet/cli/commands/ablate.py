"""The command `ablate`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import on_terminal, report, report_lines
from amvnet.cli.options import TrainingChoice, describe_records, join_processes
from amvnet.config.schema import Recipe

TABLE = "ablation"  # name of the table's file, without its ending


def ablate(
    recipe: Recipe, /, data: str, out: Path, choice: TrainingChoice, device: str = "auto"
) -> None:
    """Train the range-view network with and without GRU and class weights: the paper's Table 5.

    Args:
        recipe: the name of a built-in recipe, or a YAML file.
        data: the dataset.
        out: folder for the four runs and the table. If the folder has an interrupted ablation, the
            call continues it.
        choice: which scans to train on, and which to score.
        device: the device that scores the trained networks: cpu, cuda, cuda:1, ..., or auto, which
            is cuda if there is a GPU.
    """
    from amvnet.evaluation import charts
    from amvnet.files import check_outputs
    from amvnet.runtime.distributed import device_of
    from amvnet.training.ablation import ablate as ablate_recipe
    from amvnet.training.ablation import is_begun
    from amvnet.training.plan import Plan

    processes = join_processes(device_of(recipe.training.accelerator) == "cuda")
    plan = Plan.open(
        recipe,
        [data],
        out,
        choose=choice.source,
        stage="rv",
        report=report,
        resume=True,
        bars=on_terminal(),
        processes=processes,
    )
    train, val = describe_records(plan.data.train), describe_records(plan.data.val)
    report(f"training on {train}; scoring on {val}")

    table = {out / f"{TABLE}.csv": charts.TABLE}
    check_outputs(table, [data], overwrite=is_begun(out))
    processes.wait()
    rows = list(ablate_recipe(plan, device))
    if processes.first:
        files = charts.write_ablation(rows, out / TABLE)
        report_lines(files[-1].read_text().rstrip())
