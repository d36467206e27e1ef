"""The diagnostics say what happened since the last ones."""

from __future__ import annotations

import pytest

from amvnet.weights.verdict import EntropyVerdict, Verdict
from amvnet_ros.health import Health, Labelled, Level


def test_clouds_are_counted_and_their_latency_is_measured() -> None:
    health = Health()
    for seconds in (0.2, 0.3, 0.4):
        health.receive(drops=seconds == 0.4)
        verdict = Verdict(seconds, usual=0.3)
        health.label(Labelled(seconds, seconds + 1, points=100, verdict=verdict))

    report = health.report(2.0)
    assert report.level is Level.OK
    assert report.values == {
        "clouds received": "3",
        "clouds dropped (late)": "1",
        "clouds refused": "0",
        "clouds labelled per second": "1.50",
        "latency (ms)": "300",
        "latency, maximum (ms)": "400",
        "stamp to labels (ms)": "1300",
        "points": "100",
        "uncertain points (%)": "30.0",
    }


def test_counts_go_on_and_measurements_begin_again() -> None:
    health = Health()
    health.receive(drops=True)
    health.label(Labelled(0.2, 0.2, points=100, verdict=Verdict(0.3, usual=None)))
    health.report(1.0)
    report = health.report(1.0)
    assert report.level is Level.WARN
    assert "topic" in report.message
    assert (report.values["clouds received"], report.values["clouds dropped (late)"]) == ("1", "1")
    assert "latency (ms)" not in report.values


def test_a_cloud_at_work_is_no_reason_to_warn() -> None:
    health = Health()
    health.receive(drops=False)
    assert health.report(1.0).level is Level.OK


def test_a_refused_cloud_is_an_error_with_its_reason() -> None:
    health = Health()
    health.receive(drops=False)
    health.refuse("/points: expected columns x, y, z")
    report = health.report(1.0)
    assert report.level is Level.ERROR
    assert report.message == "/points: expected columns x, y, z"
    assert report.values["clouds refused"] == "1"


@pytest.mark.parametrize("kind", [Verdict, EntropyVerdict])
def test_scans_that_the_weights_do_not_know_are_told(kind: type[Verdict]) -> None:
    health = Health()
    health.receive(drops=False)
    health.label(Labelled(0.2, 0.2, points=100, verdict=kind(0.7, usual=0.3)))
    report = health.report(1.0)
    assert report.level is Level.WARN
    assert f"70.0% {kind.quantity}" in report.message
    assert "axes" in report.message
