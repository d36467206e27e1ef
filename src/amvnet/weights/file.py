"""One weights file that explains itself: safetensors with its description inside."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from amvnet.config.nested import from_dict, to_dict
from amvnet.config.schema import ModelConfig
from amvnet.data.taxonomy import Taxonomy
from amvnet.errors import InputError
from amvnet.files import atomic_write
from amvnet.models.amvnet import AMVNet, build_amvnet
from amvnet.models.point_head import PointHead
from amvnet.weights import hub

SIZES = {
    "range_net": ("range_view", "range_net"),
    "polar_net": ("polar_view", "polar_net"),
    "point_head": ("assertion", "point_head"),
}  # the parts of the method, and what of the configuration each rests on
PARTS = tuple(SIZES)
FORMAT = 1
KEY = "amvnet"  # of the description in the file's metadata


@dataclass(frozen=True)
class Weights:
    """The trained parts of an AMVNet and all that is needed to use them.

    Attributes:
        model: sizes of the views, networks and head.
        taxonomy: the classes.
        sensor: name of the sensor they were trained for.
        tensors: the parameters by name, each beginning with its part's ("range_net.", "polar_net.", "point_head.").
        training: how each part was trained, by part.
        metrics: figures of validation, by part.
    """

    model: ModelConfig
    taxonomy: Taxonomy
    sensor: str = ""
    tensors: Mapping[str, Tensor] = field(default_factory=dict, repr=False)
    training: Mapping[str, Any] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)

    @property
    def parts(self) -> tuple[str, ...]:
        """Which of the three parts are there."""
        present = {name.split(".", 1)[0] for name in self.tensors}
        return tuple(part for part in PARTS if part in present)

    def part(self, name: str) -> dict[str, Tensor]:
        """The parameters of one part, named as the part's own module names them."""
        return {
            k.removeprefix(f"{name}."): v
            for k, v in self.tensors.items()
            if k.startswith(f"{name}.")
        }

    def digest(self, name: str) -> str:
        """Tells the parameters of one part from other ones."""
        found = hashlib.sha256()
        for key, value in sorted(self.part(name).items()):
            found.update(key.encode() + value.cpu().contiguous().numpy().tobytes())
        return found.hexdigest()[:16]

    def replace_part(self, name: str, other: Weights) -> Weights:
        """The same with one part taken from other weights.

        Raises:
            InputError: where the other has no such part, other classes, or other sizes of it.
        """
        if name not in other.parts:
            raise InputError(
                f"expected weights with the part {name}, found {', '.join(other.parts) or 'none'}"
            )
        if self.taxonomy.classes != other.taxonomy.classes:
            raise InputError(
                f"expected weights for the classes of {self.taxonomy.name}, found those of {other.taxonomy.name}; "
                "train that part on this benchmark"
            )
        kept = {k: v for k, v in self.tensors.items() if not k.startswith(f"{name}.")}
        return dataclasses.replace(
            self.resized(name, other.model),
            tensors={**kept, **{f"{name}.{k}": v for k, v in other.part(name).items()}},
            training={**self.training, **_only(other.training, name)},
            metrics={**self.metrics, **_only(other.metrics, name)},
        )

    def resized(self, name: str, model: ModelConfig) -> Weights:
        """The same with the sizes that concern one part taken from another configuration."""
        changed = {key: getattr(model, key) for key in SIZES[name]}
        return dataclasses.replace(self, model=dataclasses.replace(self.model, **changed))

    def build(self) -> AMVNet:
        """The model, in evaluation mode; parts that are not there have fresh weights, but no head is no head.

        Raises:
            InputError: where the parameters do not fit the sizes.
        """
        model = build_amvnet(self.model, self.taxonomy.size)
        for part in self.parts:
            self._fill(part, getattr(model, part))
        if "point_head" not in self.parts:
            model.point_head = None
        return model.eval()

    def build_head(self) -> PointHead:
        """The point head alone, in evaluation mode.

        Raises:
            InputError: where there is none, or its parameters do not fit its sizes.
        """
        if "point_head" not in self.parts:
            raise InputError(
                "expected weights with a point head, found none; train one with --stage head"
            )
        head = PointHead(self.model.point_head, self.taxonomy.size)
        self._fill("point_head", head)
        return head.eval()

    def _fill(self, part: str, module: torch.nn.Module) -> None:
        try:
            module.load_state_dict({k: v.float() for k, v in self.part(part).items()})
        except RuntimeError:
            raise InputError(
                f"the parameters of {part} do not fit its description; train it anew"
            ) from None


