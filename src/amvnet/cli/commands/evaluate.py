"""The command `evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from amvnet.cli import options
from amvnet.cli.console import progress, report, show
from amvnet.config.bounds import Share
from amvnet.engines.compute import Compute, choose_device
from amvnet.errors import InputError
from amvnet.models.methods import PAPER_METHODS, MethodName, check_method, methods_of, widest_method
from amvnet.sensors.lidars import AUTO

if TYPE_CHECKING:
    from amvnet.data.datasets.base import Dataset
    from amvnet.data.recordings import ScanFile
    from amvnet.evaluation.metrics import Evaluation
    from amvnet.inference.drive import Drives


def evaluate(
    data: str,
    /,
    choice: options.LabelledChoice,
    compute: Compute,
    drive_choice: options.DriveChoice,
    weights: str | None = None,
    predictions: Path | None = None,
    methods: tuple[MethodName, ...] = PAPER_METHODS,
    tau: Share | None = None,
    json: Path | None = None,
    pictures: Path | None = None,
    classes: str | None = None,
    overwrite: bool = False,
) -> None:
    """Score weights, or predictions of any tool, by the benchmark's official formulas.

    Args:
        data: the dataset.
        choice: which scans to score.
        compute: where and how the networks are computed.
        drive_choice: with --weights, whether to also score the fusion over time, as the method
            drive.
        weights: a weights file, or the name of built-in weights; default: the built-in weights that
            suit the lasers.
        predictions: a folder of predictions in the benchmark's layout, instead of weights.
        methods: with --weights, the methods to score, separated by commas; rv-knn is rv with a vote
            of neighbours in the range image, arithmetic and maximum are the other ensembles.
        tau: a point goes to the head if the cosine similarity of the two networks' probabilities is
            at most this value, in [0, 1]; a lower value takes less time; default: the value in the
            weights.
        json: file for all figures.
        pictures: folder for drawings of some scans from above.
        classes: the classes to score instead of the dataset's: coarse, lidog, or a YAML file that
            maps the classes of the data and of the weights to them.
        overwrite: replace figures and drawings that exist.
    """
    from amvnet.data.datasets.open import open_dataset
    from amvnet.evaluation.metrics import REPORT
    from amvnet.evaluation.scoring import evaluate as evaluate_records
    from amvnet.evaluation.scoring import label_by_weights, label_from_files, pictures_of
    from amvnet.files import check_outputs, make_folder

    def check_files(records: Sequence[ScanFile]) -> None:
        """Check that all files can be written, before time is spent on networks and scans."""
        outputs = {} if pictures is None else pictures_of(records, pictures)
        if json is not None:
            outputs[json] = REPORT
        check_outputs(outputs, [data, weights, classes], overwrite)

    processes = options.join_processes()
    drives = None
    if weights is not None and predictions is not None:
        raise InputError("expected --weights or --predictions, found both; give one of them")
    if predictions is None:
        weights, loaded, dataset = options.load_dataset(data, weights or AUTO, classes is not None)
        mapping = options.map_to(classes, loaded.taxonomy, dataset.taxonomy)
        records = choice.records(dataset)
        check_files(records)
        drives = _find_drives(drive_choice, dataset, records, processes.size)
        _check_methods(methods, weights, loaded.parts)
        # The head runs only if AMVNet is among the methods.
        parts = [part for part in loaded.parts if part != "point_head" or "amvnet" in methods]
        device = processes.device(choose_device(compute.device, compute.engine))
        compute = replace(compute, device=device)
        segmenter = options.load_segmenter(loaded, widest_method(parts), compute, tau)
        labeller = label_by_weights(segmenter, methods, mapping)
    else:
        for flag, is_given in (("--tau", tau is not None), ("--drive", drive_choice.drive)):
            if is_given:
                raise InputError(
                    f"{flag}: expected --weights, found --predictions; leave {flag} out"
                )
        dataset = open_dataset(data)
        mapping = options.map_to(classes, dataset.taxonomy)
        records = choice.records(dataset)
        check_files(records)
        labeller = label_from_files(dataset, predictions, mapping)

    for path in filter(None, (json, pictures)):
        make_folder(path.parent)
    # Another process might take a drawing of this run for one that existed before.
    processes.wait()
    with progress("scoring") as step:
        evaluation = evaluate_records(
            dataset, records, labeller, pictures, step, processes, drives, report
        )
    if processes.first:
        show_evaluation(evaluation, data, json, tau)


def _find_drives(
    choice: options.DriveChoice, dataset: Dataset, records: Sequence[ScanFile], processes: int
) -> Drives | None:
    """Return the poses of the scans, if their scores are to be fused over time.

    Raises:
        InputError: if several processes would share the scans, or there are no poses that fit.
    """
    from amvnet.inference.drive import find_poses

    drive = choice.parse()
    if drive is None:
        return None
    if processes > 1:
        raise InputError("--drive: expected one process, found several; start it without torchrun")
    with progress("poses") as step:
        return find_poses(records, drive.poses, drive.past_only, progress=step, report=report)


def _check_methods(methods: tuple[MethodName, ...], weights: str, parts: tuple[str, ...]) -> None:
    """Report the methods for which the weights lack parts.

    Raises:
        InputError: if they lack parts for all methods.
    """
    scored = methods_of(parts, methods)
    if not scored:
        check_method(methods[0], parts)  # raises
    left_out = [name for name in methods if name not in scored]
    if left_out:
        report(f"not scored: {', '.join(left_out)}, because {weights} has only {', '.join(parts)}")


def show_evaluation(
    evaluation: Evaluation, dataset: str, path: Path | None, tau: float | None = None
) -> None:
    """Print the table of an evaluation, and write its figures as JSON if there is a path.

    Args:
        dataset: the name of the dataset, for the title.
        tau: the threshold of the assertion if the user chose it.
    """
    from amvnet.cli.tables import evaluation_table
    from amvnet.files import write_json

    figures = evaluation.report(dataset)
    if tau is not None:
        figures["tau"] = tau
    show(evaluation_table(figures, evaluation.taxonomy))
    if path is not None:
        write_json(path, figures)
