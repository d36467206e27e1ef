"""Measure where the time of a training step goes.

    python benchmarks/training.py [--recipe RECIPE] [--data DATA] [--stages rv,bev] [--streets N]
        [--KEY VALUE ...]

One epoch of simulated streets is trained; options of `amvnet train` may follow. The table has the
seconds of a step. Reading and augmentation take place in other processes (`--training.workers`); a
step only waits for them if they are too slow.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import lightning as L
import numpy as np
from lightning.pytorch.profilers import SimpleProfiler

from amvnet.cli.main import main as amvnet

WAITING = "train_dataloader_next"
FORWARD = ".training_step"
BACKWARD = ".backward"
BATCH = "run_training_batch"
WARM_UP = 2  # number of steps that do not count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recipe", default="simulated-compact")
    parser.add_argument("--data", default="simulated-hdl64e")
    parser.add_argument("--stages", default="rv,bev")
    parser.add_argument("--streets", type=int, default=10)
    options, more = parser.parse_known_args()

    rows = []
    with TemporaryDirectory() as folder:
        for stage in options.stages.split(","):
            command = ["train", options.recipe, "--data", f"{options.data}:{folder}/streets"]
            command += ["--train-sequences", ",".join(map(str, range(options.streets)))]
            command += ["--out", str(Path(folder) / stage), "--stage", stage]
            command += [f"--training.{stage}.epochs", "1", *more]
            profiler = SimpleProfiler()
            with patch.object(L, "Trainer", partial(L.Trainer, profiler=profiler)):
                amvnet(command)
            rows.append((stage, *step_times(profiler)))

    print("| | steps | wait for scans | forward | backward | optimizer and rest |")
    print("|---|---|---|---|---|---|")
    for stage, steps, *seconds in rows:
        print(f"| {stage} | {steps} |", " | ".join(f"{value:.2f}" for value in seconds), "|")


def step_times(profiler: SimpleProfiler) -> tuple[int, float, float, float, float]:
    """Return the number of steps, and the median seconds of the parts of a step.

    The optimizer calls the forward and the backward pass, so that its own time is the difference.
    """
    batch, waiting, forward, backward = (
        durations(profiler, key)[WARM_UP:] for key in (BATCH, WAITING, FORWARD, BACKWARD)
    )
    steps = len(batch)
    rest = batch - forward - backward
    medians = (float(np.median(part)) for part in (waiting[:steps], forward, backward, rest))
    return steps, *medians  # type: ignore[return-value]


def durations(profiler: SimpleProfiler, ending: str) -> np.ndarray:
    """Return the seconds of each call of the action whose name has an ending."""
    for action, seconds in profiler.recorded_durations.items():
        if action.endswith(ending):
            return np.array(seconds)
    raise KeyError(f"expected {ending}, found {sorted(profiler.recorded_durations)}")


if __name__ == "__main__":
    main()