def _only(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    return {name: values[name]} if name in values else {}


def part_state(part: str, module: torch.nn.Module) -> dict[str, Tensor]:
    """A module's parameters under its part's name, on the CPU and apart from the module."""
    return {
        f"{part}.{k}": v.detach().cpu().clone().contiguous() for k, v in module.state_dict().items()
    }


def save(weights: Weights, path: Path | str, half: bool = False) -> Path:
    """Write a weights file, whole or not at all.

    Args:
        half: keep matrices and kernels as float16: half the size, for weights that are only used.

    Raises:
        OSError: where there is no room for it.
    """
    description = {
        "format": FORMAT,
        "model": to_dict(weights.model),
        "taxonomy": weights.taxonomy.to_dict(),
        "sensor": weights.sensor,
        "training": weights.training,
        "metrics": weights.metrics,
    }
    tensors = {k: v.half() if half and v.ndim > 1 else v for k, v in weights.tensors.items()}
    with atomic_write(path) as part:
        try:
            save_file(tensors, part, metadata={KEY: json.dumps(description)})
        except SafetensorError as error:  # a full disk
            raise OSError(errno.EIO, str(error).splitlines()[0], str(path)) from None
    return Path(path)


def load(name_or_path: str | Path) -> Weights:
    """Read a weights file, a built-in one by name (`sim-hdl64e`), or one of the hub (`hf-hub:OWNER/NAME`).

    Nothing in it is ever run.

    Raises:
        InputError: where there is no such file or name, or it is not a weights file of this project.
    """
    path = _find(str(name_or_path))
    try:
        with safe_open(path, "pt") as file:
            description = json.loads((file.metadata() or {}).get(KEY, "null"))
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118  not a dictionary
    except (SafetensorError, OSError, ValueError):
        raise InputError(
            f"{path}: expected a safetensors file, found something else; give AMVNet weights"
        ) from None
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise InputError(
            f"{path}: expected weights with AMVNet's description inside, found none; give AMVNet weights"
        )
    for key, kind in (
        ("model", dict),
        ("taxonomy", dict),
        ("sensor", str),
        ("training", dict),
        ("metrics", dict),
    ):
        if not isinstance(description.get(key), kind):
            raise InputError(
                f"{path}: expected a description with {key}, found {description.get(key)!r}; train anew"
            )
    return Weights(
        model=from_dict(ModelConfig, description["model"], f"{path}: model"),
        taxonomy=Taxonomy.from_dict(description["taxonomy"]),
        sensor=description["sensor"],
        tensors=tensors,
        training=description["training"],
        metrics=description["metrics"],
    )


def built_in() -> dict[str, Path]:
    """The weights that come with the package, by name."""
    folder = Path(str(resources.files("amvnet"))) / "pretrained"
    return {path.stem: path for path in sorted(folder.glob("*.safetensors"))}


def _find(name_or_path: str) -> Path:
    if name_or_path.startswith(hub.PREFIX):
        return hub.fetch(name_or_path)
    path = built_in().get(name_or_path, Path(name_or_path))
    if path.is_dir() and (path / "weights.safetensors").is_file():
        return path / "weights.safetensors"  # the folder of a training run
    if not path.is_file():
        names = ", ".join(built_in()) or "none"
        raise InputError(
            f"expected a weights file, found no {name_or_path}; check the path (built in: {names})"
        )
    return path
