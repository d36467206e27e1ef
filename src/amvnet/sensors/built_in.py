"""Choose built-in weights by the lasers of a sensor."""

from __future__ import annotations

from amvnet.data.taxonomy import CLASSES_BY_SENSOR, SEMANTICKITTI, Taxonomy
from amvnet.sensors.lasers import SensorGeometry, describe_lasers
from amvnet.sensors.lidars import ANY, BUILT_IN, KNOWN_SENSORS, Sensor

OWN_ANGLE = 3.0  # largest difference of an end of the field of view of weights' own sensor, degrees


def weights_for(
    lasers: SensorGeometry, classes: Taxonomy | None = None, is_mixed: bool = False
) -> tuple[str, str]:
    """Return the name of the built-in weights for a sensor, and in words why these.

    Args:
        lasers: what is known about the lasers of the sensor.
        classes: the classes of a dataset; weights with other classes are left out if any have them.
        is_mixed: whether the scans are from several sensors, so that there are no usual lasers.
    """
    names = [name for name in BUILT_IN if classes is None or _has_classes(name, classes)]
    names = names or list(BUILT_IN)
    if lasers.field_of_view is None:
        why = "scans are of several sensors" if is_mixed else "lasers are unknown"
        return names[-1], f"as the {why}"
    fitting = [name for name in _fitting(lasers) if name in names]
    found = describe_lasers(lasers)
    if not fitting:
        return names[-1], f"as none with these classes were trained for such a LiDAR ({found})"
    kind = "all kinds of LiDARs" if BUILT_IN[fitting[0]] == ANY else "such LiDARs"
    return fitting[0], f"trained for {kind} ({found})"


def suited_to(lasers: SensorGeometry) -> str:
    """Return the name of the built-in weights that suit such lasers best."""
    return _fitting(lasers)[0]


def lasers_of(classes: Taxonomy) -> SensorGeometry:
    """Return the lasers that recorded the benchmark with these classes; unknown for others."""
    for name, taxonomy in CLASSES_BY_SENSOR.items():
        if taxonomy.classes == classes.classes:
            return SensorGeometry().override(KNOWN_SENSORS[name])
    return SensorGeometry()


def _fitting(lasers: SensorGeometry) -> list[str]:
    """Return the names of the built-in weights that have seen such lasers, the best first."""
    return [name for name in BUILT_IN if lasers.is_like(_trained_lasers(name), OWN_ANGLE)]


def _trained_lasers(name: str) -> SensorGeometry:
    return SensorGeometry().override(KNOWN_SENSORS.get(BUILT_IN[name], Sensor()))


def _has_classes(name: str, classes: Taxonomy) -> bool:
    return CLASSES_BY_SENSOR.get(BUILT_IN[name], SEMANTICKITTI).classes == classes.classes
