"""The verb `adapt`."""

from __future__ import annotations

from pathlib import Path

from amvnet.cli.console import on_terminal, progress, say
from amvnet.cli.options import WEIGHTS, Split, parse_names, refuse_other_formats


def adapt(
    inputs: list[str],
    out: Path,
    weights: str = WEIGHTS,
    recipe: str = "adapt",
    resume: bool = False,
    split: Split = "all",
    sequences: str | None = None,
    topic: str | None = None,
    columns: str | None = None,
    dtype: str | None = None,
    sensor: str | None = None,
    height: float | None = None,
    intensity_scale: float | None = None,
    unit: str | None = None,
    axes: str | None = None,
    rotate: str | None = None,
    offset: str | None = None,
) -> None:
    """Adapt weights to your scans, without labels.

    Args:
        inputs: datasets, scan files, bags, folders of these, or patterns such as 'drive/*.bin';
            their labels, if they have any, are not read.
        out: folder of the run; the weights are in it at the end.
        weights: weights with both networks to begin with, or the name of built-in ones.
        recipe: the recipe of the rounds; a YAML file with `base: adapt` changes it.
        resume: continue an earlier run in the folder.
        split: of datasets, the official split.
        sequences: of datasets, these sequences or scenes instead, separated by commas.
        topic: of bags, the topic of the scans; default: the only one with scans.
        columns: of .bin, .npy and text files, what their columns hold, as of predict.
        dtype: of .bin files, the type of the numbers, as of predict.
        sensor: of scan files, a LiDAR's name (vlp16, os1-64, ...) or a YAML file; default:
            measured.
        height: of scan files, the sensor's height over the ground in metres; default: measured.
        intensity_scale: of scan files, the largest possible intensity; default: as the values
            suggest.
        unit: of scan files, m, cm, mm or ft; default: as of predict.
        axes: of scan files, x-forward (y left), y-forward (x right), z-forward (y down), z-down
            (y right) or y-up (x right); default: as of predict.
        rotate: of scan files, the rotation that levels them: yaw,pitch,roll in degrees; default: as
            of predict.
        offset: of scan files, what to add to x,y,z after the rotation, in metres.
    """
    refuse_other_formats(inputs)
    from amvnet.adaptation.adapt import Adaptation, AdaptOptions
    from amvnet.config.recipes import load_recipe
    from amvnet.data.formats.rows import parse_layout
    from amvnet.inference.inputs import ScanOptions, adapter_for, open_inputs
    from amvnet.sensors.lidars import make_sensor
    from amvnet.training.fit import quiet_lightning
    from amvnet.training.run_plan import sized_by_init
    from amvnet.weights.file import load

    quiet_lightning()
    given_sensor = make_sensor(
        sensor,
        height=height,
        intensity_scale=intensity_scale,
        unit=unit,
        axes=axes,
        rotate=rotate,
        offset=offset,
    )
    start = load(weights)
    sized = sized_by_init(load_recipe(recipe), start)
    options = ScanOptions(parse_names(sequences), split, topic, parse_layout(columns, dtype))
    adapter = adapter_for(start, given_sensor, say)
    opened = open_inputs(inputs, options, start.taxonomy, adapter)

    how = AdaptOptions(resume, say, progress, on_terminal())
    path = Adaptation(start, opened.scans, sized, out, how).run()
    say(f"weights in {path}")
