"""The command `fleet`."""

from __future__ import annotations

from amvnet.cli.console import progress, report
from amvnet.cli.options import LabelChoice, ScanChoice, SensorChoice
from amvnet.config.bounds import Count
from amvnet.engines.compute import Compute
from amvnet.errors import counted, import_optional
from amvnet.sensors.lidars import AUTO


def fleet(
    inputs: list[str],
    /,
    out: str,
    sensor_choice: SensorChoice,
    compute: Compute,
    labels: LabelChoice,
    weights: str = AUTO,
    columns: str | None = None,
    dtype: str | None = None,
    batch: Count = 1,
    resume: bool = False,
    address: str | None = None,
    workers: Count | None = None,
) -> None:
    """Label scans in object storage on a Ray cluster, and write a table of results.

    Args:
        inputs: folders of scan files, scan files, or manifests (.parquet, .csv): URLs or paths.
        out: folder for the labels, a URL or a path; it must be new unless --resume is given.
        sensor_choice: what is known about the sensor of scan files.
        compute: where and how the networks are computed.
        labels: how points are labelled, and which files are written.
        weights: a weights file, the name of built-in weights, or auto, for the built-in weights
            that suit the lasers of the first drive.
        columns: the columns of .bin, .npy and text files in their order, as predict takes them.
        dtype: the type of the numbers in .bin files, as predict takes it.
        batch: number of scans that go through the networks together; more than one suits a GPU.
        resume: continue an earlier run in the folder, with the same weights and options; label only
            scans that are new, that failed or whose labels are missing.
        address: address of the Ray cluster: auto, ray://HOST:10001, ...; default: start Ray on this
            machine.
        workers: largest number of workers; default: one for each GPU, or for each 4 cores.
    """
    from amvnet.weights.file import load

    pipeline = import_optional("amvnet.fleet.pipeline", "fleet")
    reading = ScanChoice(columns=columns, dtype=dtype).reading(sensor_choice)
    if weights == AUTO:
        weights, reason = pipeline.choose_weights(inputs, out, reading)
        report(f"weights {weights}, {reason}")
    request = labels.parse(load(weights), reading, compute)
    with progress("labelling") as step:
        written = pipeline.label_fleet(
            inputs,
            request,
            out,
            pipeline.Cluster(address, workers, compute, batch),
            resume=resume,
            progress=step,
            report=report,
        )
    report(f"{counted(written, 'label file')} in {out}; the table of results is in {out}/results")
