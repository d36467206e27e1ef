"""Choose the rows of a scan's points in the range image of some weights."""

from __future__ import annotations

import dataclasses

import numpy as np

from amvnet.config.schema import RangeViewConfig
from amvnet.models.views.points import PointBatch
from amvnet.models.views.range_view import RangeView
from amvnet.scan import Scan
from amvnet.sensors.expectation import Expectation
from amvnet.sensors.lasers import SensorGeometry, elevations, lasers_by_order, rows_by_density
from amvnet.sensors.lidars import ANY, Sensor, rotation_from_degrees

MAX_OUTSIDE_SHARE = 0.16  # limit of the share of the points outside a field of view that suffices


def find_rows(
    seen: Scan,
    sensor: Sensor,
    lasers: SensorGeometry,
    density: np.ndarray | None,
    expected: Expectation,
) -> np.ndarray | None:
    """Return the row of each point: (N,), 0 is the top, -1 is a lost point.

    The lasers decide if they are known and the weights' rows are lasers, then their density if the
    weights have seen sensors of all kinds, then the elevations. Return None if none of them does.

    Args:
        seen: the level scan with the sensor at the origin.
        sensor: how the points were turned since the sensor measured them.
        lasers: what is known of the lasers.
        density: how close together they are (`laser_density`); None if it is unknown.
    """
    row = _rows_by_laser(seen, sensor, lasers, expected)
    if row is None and expected.sensor.name == ANY:
        row = _rows_by_density(seen, density, expected)
    return _rows(seen, lasers, expected) if row is None else row


def _row_view(
    points: np.ndarray, lasers: SensorGeometry, expected: Expectation
) -> RangeViewConfig | None:
    """Return the range view that gives points (P, 4) their rows by elevation.

    This is the weights' view, with the sensor's field of view if too many points are outside its
    own. Return None if the rows are rings whose elevations are unknown.
    """
    view = _trained_view(lasers, expected)
    if view is None or (expected.as_is and lasers.has_ends_of(expected.lasers)):
        return view

    elevation = elevations(points[:, :3].astype(np.float64))
    is_outside = (elevation > view.fov_up) | (elevation < view.fov_down)
    ends = lasers.field_of_view
    if is_outside.mean() < MAX_OUTSIDE_SHARE or ends is None:
        return view
    return _by_elevation(view, ends, view.height)


def _trained_view(lasers: SensorGeometry, expected: Expectation) -> RangeViewConfig | None:
    """Return the range view of the weights with rows by elevation.

    If the rows are rings, the highest laser gets the first row, and the lowest laser gets the last
    row. Return None if their elevations are unknown.
    """
    view = expected.view
    if view.rows != "ring":
        return dataclasses.replace(view, rows="elevation")

    ends = expected.lasers.field_of_view
    if ends is None and lasers.beams == view.height:
        ends = lasers.field_of_view
    return None if ends is None else _by_elevation(view, ends, view.height - 1)


def _by_elevation(view: RangeViewConfig, ends: tuple[float, float], steps: int) -> RangeViewConfig:
    """Return the view with rows by elevation, for lasers between two elevations in degrees.

    Its field of view is wider by half a step at each end, so that all lasers lie inside. There are
    `steps` steps between the two elevations.
    """
    top, bottom = ends
    half = (top - bottom) / (2 * steps)
    up, down = min(top + half, 90.0), max(bottom - half, -90.0)
    return dataclasses.replace(view, rows="elevation", fov_up=up, fov_down=down)


def _rows(scan: Scan, lasers: SensorGeometry, expected: Expectation) -> np.ndarray | None:
    """Return the row of each point by elevation: (N,), 0 is the top, -1 is a lost point.

    If the weights' rows are rings and the scan's rings suit them, the rings decide. Return None if
    neither the rings nor a view give rows.
    """
    by_ring = None
    if expected.view.rows == "ring" and scan.ring is not None:
        by_ring = _rows_of_rings(scan.ring, expected.view)
        # If no data sheet describes the lasers, they may be unevenly spaced.
        if not expected.sensor.name:
            return by_ring
    valid = scan.valid
    view = _row_view(scan.points[valid], lasers, expected)
    if view is None:
        return by_ring

    rows = np.full(len(scan), -1)
    rows[valid] = RangeView(view).rows(PointBatch.of([scan])).numpy()
    if by_ring is not None and np.median(np.abs(by_ring - rows)[valid]) < 1:
        return by_ring
    return rows


def _rows_by_density(
    seen: Scan, density: np.ndarray | None, expected: Expectation
) -> np.ndarray | None:
    """Return the row of each point so that all rows have about equally many lasers, -1 is lost.

    Return None if the density of the lasers is unknown.
    """
    if density is None or not density.any():
        return None
    rows = np.full(len(seen), -1)
    valid = seen.valid
    rows[valid] = rows_by_density(seen.points[valid], density, expected.view.height)
    return rows


def _rows_by_laser(
    seen: Scan, sensor: Sensor, lasers: SensorGeometry, expected: Expectation
) -> np.ndarray | None:
    """Return the row of each point by its laser: (N,), 0 is the top, -1 is unknown.

    Return None if the weights' rows are not lasers, or if the scan's lasers are unknown or unlike
    the training's lasers.
    """
    view = expected.view
    if view.rows != "laser" or not lasers.has_ends_of(expected.lasers):
        return None

    ring = seen.ring
    if ring is None:
        # The sensor may be tilted as it fires, or the file may have been turned after it.
        turn = rotation_from_degrees(*(sensor.rotate or (0, 0, 0))).astype(np.float32)
        ring = lasers_by_order(seen.points[:, :3] @ turn, view.height)
        if ring is None and not np.array_equal(turn, np.eye(3)):
            ring = lasers_by_order(seen.points, view.height)
    if ring is None or not view.has_laser_per_row(ring[seen.valid].max()):
        return None
    return _rows_of_rings(ring, view)


def _rows_of_rings(ring: np.ndarray, view: RangeViewConfig) -> np.ndarray:
    """Return the rows of lasers (N,), of which the lowest has the last row; -1 is unknown."""
    return np.where(ring < 0, -1, view.height - 1 - ring)
