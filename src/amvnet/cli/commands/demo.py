"""The command `demo`."""

from __future__ import annotations

from itertools import chain, islice
from pathlib import Path

from amvnet.cli.commands.evaluate import show_evaluation
from amvnet.cli.console import progress, report, report_lines
from amvnet.config.bounds import Seed
from amvnet.sensors.lidars import AUTO

SEED = 20_201_209  # the default seed, far from the seeds of the built-in weights' training streets
SCANS = 2  # number of scans of each street
# Number of streets. AMVNet leads the ensemble by 1.7 mIoU, with a standard deviation of 0.5 over
# draws of 20 streets, and of 1.0 over draws of 3.
SEQUENCES = 20
FIRST = 4  # number of scans that the page shows at first
CAPTION = """\
RV and BEV are the two networks, and the ensemble is their mean.
In AMVNet, a small head decides where the networks disagree.
IoU says how well a class is found; accuracy is the share of points with the right label."""


def demo(
    out: Path = Path("demo"), seed: Seed = SEED, weights: str = AUTO, overwrite: bool = False
) -> None:
    """Simulate streets, segment them, score the labels, and write a page that shows them in 3D.

    Args:
        out: folder for the scans, the page (index.html) and the scores (metrics.json).
        seed: the seed of the streets; the built-in weights have not seen the default streets.
        weights: a weights file, the name of built-in weights, or auto, for those of the lasers of
            SemanticKITTI.
        overwrite: replace the page and the scores if they exist.
    """
    from amvnet.data.datasets.simulated import simulate
    from amvnet.data.taxonomy import CLASSES_BY_SENSOR, SEMANTICKITTI
    from amvnet.errors import InputError
    from amvnet.evaluation.metrics import REPORT
    from amvnet.files import check_outputs
    from amvnet.inference.listing import find_inputs
    from amvnet.inference.loading import load
    from amvnet.sensors.built_in import lasers_of, weights_for
    from amvnet.viewing.page import PAGE, write_page
    from amvnet.viewing.shown_scans import show_scans

    page = out / "index.html"
    metrics_path = out / "metrics.json"
    check_outputs({page: PAGE, metrics_path: REPORT}, [weights], overwrite)
    if weights == AUTO:
        weights, _ = weights_for(lasers_of(SEMANTICKITTI))
    segmenter = load(weights)
    classes = segmenter.taxonomy.classes
    sensors = [name for name, taxonomy in CLASSES_BY_SENSOR.items() if taxonomy.classes == classes]
    if not sensors:
        raise InputError(
            f"--weights {weights}: expected the classes of SemanticKITTI or nuScenes, which "
            f"simulated streets have, found {', '.join(classes)[:200]}; use amvnet view and "
            "amvnet evaluate on scans with these classes"
        )
    # Each seed has its own folder: in a common folder, streets of several seeds would be read as
    # one dataset.
    data = out / "data" / f"{sensors[0]}-{seed}"
    with progress("simulating") as step:
        simulate(
            data, sensor=sensors[0], sequences=SEQUENCES, scans=SCANS, seed=seed, progress=step
        )

    scans, taxonomy = find_inputs([str(data)]).scans(taxonomy=segmenter.taxonomy)
    with progress("segmenting") as step:
        shown = show_scans(scans, segmenter, progress=step)
        first = list(islice(shown, FIRST))
        write_page(page, first, taxonomy, "Simulated streets")
        report(f"open {page} in a browser: it shows {FIRST} scans, and all of them at the end")
        evaluation = write_page(page, chain(first, shown), taxonomy, "Simulated streets")
    show_evaluation(evaluation, "simulated streets", metrics_path)
    report_lines(CAPTION)
    report(f"labelled scans in {data}, scores in {metrics_path}; open {page} in a browser")
