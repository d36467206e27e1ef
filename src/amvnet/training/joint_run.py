"""The run of the stage that trains both networks and the point head together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor, nn

from amvnet.errors import InputError
from amvnet.models.assertions import build_assertion
from amvnet.training.fit import fit
from amvnet.training.joint_stage import JointStage
from amvnet.training.run_plan import check_batch
from amvnet.training.stage_run import ScanRun
from amvnet.weights.file import part_state

# By part, where the validation logs its metrics. Those of the head are those of the whole method.
FOLDERS = {"range_net": "val/rv", "polar_net": "val/bev", "point_head": "val"}


@dataclass(frozen=True)
class JointRun(ScanRun):
    """Stage `joint`: all three parts, end to end (the paper's outlook)."""

    def fit(self) -> None:
        for part in self.parts:
            if part not in self.weights.parts:
                raise InputError(
                    f"expected trained parts for the stage joint, found no {part} for these "
                    "classes; train it, or give --init"
                )
        processes = self.plan.options.processes
        check_batch(self.config, self.name, processes.size)

        training = self.plan.recipe.training
        with_weights = [part.class_weights for part in (training.rv, training.bev, training.head)]
        stage = JointStage(
            self.model(),
            build_assertion(self.weights.model.assertion, labels=True),
            training,
            self.weights.taxonomy,
            weights=self.class_weights() if any(with_weights) else None,
            processes=processes,
        )
        callbacks = [self.keep_weights(), self.pictures(lambda batch: stage.score(batch).merged)]
        fit(stage, self.fit_options(), self.loaders(), callbacks)

    def state(self, module: nn.Module) -> dict[str, Tensor]:
        tensors: dict[str, Tensor] = {}
        for part in self.parts:
            tensors |= part_state(part, getattr(module, part))
        return tensors

    def metrics_of(self, part: str, metrics: Mapping[str, float]) -> dict[str, float]:
        selected = {}
        for name, value in metrics.items():
            folder, _, metric = name.rpartition("/")
            if not folder:  # the epoch
                selected[name] = value
            elif folder == FOLDERS[part]:
                selected[f"val/{metric}"] = value
        return selected
