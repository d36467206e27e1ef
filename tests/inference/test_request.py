"""The request for labels: whatever changes a label file changes its settings."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from typing import Any

import numpy as np

from amvnet.data.class_maps import class_map
from amvnet.data.formats.rows import parse_layout
from amvnet.inference.pipeline import LabelFiles
from amvnet.inference.request import LabellingRequest
from amvnet.sensors.lidars import Sensor

from fixtures.commands import fails
from fixtures.tiny import fresh_weights, with_model

OTHERS: dict[str, Any] = {
    "weights": fresh_weights(seed=1),
    "method": "rv",
    "tau": 0.5,
    "precision": "bfloat16",
    "engine": "int8",
    "classes": class_map("coarse"),
    "drive": "0123456789abcdef",
}
# The fields of its own values.
OTHERS_OF: dict[str, dict[str, Any]] = {
    "reading": {
        "sensor": Sensor(height=2.0),
        "layout": parse_layout("x,y,z,ring", "float64"),
        "topic": "/points",
    },
    "files": {"kind": "ply", "scores": True, "uncertain": True},
}


def test_each_field_changes_the_settings() -> None:
    request = LabellingRequest(fresh_weights())
    assert {*OTHERS, *OTHERS_OF} == {field.name for field in fields(request)}
    others = [replace(request, **{name: value}) for name, value in OTHERS.items()]
    for part, changes in OTHERS_OF.items():
        whole = getattr(request, part)
        assert set(changes) == {field.name for field in fields(whole)}
        for name, value in changes.items():
            others.append(replace(request, **{part: replace(whole, **{name: value})}))
    for other in others:
        assert other.settings != request.settings, other
        assert json.loads(json.dumps(other.settings)) == other.settings


def test_weights_that_choose_other_points_for_the_head_change_the_settings() -> None:
    weights = fresh_weights()
    settings = LabellingRequest(weights).settings
    for part, changes in (("assertion", {"lead": 3.0}), ("point_head", {"cell": 0.1})):
        assert LabellingRequest(with_model(weights, part, **changes)).settings != settings


def test_equal_requests_have_equal_settings() -> None:
    request = LabellingRequest(fresh_weights())
    assert LabellingRequest(fresh_weights()).settings == request.settings
    assert replace(request, engine="onnx").settings == request.settings


def test_a_request_that_does_not_fit_is_refused_in_one_line() -> None:
    request = LabellingRequest(fresh_weights())
    without_head = {
        name: tensor
        for name, tensor in request.weights.tensors.items()
        if not name.startswith("point_head")
    }
    incomplete = replace(request.weights, tensors=without_head)
    fails(lambda: LabelFiles("mcap"), "mcap")
    fails(lambda: replace(request, tau=2.0), "tau")
    fails(lambda: replace(request, tau=float(np.nan)), "tau")
    fails(lambda: replace(request, method="rv", files=LabelFiles(uncertain=True)), "--uncertain")
    fails(lambda: replace(request, method="rv", tau=0.3), "--tau")
    fails(lambda: LabellingRequest(incomplete), "point_head")
