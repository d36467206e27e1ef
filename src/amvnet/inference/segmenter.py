"""The segmenter, which turns scans into labels by an engine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from amvnet.data.recordings import Recording, ScanFile
from amvnet.data.taxonomy import Taxonomy
from amvnet.engines.base import Engine
from amvnet.errors import InputError
from amvnet.inference.listing import Inputs, find_inputs
from amvnet.inference.segmentation import Origin, Segmentation, fetch, unpack
from amvnet.models.amvnet import AMVNet
from amvnet.models.methods import MethodName
from amvnet.models.views.points import PointBatch
from amvnet.runtime.memory import return_freed_memory
from amvnet.scan import AnyArray, Scan, check_scan, turned
from amvnet.sensors.normalise import Normaliser
from amvnet.sensors.own_body import mark_own
from amvnet.sensors.reading import AS_FOUND, Reading, array_cloud, array_scan
from amvnet.weights.file import Weights

# The least number of points in a batch whose freed memory is returned to the system, because no
# usual batch could use it.
LARGE_BATCH = 1_000_000


class Segmenter:
    """Segments scans with trained weights; `amvnet.load` makes one.

    Args:
        weights: trained weights.
        engine: scores points by the networks of these weights.
        reading: how arrays and files are read. If nothing is known about the sensor, files are
            normalised by what they show, and arrays are taken as they are.
        at_once: the number of scans to segment at the same time, each with its share of torch's
            threads; by default the number that the engine suggests.

    Attributes:
        weights, engine, reading, at_once: as above.
    """

    def __init__(
        self,
        weights: Weights,
        engine: Engine,
        reading: Reading = AS_FOUND,
        at_once: int | None = None,
    ) -> None:
        self.weights = weights
        self.engine = engine
        self.reading = reading
        self.at_once = engine.at_once if at_once is None else at_once

    @property
    def taxonomy(self) -> Taxonomy:
        """The classes of the labels."""
        return self.weights.taxonomy

    @property
    def method(self) -> MethodName:
        """The method that gives the labels, one of `METHODS`."""
        return self.engine.method

    @property
    def device(self) -> str:
        """The device that holds the points: "cpu", "cuda", "cuda:1", ..."""
        return self.engine.device

    @property
    def model(self) -> AMVNet:
        """The method in torch, with the networks as the engine runs them."""
        return self.engine.model

    @property
    def usual_uncertain(self) -> float | None:
        """The share of uncertain points in the validation, in [0, 1].

        None if the engine has another tau than the weights.
        """
        return self.weights.usual_uncertain_at(self.engine.tau)

    def __repr__(self) -> str:
        engine = self.engine
        return f"<Segmenter {self.method} on {self.device}, {engine.precision}: {self.weights!r}>"

    def __call__(
        self,
        points: AnyArray | Scan | Path | str,
        columns: str | Sequence[str] | None = None,
        yaw: float = 0.0,
    ) -> Segmentation:
        """Segment one scan.

        Args:
            points: one of
                - (N, 4) x, y, z in metres and intensity in [0, 1], as an array, a tensor or a list;
                  if the segmenter knows the sensor, in the sensor's units, and normalised as files;
                - an array with other columns or with named fields (`array_cloud`);
                - a `Scan`;
                - the path of a scan file. The scan is normalised to the weights, as `amvnet
                  predict` normalises it.
            columns: the names of the columns of an array or of a file of rows, such as
                "x,y,z,intensity,ring" or a list of them. By default, named fields keep their names,
                and other columns are recognised by their number and their values.
            yaw: the networks get the scan turned by this angle about z, radians. A scan looks a
                little different to them from each angle, so that several angles see more than one.

        Raises:
            InputError: if there is no valid point, more than a few intensities are out of range,
                the model needs a ring index and there is none, or a file cannot be read or holds
                several scans.
        """
        if isinstance(points, Scan) and columns is not None:
            raise InputError(
                "columns: expected them for an array or a file, found a Scan, which has its own; "
                "leave them out"
            )
        if not isinstance(points, Path | str):
            return self._segment([self._read_array(points, columns)], [yaw])[0]

        scans = self._list(find_inputs([str(points)], self.reading.by(columns)))
        if len(scans) > 1:
            raise InputError(
                f"{points}: expected one scan, found {len(scans)}; segment them with Segmenter.each"
            )
        return self._segment_input(scans[0], yaw)

    def many(
        self, scans: Sequence[AnyArray | Scan], yaws: Sequence[float] | None = None
    ) -> list[Segmentation]:
        """Segment several scans in one pass of the networks, which suits a GPU.

        Args:
            scans: arrays or `Scan`s, as `__call__` takes them as `points`; `each` takes paths.
            yaws: the yaw of each scan, as `__call__` takes it; by default 0.

        Raises:
            InputError: if a scan cannot be segmented; segment them one by one to see which.
        """
        return self._segment([self._read_array(points) for points in scans], yaws)

    def _read_array(
        self, points: AnyArray | Scan, columns: str | Sequence[str] | None = None
    ) -> Scan:
        """Return a scan, or that of an array, normalised to the weights if its sensor is known."""
        expects = self.weights.expects
        sensor = self.reading.sensor
        if not isinstance(points, Scan):
            cloud = array_cloud(points, self.reading.by(columns).layout)
            if sensor.is_known:
                return Normaliser(expects, sensor)(Recording("scan")).to_scan(cloud)
            return mark_own(array_scan(cloud, expects.intensity), sensor)
        return check_scan(points)

    def _segment(self, scans: Sequence[Scan], yaws: Sequence[float] | None) -> list[Segmentation]:
        """Segment scans, each with a valid point, in one pass."""
        is_large = sum(map(len, scans)) >= LARGE_BATCH
        with return_freed_memory() if is_large else nullcontext():
            batch = self.batch(scans, yaws)
            labels, scores = fetch(self.engine.score(batch))

        results = []
        for scan, points in zip(scans, batch.slices, strict=True):
            result = unpack(scan.valid, labels, scores, points)
            origin = Origin(scan, self.taxonomy, self.method, self.usual_uncertain)
            results.append(replace(result, origin=origin))
        return results

    def each(
        self, path: Path | str | Sequence[Path | str], topic: str | None = None
    ) -> Iterator[Segmentation]:
        """Segment the scans of a file, a bag, a folder of these, or a dataset, one after the other.

        Scans of files and bags are normalised to the weights, as `amvnet predict` normalises them.
        All scans of one folder or bag are normalised alike.

        Args:
            path: a file, folder or dataset, as `amvnet predict` takes it as INPUT; or several.
            topic: the topic to read in bags; by default the only one with scans.

        Returns:
            An iterator that reads and segments one scan at a time.

        Raises:
            InputError: if there is no scan. The iterator raises it if a scan cannot be read or
                segmented.
        """
        paths = [path] if isinstance(path, Path | str) else path
        inputs = find_inputs(list(map(str, paths)), replace(self.reading, topic=topic))
        return map(self._segment_input, self._list(inputs))

    def _list(self, inputs: Inputs) -> list[ScanFile]:
        """Return the scans of some inputs, normalised to the weights when they are read."""
        return inputs.for_weights(self.weights)

    def _segment_input(self, scan: ScanFile, yaw: float = 0.0) -> Segmentation:
        """Read and segment a scan."""
        result = self(scan.load(labels=True), yaw=yaw)
        assert result.origin is not None
        return replace(result, origin=replace(result.origin, path=scan.path))

    def batch(self, scans: Sequence[Scan], yaws: Sequence[float] | None = None) -> PointBatch:
        """Return the P valid points of some scans, prepared for the networks, as one batch.

        Args:
            yaws: the yaw of each scan, as `__call__` takes it; by default 0.

        Raises:
            InputError: if more than a few intensities are out of range.
        """
        expects = self.weights.expects
        prepared = [expects.prepare(scan) for scan in scans]
        for index, yaw in enumerate(yaws or ()):
            if yaw:
                prepared[index] = turned(prepared[index], yaw)
        return PointBatch.of(prepared, self.device)
