"""Weights files: safetensors, with a description of the model in the metadata."""

from __future__ import annotations

import dataclasses
import errno
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from amvnet.config.bounds import check_text
from amvnet.config.nested import from_dict, to_dict
from amvnet.config.schema import PARTS, ModelConfig
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError, did_you_mean, reason_of, shown
from amvnet.files import atomic_write, digest
from amvnet.models.amvnet import AMVNet, build_amvnet
from amvnet.models.layers import load_part
from amvnet.models.point_head import PointHead
from amvnet.sensors.expectation import Expectation
from amvnet.weights import hub

UNCERTAIN = "val/uncertain"  # metric of the point head: the share of uncertain points
MIOU = "val/miou_present"  # metric of each part: the mIoU of the classes that it was validated on
# A validation with a smaller mIoU, or a larger share of uncertain points, says that the weights
# have hardly learnt: a fine-tuning on a dozen scans has about 0.5 and 0.3.
POOR_MIOU = 0.3
POOR_UNCERTAIN = 0.6
# Share of uncertain points that is usual for weights without this metric: the paper has this share
# on nuScenes, and `sim-hdl64e` has it on simulated streets.
USUAL_UNCERTAIN = 0.2
# Types of parameters, and of parameters that count, by their names in safetensors.
FLOATS = ("F16", "BF16", "F32", "F64")
COUNTS = ("I64",)
LONGEST_DESCRIPTION = 10_000_000  # limit in characters; built-in weights have 6,000
MAX_PARAMETERS = 500_000_000  # limit for a model; the paper's model has about 60 million
# Names of files in the folder of a run, and in the folder of each of its stages.
RECORD = "run.yaml"  # the inputs of each call
RUN_WEIGHTS = "weights.safetensors"
SETTINGS = "stage.yaml"  # the settings that the stage was begun with
DONE = "done"  # an empty file, which exists if the stage is finished
FORMAT = 1  # version of the description
KEY = "amvnet"  # key of the description in the file's metadata
_FIELD_TYPES = {
    "model": dict,
    "taxonomy": dict,
    "sensor": str,
    "expects": dict,
    "training": dict,
    "metrics": dict,
}


@dataclass(frozen=True, repr=False)
class Weights:
    """The trained parts of an AMVNet, and everything needed to use them.

    Attributes:
        model: sizes of the views, networks and head.
        sensor: name of the sensor that they were trained for; "" if unknown.
        expects: what the networks expect of a scan; its view is that of `model`.
        tensors: the parameters by name; each name begins with its part: "range_net.",
            "polar_net." or "point_head.".
        training: for each part, a record of how it was trained.
        metrics: for each part, its validation metrics.
    """

    model: ModelConfig
    taxonomy: Taxonomy
    sensor: str = ""
    expects: Expectation = field(default_factory=Expectation)
    tensors: Mapping[str, Tensor] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Whoever changes the view of the model need not think of the copy in `expects`.
        expects = dataclasses.replace(self.expects, view=self.model.range_view)
        object.__setattr__(self, "expects", expects)

    def __repr__(self) -> str:
        sensor = f" for {self.sensor}" if self.sensor else ""
        parts = ", ".join(self.parts) or "no parts"
        classes = f"{self.taxonomy.size} classes of {self.taxonomy.name}"
        return f"<Weights{sensor}: {parts}; {classes}>"

    @property
    def parts(self) -> tuple[str, ...]:
        """The names of the parts that have parameters, in the order of `PARTS`."""
        present = {name.split(".", 1)[0] for name in self.tensors}
        return tuple(part for part in PARTS if part in present)

    @property
    def usual_uncertain(self) -> float:
        """The share of uncertain points in the validation, in [0, 1]; else `USUAL_UNCERTAIN`."""
        share = self._validated("point_head", UNCERTAIN)
        return USUAL_UNCERTAIN if share is None else share

    @property
    def weakness(self) -> str:
        """What the validation of the training says against the weights; "" if nothing does."""
        found = []
        known = [miou for part in self.parts if (miou := self._validated(part, MIOU)) is not None]
        if known and known[-1] < POOR_MIOU:
            found.append(f"a mIoU of only {known[-1]:.1%}")
        if self.usual_uncertain > POOR_UNCERTAIN:
            found.append(f"{self.usual_uncertain:.1%} uncertain points")
        if not found:
            return ""
        return (
            f"the validation of these weights' own training had {' and '.join(found)}; do not rely "
            "on the labels: train for more epochs or on more scans"
        )

    def _validated(self, part: str, name: str) -> float | None:
        """Return a metric of a part's validation that is a share, or None if it is unknown."""
        share = self.metrics.get(part, {}).get(name)
        return float(share) if isinstance(share, int | float) and 0 <= share <= 1 else None

    def usual_uncertain_at(self, tau: float | None) -> float | None:
        """Return `usual_uncertain` for the weights' own tau, and None for any other tau."""
        return self.usual_uncertain if tau in (None, self.model.assertion.threshold) else None

    def part(self, name: str) -> dict[str, Tensor]:
        """Return the parameters of one part, named as in the part's own module."""
        prefix = f"{name}."
        own = [key for key in self.tensors if key.startswith(prefix)]
        return {key.removeprefix(prefix): self.tensors[key] for key in own}

    def digest(self, name: str) -> str:
        """Return 16 hexadecimal digits that identify the parameters of one part."""
        parameters = sorted(self.part(name).items())
        return digest(
            key.encode() + tensor.cpu().contiguous().numpy().tobytes() for key, tensor in parameters
        )

    def digests(self) -> dict[str, str]:
        """Return the digest of each part."""
        return {part: self.digest(part) for part in self.parts}

    def build(self, with_head: bool = False) -> AMVNet:
        """Return the model, in evaluation mode.

        A network that the weights lack is initialised at random, as is the point head if
        `with_head`; else the model has none.

        Raises:
            InputError: if the parameters do not fit the sizes.
        """
        parameters = {part: self.part(part) for part in self.parts}
        model = build_amvnet(self.model, self.taxonomy.size)
        for part, own in parameters.items():
            load_part(getattr(model, part), part, own)

        if "point_head" not in self.parts and not with_head:
            model.point_head = None
        return model.eval()

    def build_head(self) -> PointHead:
        """Return only the point head, in evaluation mode.

        Raises:
            InputError: if there is none, or its parameters do not fit its sizes.
        """
        if "point_head" not in self.parts:
            raise InputError(
                "expected weights with a point head, found none; train one with --stage head"
            )

        head = PointHead(self.model.point_head, self.taxonomy.size)
        load_part(head, "point_head", self.part("point_head"))
        return head.eval()


