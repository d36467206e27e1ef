"""Label the points of a PointCloud2; this needs no ROS."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from amvnet.data.formats.cloud import reading
from amvnet.data.formats.pointcloud2 import read_message
from amvnet_ros.fusion import FindPose, PastFusion
from amvnet_ros.messages import LabelledPoints, Message

if TYPE_CHECKING:  # the node sets the environment before torch reads it
    from amvnet.data.taxonomy import Taxonomy
    from amvnet.weights.verdict import Verdict


def _parameter(default: Any, description: str) -> Any:
    return field(default=default, metadata={"description": description})


@dataclass(frozen=True)
class Settings:
    """The parameters of the node, which mean the same as the options of `amvnet predict`.

    ROS has no None. A parameter is empty, 0 or negative if its value is to be measured.
    """

    weights: str = _parameter(
        "auto", "a name, a path, or hf-hub:OWNER/NAME; auto: by the lasers of the first scan"
    )
    method: str = _parameter("amvnet", "amvnet, rv, rv-knn, bev, ensemble, arithmetic or maximum")
    device: str = _parameter("auto", "cpu, cuda, cuda:1, ..., or auto: cuda if there is a GPU")
    engine: str = _parameter("torch", "torch, onnx or int8")
    precision: str = _parameter("auto", "float32, bfloat16, on a GPU float16, or auto")
    threads: int = _parameter(0, "threads of the processor; 0: as many as it has cores")
    sensor: str = _parameter("", "a name such as os1-64, or a YAML file; empty: measured")
    height: float = _parameter(-1.0, "metres over the ground; negative: measured")
    intensity_scale: float = _parameter(0.0, "the largest possible intensity; 0: measured")
    unit: str = _parameter("", "m, cm, mm or ft; empty: measured")
    axes: str = _parameter("", "x-forward, y-forward, z-forward, z-down or y-up; empty: measured")
    rotate: str = _parameter("", "yaw,pitch,roll in degrees that level the scan; empty: measured")
    offset: str = _parameter("", "x,y,z in metres, added after the rotation")
    keep_own: bool = _parameter(False, "also label the points of the car's own body")
    odom_frame: str = _parameter(
        "", "a frame of tf that stands still, such as odom: fuse past scans; empty: no fusion"
    )

    def sensor_options(self) -> dict[str, Any]:
        """Return the arguments of `make_sensor`; None stands for a value to be measured."""
        return {
            "sensor": self.sensor or None,
            "height": self.height if self.height >= 0 else None,
            "intensity_scale": self.intensity_scale or None,
            "unit": self.unit or None,
            "axes": self.axes or None,
            "rotate": self.rotate or None,
            "offset": self.offset or None,
            "keep_own": self.keep_own or None,
        }


@dataclass(frozen=True)
class LabelledCloud:
    """The points of a message with their labels, in their order.

    Attributes:
        origin: the parts of the message that its labels keep.
        points: the points with raw ids, 0 for lost points, and class colours.
        verdict: how sure the labels are.
    """

    origin: Message
    points: LabelledPoints
    verdict: Verdict


class CloudSegmenter:
    """Labels messages of one sensor.

    The sensor is measured in the first messages, as `amvnet predict` measures it in the first scans
    of a folder. With poses, each scan is fused with scans before it, as by `predict --drive
    --past-only`.

    Attributes:
        taxonomy: the classes; None until the first message has chosen the weights.
        hardware: the device that computes, in words; empty until then.

    Args:
        settings: the parameters of the node.
        topic: the topic of the messages, for lines of the log.
        report: called once with what was assumed about the sensor.
        find_pose: as `PastFusion` takes it. Without it, no scans are fused.

    Raises:
        InputError: if a parameter is wrong.
    """

    def __init__(
        self,
        settings: Settings,
        topic: str,
        report: Callable[[str], None],
        find_pose: FindPose | None = None,
    ) -> None:
        # Imported late: the node sets the environment before torch reads it.
        import torch

        from amvnet.sensors.lidars import make_sensor

        self._settings = settings
        self._sensor = make_sensor(**settings.sensor_options())
        self._topic = topic
        self._report = report
        self._fuse = None if find_pose is None else PastFusion(find_pose)
        if settings.threads > 0:
            torch.set_num_threads(settings.threads)

        self.taxonomy: Taxonomy | None = None
        self.hardware = ""
        self._load(settings.weights)

    def _load(self, weights: str) -> None:
        """Load the weights of a name; for "auto", only check the parameters."""
        import amvnet
        from amvnet.data.recordings import Recording
        from amvnet.runtime.memory import keep_freed_memory
        from amvnet.sensors.lidars import AUTO
        from amvnet.sensors.normalise import Normaliser

        settings = self._settings
        self._segment = amvnet.load(
            weights,
            device=settings.device,
            method=settings.method,  # type: ignore[arg-type]  # checked there
            precision=settings.precision,  # type: ignore[arg-type]
            engine=settings.engine,  # type: ignore[arg-type]
        )
        if weights == AUTO:
            return
        if self._segment.device == "cpu":
            keep_freed_memory()
        normaliser = Normaliser(self._segment.weights.expects, self._sensor, self._report)
        self._recording = normaliser(Recording(self._topic))
        self.taxonomy = self._segment.taxonomy
        self.hardware = self._segment.engine.hardware
        self._colors = np.asarray(self.taxonomy.colors, np.uint8)

    def __call__(self, message: Any) -> LabelledCloud:
        """Label the points of a message.

        Raises:
            InputError: if the message is broken, or no point is usable.
        """
        with reading(self._topic, "a PointCloud2 message", "check the driver"):
            cloud = read_message(message, self._topic)
            origin = Message.of(message)

        if self.taxonomy is None:
            from amvnet.inference.loading import choose_by

            name, reason = choose_by(cloud, self._sensor)
            self._report(f"weights {name}, {reason}")
            self._load(name)
        assert self.taxonomy is not None
        scan = self._recording.to_scan(cloud)
        result = self._segment(scan, yaw=0.0 if self._fuse is None else self._fuse.yaw(origin))
        if self._fuse is not None:  # last, because odometry often comes after its scan
            result = self._fuse(origin, scan, result)
        points = LabelledPoints(
            cloud.xyz,
            raw=self.taxonomy.to_raw(result.labels),
            colors=self._colors[result.labels],
            uncertain=result.uncertain if result.has_two_networks else None,
        )
        assert result.verdict is not None  # a segmenter labelled the scan
        return LabelledCloud(origin, points, result.verdict)

    def classes(self) -> str:
        """Return the classes as JSON: id (as in the field label), name and color (RGB) of each."""
        taxonomy = self.taxonomy
        assert taxonomy is not None
        rows = zip(taxonomy.train_to_raw, taxonomy.names, taxonomy.colors, strict=True)
        entries = []
        for raw, name, color in rows:
            entries.append({"id": raw, "name": name, "color": list(color)})
        return json.dumps(entries)
