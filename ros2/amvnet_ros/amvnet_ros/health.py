"""Report once a second how many clouds the node labels, how fast and how surely."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum
from statistics import median
from threading import Lock
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the node sets the environment before torch reads it
    from amvnet.weights.verdict import Verdict


class Level(Enum):
    """The levels of a DiagnosticStatus; a value is the name of a level in ROS."""

    OK = "OK"
    WARN = "WARN"
    ERROR = "ERROR"


@dataclass(frozen=True)
class Report:
    """The content of a DiagnosticStatus: a level, a message, and values by name."""

    level: Level
    message: str
    values: dict[str, str]


@dataclass(frozen=True)
class Labelled:
    """A cloud that was labelled.

    Attributes:
        seconds: the seconds from the arrival of the cloud to its labels.
        age: the seconds from the stamp of the cloud to its labels.
        points: the number of points.
        verdict: how sure the labels are.
    """

    seconds: float
    age: float
    points: int
    verdict: Verdict


@dataclass
class _Period:
    """What happened since the last report."""

    labelled: list[Labelled] = field(default_factory=list)
    received: int = 0
    dropped: int = 0
    refusal: str = ""


class Health:
    """Counts what happens to the clouds; any thread may call it."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._period = _Period()
        self._received = 0
        self._dropped = 0
        self._refused = 0

    def receive(self, drops: bool) -> None:
        """Count a cloud that arrived.

        Args:
            drops: whether an older cloud is dropped for it.
        """
        with self._lock:
            self._period.received += 1
            self._period.dropped += drops
            self._received += 1
            self._dropped += drops

    def label(self, labelled: Labelled) -> None:
        """Count a cloud that was labelled."""
        with self._lock:
            self._period.labelled.append(labelled)

    def refuse(self, reason: str) -> None:
        """Count a cloud that could not be labelled."""
        with self._lock:
            self._period.refusal = reason
            self._refused += 1

    def report(self, seconds: float) -> Report:
        """Return the report on the time since the last report, and begin a new period.

        Args:
            seconds: the time since the last report.
        """
        with self._lock:
            period = self._period
            self._period = _Period()
            values = {
                "clouds received": str(self._received),
                "clouds dropped (late)": str(self._dropped),
                "clouds refused": str(self._refused),
            }
        values |= _describe(period, seconds)
        return Report(*_judge(period), values)


def _describe(period: _Period, seconds: float) -> dict[str, str]:
    """Return the values of a period: medians over its clouds, or maxima if their names say so."""
    labelled = period.labelled
    rate = len(labelled) / seconds if seconds > 0 else 0.0
    values = {"clouds labelled per second": f"{rate:.2f}"}
    if not labelled:
        return values

    latencies = [1000 * cloud.seconds for cloud in labelled]
    ages = [1000 * cloud.age for cloud in labelled]
    values["latency (ms)"] = f"{median(latencies):.0f}"
    values["latency, maximum (ms)"] = f"{max(latencies):.0f}"
    values["stamp to labels (ms)"] = f"{median(ages):.0f}"
    values["points"] = f"{median(cloud.points for cloud in labelled):.0f}"
    verdict = _verdict(labelled)
    values[f"{verdict.name} (%)"] = f"{100 * verdict.share:.1f}"
    return values


def _judge(period: _Period) -> tuple[Level, str]:
    """Return the level and the message of the report on a period."""
    if period.refusal:
        return Level.ERROR, period.refusal
    if not period.received and not period.labelled:
        return Level.WARN, "no clouds: check the topic, and its QoS"

    if period.labelled:
        verdict = _verdict(period.labelled)
        if verdict.is_doubtful:
            return Level.WARN, f"{verdict}; check sensor, height, unit, axes and intensity_scale"
    return Level.OK, "labelling"


def _verdict(labelled: list[Labelled]) -> Verdict:
    """Return the verdict on the median cloud."""
    share = median(cloud.verdict.share for cloud in labelled)
    return replace(labelled[0].verdict, share=share)
