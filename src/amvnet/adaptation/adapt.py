"""Adapt weights to scans without labels: the two views teach each other, round by round.

Each round has a teacher: the averaged weights of the round before. Where its two networks agree and
are sure, their label is a pseudo-label (`agreement.py`). Both networks learn from these, mixed with
simulated streets of the same sensor. The rounds end, without any label, when too little of what was
trusted at the start still stands.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from amvnet.adaptation.agreement import Opinion, Trust, agreement, pseudo_labels, trust
from amvnet.adaptation.kept_scans import KeptScans
from amvnet.adaptation.targets import Targets, are_adapted, simulate_streets
from amvnet.adaptation.teacher import opinions_on, teacher_of, untold_text, write_trusted
from amvnet.config.nested import to_dict
from amvnet.config.schema import AdaptConfig, Recipe, StageName
from amvnet.data.datasets.base import ScanRecord
from amvnet.data.datasets.joined import Part, join
from amvnet.data.datasets.select import TrainingScans
from amvnet.data.datasets.simulated import SCANS
from amvnet.data.datasets.taught import Taught
from amvnet.data.spacing import evenly_spaced
from amvnet.distributed import device_of
from amvnet.errors import InputError
from amvnet.evaluation.top_view import TopView, draw_scan
from amvnet.files import atomic_write, read_yaml
from amvnet.inference.inputs import InputScan, adapter_for
from amvnet.inference.segmenter import Segmenter
from amvnet.models.methods import BOTH_NETWORKS, widest_method
from amvnet.progress import Progress, Say, no_progress, say_nothing
from amvnet.sensors.intensity import KEY as INTENSITY
from amvnet.sensors.intensity import MATCHED
from amvnet.sensors.record import KEY as SENSOR
from amvnet.training.losses import class_weights
from amvnet.training.run import Run
from amvnet.training.run_plan import RunOptions, RunPlan
from amvnet.weights.file import Weights, load, save

PICTURES = 3  # scans that are drawn before and after
SETTINGS = "adapt.yaml"  # in the folder of a run: what it was begun with
REPORT = "adaptation.json"
FRAME = (INTENSITY, MATCHED, SENSOR)  # what weights carry of the sensor that scans are brought to

Watch = Callable[[str], AbstractContextManager[Progress]]  # shows the progress of a step


def watch_nothing(title: str) -> AbstractContextManager[Progress]:
    """Return a context that shows no progress."""
    return nullcontext(no_progress)


@dataclass(frozen=True)
class AdaptOptions:
    """How an adaptation runs.

    Attributes:
        resume: continue an earlier one in the same folder.
        say: prints a line about what happens.
        watch: shows the progress of a step, given its title.
        bars: show progress bars of the training.
    """

    resume: bool = False
    say: Say = say_nothing
    watch: Watch = watch_nothing
    bars: bool = False


@dataclass(frozen=True)
class Look:
    """What some weights say about all scans.

    Attributes:
        weights: both networks.
        opinions: of each scan.
        trusted: what is trusted of them.
    """

    weights: Weights
    opinions: Sequence[Opinion]
    trusted: Trust

    @property
    def pseudo_labels(self) -> list[np.ndarray]:
        """For each scan, the (N,) uint8 train ids that are trusted; 0 for other points."""
        return [pseudo_labels(scan, self.trusted) for scan in self.opinions]

    @property
    def labels(self) -> list[np.ndarray]:
        """For each scan, the (N,) uint8 train ids by the ensemble."""
        return [scan.labels for scan in self.opinions]

    @property
    def uncertain(self) -> float:
        """Share of the points where the assertion fails, on average over the scans."""
        return float(np.mean([scan.uncertain for scan in self.opinions]))


class Adaptation:
    """An adaptation in its folder.

    Args:
        weights: to begin with; both networks.
        scans: to adapt to; their labels are never read.
        recipe: how, with the sizes of the weights.
        out: the folder.
        options: how it runs.

    Raises:
        InputError: if the weights lack a network, no sensor can be simulated with their classes, or
            the scans are of datasets and of files.
    """

    def __init__(
        self,
        weights: Weights,
        scans: Sequence[InputScan],
        recipe: Recipe,
        out: Path,
        options: AdaptOptions | None = None,
    ) -> None:
        missing = [name for name in BOTH_NETWORKS if name not in weights.parts]
        if missing:
            raise InputError(
                f"expected weights with both networks, found no {missing[0]}; give others"
            )

        self.out = out
        self.options = options or AdaptOptions()
        self.weights = weights
        inputs = evenly_spaced(scans, recipe.training.adapt.scans)
        # Scans of files bring the rows of their points, which follow the sensor that saw them.
        is_adapted = are_adapted(inputs)
        kept = KeptScans(out / "scans", weights.taxonomy, len(inputs), False, is_adapted)
        self.targets = Targets(inputs, kept, weights)

        count = recipe.training.adapt.streets * SCANS
        self.streets = KeptScans(out / "streets", weights.taxonomy, count, True, is_adapted)
        self.recipe = dataclasses.replace(recipe, model=weights.model)

    @property
    def config(self) -> AdaptConfig:
        return self.recipe.training.adapt

    def run(self) -> Path:
        """Adapt; return the weights file.

        Raises:
            InputError: if the folder holds a run that is not to be resumed or was begun with other
                settings, a scan cannot be read, or nothing can be learnt from the scans.
        """
        self._begin()
        say = self.options.say
        with self.options.watch("reading scans") as step:
            self.targets.read(step)
        self._simulate()

        start = self._look(self.weights)
        if not start.trusted.told.any():
            raise InputError(
                "expected scans of which the weights can tell a class, found none; say more of the "
                "sensor (--sensor, --height, --axes), or use other weights"
            )
        say(f"at the start: {self._describe(start)}")

        final, rounds = self._learn_in_rounds(start)
        # A head learns when to believe which view, and from simulated scans alone: that of the
        # weights has seen more of them than are made here.
        has_head = "point_head" in final.weights.parts
        trained = final.weights if has_head else self._train_head(final.weights)
        return self._finish(trained, start, final, rounds)

    def _begin(self) -> None:
        """Check that the run can begin or be resumed, and write what it is begun with."""
        path = self.out / SETTINGS
        names = [(scan.name, str(scan.path)) for scan in self.targets.scans]
        settings: dict[str, Any] = {
            "weights": {part: self.weights.digest(part) for part in BOTH_NETWORKS},
            "scans": hashlib.sha256(repr(names).encode()).hexdigest()[:16],
            "recipe": to_dict(self.recipe),
        }
        if path.is_file():
            if not self.options.resume:
                raise InputError(
                    f"{self.out}: expected no earlier run, found one; add --resume or give "
                    "another folder"
                )
            begun = read_yaml(path, "the settings of a run")
            changed = [key for key in settings if begun.get(key) != settings[key]]
            if changed:
                raise InputError(
                    f"{self.out}: expected what the earlier run was begun with ({SETTINGS}), found "
                    f"other {', '.join(changed)}; resume it with those, or give another folder"
                )
            return
        with atomic_write(path) as part:
            part.write_text(yaml.safe_dump(settings, sort_keys=False))

    def _simulate(self) -> None:
        """Simulate streets for the sensor of the scans."""
        sensor = self.targets.sensor()
        self.options.say(
            f"simulating {self.streets.count} scans of {len(sensor.elevations)} lasers from "
            f"{sensor.elevations[0]:+.0f} to {sensor.elevations[-1]:+.0f} degrees, "
            f"{sensor.height:.2f} m over the ground"
        )
        adapter = adapter_for(self.weights) if self.streets.is_adapted else None
        with self.options.watch("simulating") as step:
            simulate_streets(sensor, self.config.streets, self.streets, adapter, step)

    def _look(self, weights: Weights) -> Look:
        """Let weights label all scans."""
        kept = self.targets.kept
        segmenter = teacher_of(weights, device_of(self.recipe.training.accelerator))
        segmenter = segmenter.for_dataset(kept)
        with self.options.watch("labelling") as step:
            opinions = list(opinions_on(kept, kept.records(), segmenter, step))
        return Look(weights, opinions, trust(opinions, weights.taxonomy.size, self.config))

    def _learn_in_rounds(self, start: Look) -> tuple[Look, list[dict[str, float]]]:
        """Return the last look whose agreement with the start is high enough, and all rounds.

        Raises:
            InputError: if not even the first round kept what was trusted at the start.
        """
        before = start
        rounds: list[dict[str, float]] = []
        trusted_at_start = start.pseudo_labels
        for number in range(1, self.config.rounds + 1):
            now = self._look(self._learn(number, before))
            stands = agreement(trusted_at_start, now.labels, self.weights.taxonomy.size)
            rounds.append({"agreement": round(stands, 4), "uncertain": round(now.uncertain, 4)})
            self.options.say(
                f"round {number} of {self.config.rounds}: {stands:.0%} of what was trusted at the "
                f"start still stands; {self._describe(now)}"
            )
            if stands < self.config.agreement:
                self.options.say(
                    f"less than {self.config.agreement:.0%}: the weights of the round before count"
                )
                break
            before = now

        if before is start:
            raise InputError(
                f"expected {self.config.agreement:.0%} of what was trusted at the start to stand "
                f"after the first round, found {rounds[0]['agreement']:.0%}; use the weights as "
                "they are, or a recipe with lower rates"
            )
        return before, rounds

    def _learn(self, number: int, before: Look) -> Weights:
        """Train both networks on the pseudo-labels of a look; return their averaged weights."""
        folder = self.out / f"round-{number}"
        kept = self.targets.kept
        write_trusted(kept.records(), before.opinions, before.trusted, folder / "labels")

        taught = Taught(kept, folder / "labels")
        share = self.recipe.training.others or None
        mixed = Part(self.streets, self.streets.records(), share)
        scans = join(TrainingScans(taught, kept.records(), ()), [mixed])
        plan = self._plan(("rv", "bev"), scans, folder, self._class_weights(before))
        return load(Run(plan).stages("all", before.weights))

    def _class_weights(self, look: Look) -> np.ndarray:
        """Return the (K,) weights of the classes in the loss.

        Pseudo-labels and simulated scans count alike. A class that cannot be told is not weighted
        up: that would only let the networks see it where it is not.
        """
        size = self.weights.taxonomy.size
        taught = np.zeros(size)
        for ids in look.pseudo_labels:
            taught += np.bincount(ids, minlength=size + 1)[1:]
        simulated = np.zeros(size)
        for record in self.streets.records():
            labels = self.streets.read(record).labels
            assert labels is not None
            simulated += np.bincount(labels, minlength=size + 1)[1:]

        shares = taught / max(taught.sum(), 1) + simulated / max(simulated.sum(), 1)
        weights = class_weights(shares)
        return np.where(look.trusted.told, weights, np.minimum(weights, 1)).astype(np.float32)

    def _train_head(self, networks: Weights) -> Weights:
        """Train a head on what the adapted networks say about the simulated scans.

        Its labels must be right where the networks disagree, so it learns from no pseudo-labels.
        """
        records = self.streets.records()
        held_out = SCANS if len(records) > SCANS else 0
        train: Sequence[ScanRecord] = records[: len(records) - held_out]
        scans = TrainingScans(self.streets, train, records[len(train) :])
        plan = self._plan(("head",), scans, self.out, None)
        path = Run(dataclasses.replace(plan, out=self.out / "head")).stages("all", networks)
        return load(path)

    def _plan(
        self,
        stages: tuple[StageName, ...],
        scans: TrainingScans,
        folder: Path,
        weights: np.ndarray | None,
    ) -> RunPlan:
        options = RunOptions(resume=True, say=self.options.say, bars=self.options.bars)
        recipe = dataclasses.replace(self.recipe, stages=stages)
        return RunPlan(recipe, scans, folder, options, class_weights=weights)

    def _finish(
        self, trained: Weights, start: Look, final: Look, rounds: list[dict[str, float]]
    ) -> Path:
        """Draw the pictures, and write the report and the weights, these last."""
        record = {
            "from": {part: self.weights.digest(part) for part in BOTH_NETWORKS},
            "scans": self.targets.kept.count,
            "uncertain": {"before": round(start.uncertain, 4), "after": round(final.uncertain, 4)},
            "rounds": rounds,
        }
        training = dict(trained.training)
        for name in BOTH_NETWORKS:
            description = trained.training[name]
            of_stage = {key: value for key, value in description.items() if key not in FRAME}
            # The scans were brought to what the weights carried of their sensor.
            before = self.weights.training.get(name, {})
            of_frame = {key: before[key] for key in FRAME if key in before}
            training[name] = {**of_stage, **of_frame, "adapted": record}
        after = dataclasses.replace(trained, training=training)

        self._draw(after)
        with atomic_write(self.out / REPORT) as part:
            part.write_text(json.dumps({**record, "told": self._told(final)}, indent=2))
        path = save(after, self.out / "weights.safetensors")
        self.options.say(
            f"uncertain points: {start.uncertain:.1%} before, {final.uncertain:.1%} after; "
            f"pictures in {self.out / 'pictures'}"
        )
        return path

    def _draw(self, after: Weights) -> None:
        """Draw the labels of some scans before and after."""
        device = device_of(self.recipe.training.accelerator)
        segmenters = {}
        for title, weights in (("before", self.weights), ("after", after)):
            segmenter = Segmenter(weights, device, widest_method(weights.parts))
            segmenters[title] = segmenter.for_dataset(self.targets.kept)

        records = self.targets.kept.records()
        named = list(zip(records, self.targets.scans, strict=True))
        for record, source in evenly_spaced(named, PICTURES):
            scan = self.targets.kept.read(record)
            labels = {title: segmenter(scan).labels for title, segmenter in segmenters.items()}
            view = TopView(scan.points, self.weights.taxonomy, labels, title=source.title)
            draw_scan(self.out / "pictures" / f"{record.name}.png", view)

    def _told(self, look: Look) -> dict[str, dict[str, float | bool]]:
        """Return what is trusted of each class, for the report."""
        classes = {}
        for index, name in enumerate(self.weights.taxonomy.classes):
            classes[name] = {
                "told": bool(look.trusted.told[index]),
                "threshold": round(float(look.trusted.thresholds[index]), 4),
                "points": int(look.trusted.counts[index]),
            }
        return classes

    def _describe(self, look: Look) -> str:
        """Return how sure some weights are."""
        labelled = 0
        points = 0
        for scan, ids in zip(look.opinions, look.pseudo_labels, strict=True):
            labelled += int(np.count_nonzero(ids))
            points += int(np.count_nonzero(scan.labels))
        return (
            f"{look.uncertain:.1%} of the points are uncertain, {labelled / max(points, 1):.0%} "
            f"have a pseudo-label{untold_text(look.trusted, self.weights.taxonomy)}"
        )