def part_state(part: str, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return copies on the CPU of a part's parameters, named as in `Weights.tensors`."""
    copies = {}
    for key, tensor in state.items():
        copies[f"{part}.{key}"] = tensor.detach().cpu().clone().contiguous()
    return copies


def save(weights: Weights, path: Path | str) -> Path:
    """Write a weights file, whole or not at all, and return its path.

    Raises:
        InputError: if the file cannot be written.
        OSError: if writing fails, for example on a full disk.
    """
    description = {
        "format": FORMAT,
        "model": to_dict(weights.model),
        "taxonomy": weights.taxonomy.to_dict(),
        "sensor": weights.sensor,
        "expects": weights.expects.to_dict(),
        "training": weights.training,
        "metrics": weights.metrics,
    }
    with atomic_write(path) as part:
        try:
            save_file(dict(weights.tensors), part, metadata={KEY: json.dumps(description)})
        except SafetensorError as error:  # such as a full disk
            raise OSError(errno.EIO, reason_of(error), str(path)) from None

    return Path(path)


def load(name_or_path: str | Path) -> Weights:
    """Read weights. Nothing in the file is executed, and nothing is built before it is checked.

    Args:
        name_or_path: a weights file, the folder of a training run, the name of built-in weights
            (`sim-hdl64e`), or weights on the hub (`hf-hub:OWNER/NAME`).

    Raises:
        InputError: if there is no such file or name, the file does not hold AMVNet weights, a value
            of its description is out of its range, or its parameters do not fit the description.
    """
    return read(_find(str(name_or_path)))


def read(path: Path) -> Weights:
    """Read a weights file, as `load` does.

    Raises:
        InputError: as `load`.
    """
    try:
        with safe_open(path, "pt") as file:
            weights = _from_description((file.metadata() or {}).get(KEY, ""))
            tensors = _read_tensors(file, weights)
    except FileNotFoundError:
        raise InputError(f"{path}: expected a weights file, found none; train it again") from None
    except (SafetensorError, OSError):
        raise InputError(
            f"{path}: expected AMVNet weights in safetensors, found a truncated or another file of "
            f"{path.stat().st_size} bytes; copy it again, or give weights"
        ) from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None

    return dataclasses.replace(weights, tensors=tensors)


def _from_description(text: str) -> Weights:
    description = None
    if len(text) <= LONGEST_DESCRIPTION:
        with suppress(ValueError, RecursionError):
            description = json.loads(text)
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise InputError(
            "expected weights with AMVNet's description inside, found none; give AMVNet weights"
        )

    for key, kind in _FIELD_TYPES.items():
        value = description.get(key)
        if not isinstance(value, kind):
            raise InputError(
                f"expected a description with {key}, found {shown(value)}; train again"
            )
    check_text("sensor", description["sensor"])
    for key in ("training", "metrics"):
        for part, record in description[key].items():
            if part not in PARTS or not isinstance(record, dict):
                raise InputError(
                    f"expected {key} of {', '.join(PARTS)}, found {shown(part)}: {shown(record)}; "
                    "train again"
                )

    model = from_dict(ModelConfig, description["model"], "model")
    return Weights(
        model=model,
        taxonomy=Taxonomy.from_dict(description["taxonomy"]),
        sensor=description["sensor"],
        expects=Expectation.from_dict(description["expects"], model.range_view),
        training=description["training"],
        metrics=description["metrics"],
    )


def _read_tensors(file: Any, weights: Weights) -> dict[str, Tensor]:
    """Read the parameters of whole parts of the described model.

    Names, sizes and types are checked before anything is read.
    """
    names = set(file.keys())
    with torch.device("meta"):  # without memory
        described = build_amvnet(weights.model, weights.taxonomy.size).state_dict()
    parameters = sum(tensor.numel() for tensor in described.values())
    if parameters > MAX_PARAMETERS:  # parts that the file lacks are built as well
        raise InputError(
            f"expected a model of at most {MAX_PARAMETERS:,} parameters, found {parameters:,}; "
            "use other weights"
        )

    present = {name.partition(".")[0] for name in names}
    expected = {name for name in described if name.partition(".")[0] in present}
    if names != expected:
        name = min(names ^ expected)
        found = "none" if name in expected else "one"
        raise InputError(
            f"expected the parameters of whole parts as described, found {found} named "
            f"{shown(name)}; train again"
        )

    for name in names:
        stored = file.get_slice(name)
        size = tuple(stored.get_shape())
        types = FLOATS if described[name].is_floating_point() else COUNTS
        if size != described[name].shape or stored.get_dtype() not in types:
            raise InputError(
                f"expected {name} of size {tuple(described[name].shape)} and type "
                f"{' or '.join(types)}, found {size} and {stored.get_dtype()}; train again"
            )

    tensors = {name: file.get_tensor(name) for name in names}
    for name, tensor in tensors.items():
        # By NumPy, in this thread: hundreds of operations of torch would each wait for its threads.
        values = (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()
        if not np.isfinite(values).all():
            raise InputError(f"expected finite parameters, found others in {name}; train again")
        if name.endswith("running_var") and (values < 0).any():
            raise InputError(f"expected variances from 0, found others in {name}; train again")
    return tensors


def built_in() -> dict[str, Path]:
    """Return the paths of the weights files that come with the package, by name."""
    folder = Path(str(resources.files("amvnet"))) / "pretrained"
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def list_weights() -> list[str]:
    """Return the names of the built-in weights, which `amvnet.load` takes."""
    return list(built_in())


def unfinished_stages(run: Path | str) -> list[str]:
    """Return the stages that were begun in the folder of a run and are not finished."""
    begun = sorted(path.parent for path in Path(run).glob(f"*/{SETTINGS}"))
    return [folder.name for folder in begun if not (folder / DONE).is_file()]


def _find(name_or_path: str) -> Path:
    if name_or_path.startswith(hub.PREFIX):
        return hub.fetch(name_or_path)

    path = built_in().get(name_or_path, Path(name_or_path))
    run_weights = path / RUN_WEIGHTS  # if the path is the folder of a training run
    if run_weights.is_file():
        return run_weights

    if (path / RECORD).is_file():
        raise InputError(
            f"{path}: expected the weights of a run, found one that has not finished a stage; go "
            "on with it: amvnet train ... --resume"
        )
    if not path.is_file():
        names = ", ".join(built_in()) or "none"
        advice = f"check the path (built in: {names})"
        raise InputError(
            f"expected a weights file, found no {name_or_path}"
            + did_you_mean(name_or_path, built_in(), advice)
        )

    return path
