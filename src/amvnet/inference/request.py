"""A user's request: how scans are labelled, and which files are written for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from amvnet.data.class_maps import ClassMap
from amvnet.data.recordings import ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.engines.compute import EngineName, Precision
from amvnet.files import digest, size_and_time
from amvnet.inference.drive import Drives
from amvnet.inference.pipeline import LABELS, LabelFiles, OutputOptions
from amvnet.models.assertion import Disagreement
from amvnet.models.methods import MethodName, check_method, check_two_networks
from amvnet.sensors.reading import AS_FOUND, Reading
from amvnet.weights.file import Weights


@dataclass(frozen=True)
class LabellingRequest:
    """A request for labels: it holds all that label files depend on, except the scans themselves.

    Attributes:
        method, tau, precision: as `amvnet.load` takes them.
        reading: how scan files are read.
        classes: maps the classes of the weights to the classes that are written. By default, the
            classes of the weights are written.
        files: which files are written for each scan.
        drive: the digest of the poses by which scores are fused over time; None if they are not.

    Raises:
        InputError: if the weights lack a part that the method needs, the method has no uncertain
            points to choose by `tau` or to write, `classes` names no class of the weights, or `tau`
            is out of range.
    """

    weights: Weights
    method: MethodName = "amvnet"
    tau: float | None = None
    precision: Precision = "auto"
    engine: EngineName = "torch"
    reading: Reading = AS_FOUND
    classes: ClassMap | None = None
    files: LabelFiles = LABELS
    drive: str | None = None

    def __post_init__(self) -> None:
        check_method(self.method, self.weights.parts)
        if self.tau is not None:
            Disagreement(self.tau)
            check_two_networks(self.method, "--tau")
        if self.files.uncertain:
            check_two_networks(self.method, "--uncertain")
        if self.classes is not None:
            self.classes.table(self.weights.taxonomy)

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes that are written."""
        return self.weights.taxonomy if self.classes is None else self.classes.target

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The request in JSON types; only a run with equal settings may be resumed."""
        weights = self.weights.digests()
        # These decide labels by the same parameters.
        model = self.weights.model
        for name, value in (("lead", model.assertion.lead), ("cell", model.point_head.cell)):
            if value:
                weights[name] = str(value)
        return {
            "weights": weights,
            "method": self.method,
            "precision": self.precision,
            # All other engines give equal labels.
            "engine": "int8" if self.engine == "int8" else None,
            "tau": self.tau,
            "sensor": repr(self.reading.sensor),
            "topic": self.reading.topic,
            "layout": repr(self.reading.layout),
            "classes": None if self.classes is None else repr(self.classes),
            "scores": self.files.scores,
            "uncertain": self.files.uncertain,
            "format": self.files.kind,
            "drive": self.drive,
        }

    def digest_of(self, scans: Sequence[ScanFile], drives: Drives | None) -> str:
        """Return a digest of all that the scores of some scans depend on, and of their poses."""
        stamps = {path: size_and_time(path) for path in {scan.path for scan in scans}}
        files = [
            (scan.recording.name, scan.name, scan.dataset.reading, stamps[scan.path])
            for scan in scans
        ]
        settings = self.settings | {"engine": self.engine}  # which rounds scores in its own way
        return digest(repr((files, None if drives is None else drives.digest, settings)))

    def output(
        self,
        folder: Path,
        overwrite: bool = False,
        resume: bool = False,
        also_read: Sequence[Path | str | None] = (),
    ) -> OutputOptions:
        """Return which files are written for each scan, and into which folder."""
        written = None if self.classes is None else self.classes.target
        return OutputOptions(folder, self.files, written, overwrite, resume, also_read)
