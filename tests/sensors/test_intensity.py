"""Intensities of any range reach the networks as those of their training did."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import amvnet
from amvnet.config.schema import PARTS, RangeViewConfig, Recipe
from amvnet.data.datasets.semantickitti import SemanticKitti
from amvnet.data.datasets.training_data import Source, TrainingData
from amvnet.data.formats.cloud import WILD_SHARE, Cloud
from amvnet.data.recordings import Recording, ScanFile
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.intensity import (
    PROBABILITIES,
    SIMULATED_QUANTILES,
    TrainedIntensity,
    fill_intensity,
    intensity_map,
    match_scan,
    matching,
)
from amvnet.sensors.lidars import UNKNOWN_SENSOR, Sensor, rotation_from_degrees
from amvnet.sensors.measure import MEASURED_SCANS, Measured
from amvnet.sensors.normalise import Normaliser
from amvnet.training.expectation import expectation_of
from amvnet.weights.file import Weights

from fixtures import tiny
from fixtures.commands import fails, not_none
from fixtures.sensors import LASERS, ground_height, place
from fixtures.tiny import fresh_weights, with_intensities, write_scan

TRAINED = np.array(SIMULATED_QUANTILES["hdl64e"])


def scan_points(height: float = 1.73, seed: int = 0) -> np.ndarray:
    """Return a scan whose intensities are distributed nearly as in the training."""
    points, _ = place(LASERS["os1-64"], height, seed=seed)
    draws = np.random.default_rng(seed).random(len(points))
    points[:, 3] = np.interp(draws, PROBABILITIES, TRAINED) ** 1.1
    return points


def weights_with(**how: bool) -> Weights:
    """Return weights that were trained with the intensities of simulated scans."""
    weights = tiny.trained_for(fresh_weights(), "hdl64e")
    return with_intensities(weights, SIMULATED_QUANTILES["hdl64e"], **how)


def normalise(
    clouds: list[Cloud], sensor: Sensor = UNKNOWN_SENSOR, **how: bool
) -> tuple[list[Scan], list[str]]:
    lines: list[str] = []
    recording = Normaliser(weights_with(**how).expects, sensor, lines.append)(Recording("a"))
    return [recording.to_scan(cloud) for cloud in clouds], lines


def quantile_gap(intensity: np.ndarray) -> float:
    """Return by how much the quarters of intensities differ from those of the training."""
    return float(np.abs(np.quantile(intensity, (0.25, 0.5, 0.75)) - TRAINED[4:7]).max())


def test_intensities_like_those_of_the_training_stay_as_they_are() -> None:
    points = scan_points()
    (scan,), _ = normalise([Cloud(points[:, :3], points[:, 3], name="a")])
    np.testing.assert_array_equal(scan.points[:, 3], points[:, 3])


@pytest.mark.parametrize(
    "change",
    [
        lambda values: values * np.float32(0.01),
        lambda values: values * 255,
        lambda values: (values * 255).astype(np.uint8),
        lambda values: (values * 65535).astype(np.uint16),
        lambda values: (values * 6000).astype(np.uint16),  # 16 bits, nearly all dark
        lambda values: values * 1e9,
    ],
)
def test_all_intensities_become_the_trainings(change: Callable[[np.ndarray], np.ndarray]) -> None:
    points = scan_points()
    (scan,), _ = normalise([Cloud(points[:, :3], change(points[:, 3]), name="a")])
    intensity = scan.points[:, 3]
    assert quantile_gap(intensity) < 0.05
    assert 0 <= intensity.min() < intensity.max() <= 1
    assert np.corrcoef(intensity, points[:, 3])[0, 1] > 0.99


@pytest.mark.parametrize("scale", [1, 255])
def test_one_wild_value_changes_nothing_else(scale: int) -> None:
    points = scan_points()
    intensity = scale * points[:, 3]
    wild = intensity.copy()
    wild[7] = 300 * scale

    (expected,), _ = normalise([Cloud(points[:, :3], intensity, name="a")])
    (scan,), _ = normalise([Cloud(points[:, :3], wild, name="a")])
    is_other = np.arange(len(points)) != 7
    np.testing.assert_array_equal(scan.points[is_other], expected.points[is_other])
    assert scan.points[7, 3] == 1


def test_a_scale_that_the_user_gives_is_all_that_is_done() -> None:
    points = scan_points()
    (scan,), lines = normalise(
        [Cloud(points[:, :3], 40 * points[:, 3], name="a")], Sensor(intensity_scale=1000)
    )
    np.testing.assert_allclose(scan.points[:, 3], 0.04 * points[:, 3], rtol=1e-6)
    assert "0 to 1000" in lines[0]


def test_medians_below_one_step_of_8_bits_are_alike() -> None:
    trained = np.linspace(0, 1, len(PROBABILITIES)) ** 8
    darker = np.where(trained < 0.004, 0, trained)
    assert (darker == 0).sum() > len(PROBABILITIES) / 2
    known = TrainedIntensity(tuple(trained.tolist()))
    assert intensity_map(darker, 1.0, known).matched is None
    assert intensity_map(darker / 3, 1.0, known).matched is not None


def test_few_missing_intensities_are_judged_without_lost_returns() -> None:
    """Those of lost returns mean nothing."""
    points = np.zeros((1000, 4), np.float32)
    points[:100] = (1, 2, 3, 0.5)
    points[:20, 3] = np.nan
    filled, text = fill_intensity(Scan(points), None)
    assert (filled.points[:100, 3] == 0.5).all()
    assert "20 %" in text

    points[:60, 3] = np.nan  # most of those that are placed
    filled, _ = fill_intensity(Scan(points), None)
    assert (filled.points[:, 3] == 0).all()


@pytest.mark.parametrize("intensity", [None, 0.0, 0.15, 255, np.nan])
@pytest.mark.parametrize("is_optional", [False, True])
def test_missing_intensities_suit_the_weights(intensity: float | None, is_optional: bool) -> None:
    xyz = scan_points()[:, :3]
    values = None if intensity is None else np.full(len(xyz), intensity)

    (scan, again), lines = normalise([Cloud(xyz, values, name="a")] * 2, is_optional=is_optional)
    assert scan.valid.all()
    np.testing.assert_array_equal(scan.points, again.points)
    if is_optional:
        assert (scan.points[:, 3] == 0).all()
    else:
        assert quantile_gap(scan.points[:, 3]) < 0.02
        assert "much worse" in lines[0]


def test_scans_of_several_sensors_in_a_source_are_measured_one_by_one() -> None:
    clouds = []
    for seed, (height, scale) in enumerate(((1.73, 1), (1.0, 255), (2.5, 255), (1.73, 1))):
        points = scan_points(height, seed)
        clouds.append(Cloud(points[:, :3], scale * points[:, 3], name=f"scan {seed}"))

    lines: list[str] = []
    normaliser = Normaliser(weights_with().expects, report=lines.append)
    recording = Recording("a")
    for cloud in clouds:
        read = partial(replace, cloud)
        recording.scans.append(ScanFile(cloud.name, recording, Path(cloud.name), read=read))
    drive = normaliser(recording)
    for cloud in clouds:
        alone, _ = normalise([cloud])
        scan = drive.to_scan(cloud)
        np.testing.assert_array_equal(scan.points, alone[0].points)
        np.testing.assert_array_equal(scan.row, alone[0].row)
        assert ground_height(scan.points) == pytest.approx(1.73, abs=0.05)
    assert len(lines) == 3  # one of each sensor
    assert all("a has scans of other sensors" in line for line in lines)


@pytest.mark.parametrize(
    "values",
    [
        "x" * 11,
        [0.1, 0.2],
        [1.0] * 10 + [0.0],
        [0.5] * 11,
        [-0.5, *np.linspace(0.1, 1, 10)],
        [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, True],
        [*np.linspace(0.1, 1, 10), np.nan],
    ],
)
def test_quantiles_that_no_intensities_have_are_refused(values: Any) -> None:
    tree = weights_with().expects.to_dict()
    tree["intensity"]["quantiles"] = values
    fails(lambda: Expectation.from_dict(tree, RangeViewConfig()), "11 quantiles", "not all equal")


def measured_intensity(data: SemanticKitti, sequences: Sequence[str]) -> TrainedIntensity | None:
    """Return the intensities that networks expect which are trained on a dataset from scratch."""
    scans = TrainingData([Source(data, data.records(sequences))])
    weights = tiny.without(fresh_weights(), *PARTS)
    return expectation_of(scans, weights, Recipe(), ("rv", "bev")).intensity


def test_scans_without_intensities_have_zeros_and_equal_ones_are_left_out(tmp_path: Path) -> None:
    none = TrainedIntensity((0.0,) * len(PROBABILITIES))
    for level, expected in ((0.0, none), (0.5, None)):
        root = tmp_path / f"{level}"
        for index in range(2):
            points, raw = tiny.street(index)
            points[:, 3] = level
            write_scan(root, "00", f"{index:06d}", points, raw)
        assert measured_intensity(SemanticKitti(root), ["00"]) == expected

    fails(lambda: replace(none, is_matched=True), "quantiles")


def test_training_measures_the_intensities_that_weights_carry(tmp_path: Path) -> None:
    data = SemanticKitti(tiny.make_streets(tmp_path, ("00", "01"), 2))
    records = data.records(("00", "01"))
    intensity = measured_intensity(data, ("00", "01"))

    each = [np.quantile(data.read(record).points[:, 3], PROBABILITIES) for record in records]
    assert intensity is not None
    np.testing.assert_allclose(intensity.quantiles, np.mean(each, axis=0), atol=1e-4)


def test_the_segmenter_refuses_intensities_out_of_range_and_clips_outliers() -> None:
    points = scan_points()
    segmenter = amvnet.load(weights_with())
    wrong = points * np.array([1, 1, 1, 255], np.float32)
    fails(lambda: segmenter(wrong), "[0, 1]", "divide")

    wild = points.copy()
    wild[7, 3] = 300
    clipped = points.copy()
    clipped[7, 3] = 1
    np.testing.assert_array_equal(segmenter(wild).labels, segmenter(clipped).labels)
    assert wild[7, 3] == 300

    many = scan_points()
    many[: round(2 * WILD_SHARE * len(many)) + 1, 3] = 300
    fails(lambda: segmenter(many), "[0, 1]", "divide")

    raw = with_intensities(fresh_weights(), np.linspace(0, 255, 11).tolist())
    assert len(amvnet.load(raw)(wrong).labels) == len(points)


@pytest.mark.parametrize(
    "change", [lambda i: i, lambda i: i / 100, lambda i: 1 - 0.5 * (1 - i) ** 2]
)
def test_a_matched_scan_has_the_intensities_of_the_training_in_the_same_order(
    change: Callable[[np.ndarray], np.ndarray],
) -> None:
    points = scan_points()
    points[:, 3] = change(points[:, 3])
    points[7, 0] = np.nan
    scan = match_scan(Scan(points), SIMULATED_QUANTILES["hdl64e"])

    valid = scan.valid
    found = np.quantile(scan.points[valid, 3], PROBABILITIES)
    np.testing.assert_allclose(found, SIMULATED_QUANTILES["hdl64e"], atol=0.01)
    order = np.argsort(points[valid, 3], kind="stable")
    assert (np.diff(scan.points[valid, 3][order]) >= 0).all()
    np.testing.assert_array_equal(scan.points[:, :3], points[:, :3])
    assert scan.points[7, 3] == points[7, 3]


def test_a_scan_without_intensity_is_not_matched() -> None:
    points = scan_points()
    points[:, 3] = 0
    scan = Scan(points)
    assert match_scan(scan, SIMULATED_QUANTILES["hdl64e"]) is scan


def test_weights_of_simulated_scans_match_each_scan_however_it_is_given() -> None:
    weights = weights_with(is_matched=True)
    points = scan_points()
    dark = points.copy()
    dark[:, 3] = points[:, 3] ** 2 / 2
    segmenter = amvnet.load(weights)
    expected = segmenter(points)
    np.testing.assert_allclose(segmenter(dark).scores, expected.scores, atol=0.02)

    # The scan is labelled alike as a file: its normaliser leaves the intensities to the segmenter.
    said: list[str] = []
    recording = Normaliser(weights.expects, report=said.append)(Recording("a"))
    normalised = recording.to_scan(Cloud(dark[:, :3], dark[:, 3], name="a"))
    np.testing.assert_allclose(normalised.points[:, 3], dark[:, 3], atol=1e-6)
    assert "spread as in the training" in said[0]


def test_matched_intensities_stay_at_most_one() -> None:
    """Scans of a training may have been brighter."""
    quantiles = np.linspace(0, 1, len(PROBABILITIES))
    levels, becomes = matching(quantiles, (2 * quantiles).tolist())
    np.testing.assert_allclose(levels, quantiles)
    np.testing.assert_allclose(becomes, np.minimum(2 * quantiles, 1))


def test_a_few_wild_intensities_do_not_decide_the_range() -> None:
    intensity = np.linspace(0, 1, 10_000)
    intensity[:5] = 300
    cloud = Cloud(np.ones((len(intensity), 3)), intensity)
    assert cloud.intensity_scale() == 1
    intensity[:50] = 300
    assert cloud.intensity_scale() == 65535


def test_scans_that_sway_have_the_intensities_of_their_recording() -> None:
    recording = Measured(Sensor(), None)
    points, _ = place(LASERS["os1-64"], 1.73)
    for number in range(MEASURED_SCANS + 2):
        pitch = 8 if number % 2 else -8
        xyz = points[:, :3].astype(np.float64) @ rotation_from_degrees(0, pitch, 0).T
        cloud = Cloud(xyz, np.linspace(0, 0.6 + 0.01 * number, len(xyz)), name="a")
        estimate, is_usual = recording.estimate(cloud)

    assert is_usual
    assert recording.usual is not None
    assert not recording.usual.is_steady
    np.testing.assert_array_equal(not_none(estimate.quantiles), recording.usual.quantiles)
