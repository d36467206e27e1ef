"""Decide what the networks of a training expect of a scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from contextlib import suppress

from amvnet.config.schema import BOTH_NETWORKS, NETWORK_STAGES, PART_OF, Recipe, StageName
from amvnet.data.datasets.training_data import TrainingData
from amvnet.data.recordings import evenly_spaced
from amvnet.errors import InputError
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation, trained_sensor
from amvnet.sensors.intensity import (
    NO_INTENSITY,
    TrainedIntensity,
    are_quantiles,
    mean_quantiles,
    simulated_quantiles,
)
from amvnet.sensors.lasers import measure_sensor
from amvnet.sensors.lidars import ANY
from amvnet.sensors.normalise import Normaliser
from amvnet.weights.file import Weights

# Largest number of scans that are measured; it is enough for the mean height of simulated sensors.
SAMPLED_SCANS = 60
# Networks need no intensity if they were trained with this share of their scans without it.
BLIND_SHARE = 0.2


def expectation_of(
    data: TrainingData, weights: Weights, recipe: Recipe, stages: Sequence[StageName]
) -> Expectation:
    """Return what networks expect after the training of some stages."""
    if set(BOTH_NETWORKS) & set(weights.parts) and not _networks(stages):
        return weights.expects  # a head takes what its networks take
    found = measured(data, weights.expects, recipe.sensor)
    return with_options(found, weights.parts, recipe, stages)


def with_options(
    known: Expectation, parts: Collection[str], recipe: Recipe, stages: Sequence[StageName]
) -> Expectation:
    """Return what networks expect that are trained with the view and augmentation of a recipe.

    If the augmentation often hides the intensities, the networks learn to do without them. A
    network that stays as it is does not.

    Args:
        parts: the parts to begin with.
    """
    hides = recipe.training.augment.no_intensity >= BLIND_SHARE
    trained = _networks(stages)
    stay = not trained or set(BOTH_NETWORKS) & set(parts) - trained
    intensity = known.intensity
    if intensity is not None and hides and not stay:
        intensity = dataclasses.replace(intensity, is_optional=True)
    sensor = known.sensor
    if recipe.sensor == ANY:
        sensor = dataclasses.replace(sensor, name=ANY)
    return dataclasses.replace(
        known, view=recipe.model.range_view, sensor=sensor, intensity=intensity
    )


def measured(data: TrainingData, known: Expectation, sensor: str) -> Expectation:
    """Return what is known of the scans that networks expect, as measured on scans to train on.

    Args:
        known: what is expected of scans before they are measured.
        sensor: the name of their sensor.
    """
    first = data.sources[0].dataset
    sampled = _sample(data)
    as_is = True
    geometry = measure_sensor(sampled)
    if isinstance(first.normalise, Normaliser):
        # The weights will get scans that are normalised in the same way.
        known = first.normalise.expected or known
        as_is = False
        geometry = first.normalise.target()

    intensity = known.intensity
    is_optional = intensity is not None and intensity.is_optional
    if first.simulated_sensor:
        simulated = simulated_quantiles(first.simulated_sensor)
        intensity = TrainedIntensity(simulated, is_optional, is_matched=True)
    elif intensity is None or (as_is and not intensity.is_matched):
        quantiles = mean_quantiles(sampled)
        if quantiles == NO_INTENSITY or are_quantiles(quantiles):
            intensity = TrainedIntensity(quantiles, is_optional)

    trained = trained_sensor(sensor, geometry)
    return dataclasses.replace(known, sensor=trained, intensity=intensity, as_is=as_is)


def _networks(stages: Sequence[StageName]) -> set[str]:
    """Return the parts of the networks that some stages train."""
    return {PART_OF[name].name for name in NETWORK_STAGES if name in stages}


def _sample(data: TrainingData) -> list[Scan]:
    """Read some of the first source's scans, but no broken ones, which the training reports."""
    sample = []
    for index in evenly_spaced(range(data.places[0]), SAMPLED_SCANS):
        with suppress(InputError):
            sample.append(data.read(index, labels=False))
    return sample
