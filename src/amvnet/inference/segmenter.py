"""Points in, labels out: a NumPy interface to the torch model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from amvnet.data.laser_order import with_lasers
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.inference.listing import InputScan, ScanOptions, list_inputs
from amvnet.inference.reading import checked_scan, normaliser_for
from amvnet.inference.segmentation import Origin, Segmentation, fetch, unpack
from amvnet.models.amvnet import AMVNet, Scores
from amvnet.models.assertion import Disagreement
from amvnet.models.graphs import Captured
from amvnet.models.layers import freeze
from amvnet.models.methods import METHODS, MethodName, Precision, check_method
from amvnet.models.polar_net import PolarNet
from amvnet.models.precision import InPrecision, check_device, choose_device, choose_precision
from amvnet.models.streams import TwoStreams, side_by_side
from amvnet.models.views.points import PointBatch
from amvnet.models.voting import vote
from amvnet.runtime.memory import available_memory, return_freed_memory
from amvnet.runtime.threads import survive_forks
from amvnet.scan import AnyArray, Scan
from amvnet.sensors.intensity import prepare, trained_intensity
from amvnet.weights.file import Weights, load

SCAN_BYTES = 2**30  # that a scan may take; one of 120,000 points takes half, at the paper's size
LARGE = 1_000_000  # points; memory freed by larger scans is returned: no other scan could use it


class Segmenter:
    """Segments scans with trained weights.

    Args:
        weights: trained weights, or the name or path of a weights file.
        device: where to compute: "cpu", "cuda", "cuda:1", ..., or "auto": "cuda" if there is one,
            else "cpu".
        method: "amvnet", or for comparison "rv" or "bev" (one network), "rv-knn" (the range view
            with `models.voting`), "ensemble" (geometric mean), "arithmetic" or "maximum".
        precision: of the two networks: "float32", "bfloat16", on a GPU "float16", or "auto":
            bfloat16 on a GPU that has it, else float32. Everything else is computed in float32, the
            projections in float64.
        tau: points whose class probabilities by the two networks have a cosine similarity of at
            most this are uncertain, in [0, 1]; None means as the weights say.
        graphs: on a GPU, capture the networks as CUDA graphs (`models.graphs`), once for each
            number of scans in a batch.

    Attributes:
        weights, device, method, precision, tau: as given, the weights as `Weights`; device and
            precision are never "auto", but what it stands for.
        at_once: scans to segment at the same time, each with its share of torch's threads: by
            default on a CPU, one for each thread, if the memory suffices.
        intensity: the intensities of the training, to which those of a scan may be brought
            (`sensors.intensity.match_scan`); None if unknown.
        model: the networks and the head, on the device.

    Raises:
        InputError: if the weights lack a part that the method needs, or there is no such method,
            device or precision, or tau is out of range.
    """

    def __init__(
        self,
        weights: Weights | Path | str,
        device: str = "auto",
        method: MethodName = "amvnet",
        precision: Precision = "auto",
        tau: float | None = None,
        graphs: bool = True,
    ) -> None:
        self.weights = weights if isinstance(weights, Weights) else load(weights)
        self.method = check_method(method, self.weights.parts)
        self.tau = tau
        self.device = check_device(choose_device(device))
        self.precision = choose_precision(precision, self.device)

        self.engine = "torch"
        self.at_once = 1
        if self.device == "cpu":
            self.at_once = max(min(torch.get_num_threads(), available_memory() // SCAN_BYTES), 1)

        self.intensity = trained_intensity(self.weights.training, self.weights.sensor)

        survive_forks()

        self.model: AMVNet = self.weights.build().to(self.device)
        self.model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        freeze(self.model)
        _set_up_networks(self.model, self.device, self.precision, graphs)

        if tau is not None:
            self.model.assertion = Disagreement(tau)
        ensemble = METHODS[method].ensemble
        if ensemble is not None:
            self.model.ensemble = ensemble
            self.model.point_head = None

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes."""
        return self.weights.taxonomy

    @property
    def hardware(self) -> str:
        """The device in words, with the name of a GPU."""
        if not _is_gpu(self.device):
            return self.device
        return f"{self.device} ({torch.cuda.get_device_name(self.device)})"

    @property
    def usual_uncertain(self) -> float | None:
        """The share of uncertain points in the validation; None for another tau."""
        return self.weights.usual_uncertain_at(self.tau)

    def __repr__(self) -> str:
        return f"<Segmenter {self.method} on {self.device}, {self.precision}: {self.weights!r}>"

    def __call__(
        self, points: AnyArray | Scan | Path | str, columns: str | None = None
    ) -> Segmentation:
        """Segment one scan.

        Args:
            points: (N, 4) x, y, z in metres and intensity in [0, 1], as an array, a tensor or a
                list; or an array with other columns or with named fields (`array_scan`); or a
                `Scan`; or the path of a scan file, which is normalised to the weights as `amvnet
                predict` does.
            columns: of an array, what its columns hold, such as "x,y,z,intensity,ring"; None means
                the names of its fields, or what their number and values suggest.

        Raises:
            InputError: if there is no valid point, more than a few intensities are out of range,
                the model needs a ring index and there is none, or a file cannot be read or holds
                several scans.
        """
        if not isinstance(points, Path | str):
            return self._segment([checked_scan(points, columns, self.intensity)])[0]

        scans, assumed = self._open(points)
        if len(scans) > 1:
            raise InputError(
                f"{points}: expected one scan, found {len(scans)}; segment them with Segmenter.each"
            )
        return self._segment_input(scans[0], assumed)

    def many(self, scans: Sequence[AnyArray | Scan]) -> list[Segmentation]:
        """Segment several scans in one pass of the networks, which suits a GPU.

        Args:
            scans: each as the points of one scan, but no path.

        Raises:
            InputError: if one cannot be segmented; segment them one by one to see which.
        """
        checked = []
        for scan in scans:
            checked.append(checked_scan(scan, trained=self.intensity))
        return self._segment(checked)

    def _segment(self, scans: Sequence[Scan]) -> list[Segmentation]:
        """Segment scans, each with a valid point, in one pass."""
        is_large = sum(map(len, scans)) >= LARGE
        with return_freed_memory() if is_large else nullcontext():
            batch = self.batch(scans)
            labels, scores = fetch(self.run(batch))

        results = []
        for scan, points in zip(scans, batch.slices(), strict=True):
            result = unpack(scan.valid, labels, scores, points)
            origin = Origin(scan, self.taxonomy, self.method, self.usual_uncertain)
            results.append(replace(result, origin=origin))
        return results

    def each(self, path: Path | str, topic: str | None = None) -> Iterator[Segmentation]:
        """Segment the scans of a file, a bag, a folder of these, or a dataset, one after the other.

        Scans of files and bags are normalised to the weights as `amvnet predict` does; all of one
        folder or bag alike.

        Args:
            path: as INPUT of `amvnet predict`.
            topic: of bags; None means the only topic with scans.

        Returns:
            An iterator that reads and segments one scan at a time.

        Raises:
            InputError: if there is no scan; by the iterator, if one cannot be read or segmented.
        """
        scans, assumed = self._open(path, topic)
        return (self._segment_input(scan, assumed) for scan in scans)

    def _open(
        self, path: Path | str, topic: str | None = None
    ) -> tuple[Sequence[InputScan], list[str]]:
        """Return the scans of a path, and a list that receives what is assumed of them."""
        assumed: list[str] = []
        normaliser = normaliser_for(self.weights, say=assumed.append)
        options = ScanOptions(topic=topic)
        scans, _ = list_inputs([str(path)], options, self.taxonomy, normaliser)
        return scans, assumed

    def _segment_input(self, scan: InputScan, assumed: list[str]) -> Segmentation:
        """Read and segment a scan of `_open`."""
        loaded = scan.load(labels=True)
        result = self(loaded.scan)

        assert result.origin is not None
        origin = replace(
            result.origin, path=scan.path, file_xyz=loaded.file_xyz, assumed="; ".join(assumed)
        )
        return replace(result, origin=origin)

    @torch.inference_mode()
    def run(self, batch: PointBatch) -> Scores:
        """Score the points of a batch by the method of this segmenter."""
        model = self.model
        if METHODS[self.method].has_two_networks:
            return model(batch)
        if self.method == "bev":
            g = model.score_polar(model.polar_view.project(batch))
            return Scores(g, _nowhere(g), rv=None, bev=g)

        image = model.range_view.project(batch)
        f = model.score_range(image)
        y = vote(f, batch, image) if self.method == "rv-knn" else f
        return Scores(y, _nowhere(y), rv=f, bev=None)

    def batch(self, scans: Sequence[Scan]) -> PointBatch:
        """Return the valid points of some scans on the device, as the networks take them.

        The intensities of each scan are matched to those of the training, if the weights say so.
        If the rows of the range image are lasers, they are looked for in scans without rings.

        Raises:
            InputError: if more than a few intensities are out of range.
        """
        prepared = []
        for scan in scans:
            if scan.row is None:
                scan = with_lasers(scan, self.weights.model.range_view.lasers)
            prepared.append(prepare(scan, self.intensity))
        return PointBatch.of(prepared, self.device)


def _is_gpu(device: str) -> bool:
    return torch.device(device).type == "cuda"


def _set_up_networks(model: AMVNet, device: str, precision: Precision, graphs: bool) -> None:
    """Let the two networks compute in a precision, and at the same time if that is faster."""
    if _is_gpu(device):
        model.arrange = TwoStreams(device)
    elif device == "cpu":
        model.arrange = side_by_side
    if _is_gpu(device) and graphs:
        assert isinstance(model.polar_net, PolarNet)
        model.range_net = Captured(model.range_net)
        model.polar_net.run_unet = Captured(model.polar_net.unet)
    if precision != "float32" or _is_gpu(device):
        model.range_net = InPrecision(model.range_net, device, precision)
        model.polar_net = InPrecision(model.polar_net, device, precision)


def _nowhere(scores: Tensor) -> Tensor:
    """Return (P,) uncertain points of a single network: none."""
    return torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
