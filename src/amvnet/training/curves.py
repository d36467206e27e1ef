"""Draw the curves of a training: the loss, the mIoU by epoch and the IoU by class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from amvnet.data.taxonomy import Taxonomy
from amvnet.files import atomic_write

ROW_SIZE = (12.0, 3.6)  # width and height of the row of a stage, inches
DOTS_PER_INCH = 120
MAX_MARKED = 30  # only curves with fewer points have markers

# Names of the metrics in TensorBoard's files.
LOSS = "train/loss"
EPOCHS = "train/epochs"  # the number of epochs that are done, with the loss
MIOU = "val/miou"
CLASS_IOU = "iou/"  # followed by the name of the class


@dataclass(frozen=True)
class Curves:
    """The metrics that a stage logged.

    Attributes:
        loss: the epoch and the loss of each logged step. An epoch of 1.0 is the end of the first.
        miou: the mIoU of each validation, in [0, 1].
        iou: the IoU of each class at the last epoch, in [0, 1], in the order of the classes. Absent
            classes are left out.
    """

    loss: Sequence[tuple[float, float]]
    miou: Sequence[float]
    iou: Mapping[str, float]


def read_curves(folder: Path, taxonomy: Taxonomy) -> Curves:
    """Read the curves of a stage from its folder's TensorBoard files; they may lack metrics."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    names = set(events.Tags()["scalars"])

    def by_step(name: str) -> dict[int, float]:
        # A resumed run repeats the steps after its checkpoint. The last value counts.
        return {event.step: event.value for event in events.Scalars(name)} if name in names else {}

    losses, epochs, validated = by_step(LOSS), by_step(EPOCHS), by_step(MIOU)
    loss = [(epochs[step], losses[step]) for step in sorted(losses.keys() & epochs.keys())]
    miou = [validated[step] for step in sorted(validated)]
    iou = {}
    for name in taxonomy.classes:
        values = by_step(f"{CLASS_IOU}{name}")
        if values and max(values) == max(validated, default=-1):
            iou[name] = values[max(values)]
    return Curves(loss, miou, iou)


def draw_curves(stages: Mapping[str, Curves], path: Path) -> Path:
    """Draw the curves of stages, a row of three diagrams for each, into a PNG; return its path."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    width, height = ROW_SIZE
    figure = Figure(figsize=(width, height * len(stages)), layout="constrained")
    rows = figure.subplots(len(stages), 3, squeeze=False)
    for (name, curves), (loss, miou, iou) in zip(stages.items(), rows, strict=True):
        if curves.loss:
            marker = "." if len(curves.loss) < MAX_MARKED else ""
            loss.plot(*zip(*curves.loss, strict=True), color="black", linewidth=1, marker=marker)
        loss.set_xlim(left=0)
        _label(loss, f"{name}: loss", "epoch")

        epochs = range(1, len(curves.miou) + 1)
        miou.plot(epochs, [100 * value for value in curves.miou], color="black", marker=".")
        miou.xaxis.set_major_locator(MaxNLocator(integer=True))
        _label(miou, f"{name}: validation mIoU (%)", "epoch")
        miou.set_ylim(bottom=0)

        names = list(curves.iou)[::-1]  # the first class at the top
        titles = [key.replace("$", "\\$") for key in names]  # Matplotlib draws $...$ as formulas
        iou.barh(titles, [100 * curves.iou[key] for key in names], color="0.55")
        iou.tick_params(axis="y", labelsize=7)
        _label(iou, f"{name}: IoU by class (%), last epoch", "")
        iou.set_xlim(0, 100)

    with atomic_write(path) as part:
        figure.savefig(part, dpi=DOTS_PER_INCH)
    return path


def _label(axes: Any, title: str, x: str) -> None:
    axes.set_title(title, fontsize=10)
    axes.set_xlabel(x)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
