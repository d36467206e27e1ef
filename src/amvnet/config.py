"""Every number of the method and of its training, in one tree of frozen dataclasses.

The defaults are the paper's sizes for SemanticKITTI; a recipe (a YAML file in `recipes/`, or a
user's own) states only what differs from them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, get_type_hints

import yaml

from amvnet.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class RangeViewConfig:
    """The range image (section 3.1 of the paper)."""

    rows: Literal["elevation", "ring"] = "elevation"
    """What a point's row is: its elevation within the field of view, or the index of its laser."""
    height: int = 64
    """Rows of the range image; the lasers of the sensor."""
    width: int = 4096
    """Columns of the range image, over 360 degrees."""
    fov_up: float = 3.0
    """Upper end of the field of view, degrees above the horizon; row 0."""
    fov_down: float = -25.0
    """Lower end of the field of view, degrees above the horizon; the last row."""


@dataclass(frozen=True)
class PolarViewConfig:
    """The polar grid (section 3.1 of the paper; PolarNet, section 3)."""

    radial: int = 480
    """Cells along the radius."""
    angular: int = 360
    """Cells around the sensor."""
    vertical: int = 32
    """Cells along the height: the voxels of a pillar."""
    radius_min: float = 3.0
    """Inner radius of the grid, metres; nearer points go to the innermost cells."""
    radius_max: float = 50.0
    """Outer radius of the grid, metres; farther points go to the outermost cells."""
    z_min: float = -3.0
    """Lower end of the grid, metres above the sensor."""
    z_max: float = 1.5
    """Upper end of the grid, metres above the sensor."""


@dataclass(frozen=True)
class RangeNetConfig:
    """The range-view network (section 3.1 of the paper; its widths are open)."""

    stem: int = 32
    """Channels at full resolution."""
    widths: tuple[int, ...] = (64, 96, 160, 256, 256, 256, 256)
    """Channels at the width strides 2, 4, 8, ..., one entry a stride."""
    blocks: tuple[int, ...] = (2, 4, 4, 4, 2, 2, 2)
    """Residual blocks at each of these strides."""
    height_strides: tuple[int, ...] = (1, 1, 1, 1, 2, 2, 2)
    """By what each of these stages divides the height: only the later ones do."""
    decoder: int = 128
    """Channels of the decoder."""
    head: int = 64
    """Channels of the last layers, at full resolution."""
    gru: bool = True
    """GRU layers over the maps of the last two strides; off for the ablation (Table 5)."""
    gru_padding: float = 0.25
    """Share of the map's width that pads it circularly before the GRU runs over it."""


@dataclass(frozen=True)
class PolarNetConfig:
    """The bird's-eye-view network: PolarNet (Zhang et al., CVPR 2020)."""

    point_widths: tuple[int, ...] = (64, 128, 256, 512)
    """Channels of the shared MLP over the points of a pillar."""
    pillar: int = 32
    """Channels of a pillar after pooling."""
    widths: tuple[int, ...] = (64, 128, 256, 512, 512)
    """Channels of the U-Net, from the full grid down."""
    dropblock: float = 0.5
    """Probability of DropBlock in the decoder, in training."""
    dropblock_size: int = 7
    """Side of the squares that DropBlock drops, cells."""


@dataclass(frozen=True)
class AssertionConfig:
    """Which points are uncertain (section 3.2 of the paper)."""

    name: Literal["disagreement", "entropy", "loss"] = "disagreement"
    """The assertion: cosine similarity of the two networks' scores, their entropy, or a high loss."""
    threshold: float = 0.85
    """tau: uncertain where the cosine similarity is at most this (nats for the other assertions: at least this)."""


@dataclass(frozen=True)
class PointHeadConfig:
    """The point head (section 3.2 of the paper)."""

    neighbours: int = 15
    """n: nearest neighbours of an uncertain point, among all raw points."""
    hidden: tuple[int, ...] = (64, 32, 32)
    """Channels of the shared MLP over the neighbours."""
    fc: int = 128
    """Channels of the fully connected layer before the scores."""
    position_scale: float = 0.05
    """By what a point's own x, y, z in metres are multiplied, to be of the order of its scores."""


@dataclass(frozen=True)
class ModelConfig:
    """The whole of AMVNet."""

    range_view: RangeViewConfig = RangeViewConfig()
    """The range image."""
    polar_view: PolarViewConfig = PolarViewConfig()
    """The polar grid."""
    range_net: RangeNetConfig = RangeNetConfig()
    """The range-view network."""
    polar_net: PolarNetConfig = PolarNetConfig()
    """The bird's-eye-view network."""
    assertion: AssertionConfig = AssertionConfig()
    """Which points are uncertain."""
    point_head: PointHeadConfig = PointHeadConfig()
    """The point head."""


@dataclass(frozen=True)
class AugmentConfig:
    """Augmentation of the points in training (section 4.1 of the paper names the kinds)."""

    scale: float = 0.05
    """Scaling by 1 +- this, one factor a scan."""
    flip: float = 0.5
    """Probability of mirroring x, and of mirroring y."""
    jitter: float = 0.01
    """Standard deviation of the noise on each coordinate, metres."""
    yaw: float = 180.0
    """Rotation about the vertical by up to +- this, degrees."""


@dataclass(frozen=True)
class NetworkTraining:
    """Training of one of the two networks: AdamW, one-cycle (section 4.1 of the paper)."""

    epochs: int
    """Passes over the training scans."""
    batch: int
    """Scans of one optimizer step."""
    lr: float
    """Peak of the one-cycle learning rate (open)."""
    weight_decay: float = 0.01
    """AdamW's weight decay (open)."""
    warmup: float = 0.2
    """Share of the steps before the learning rate's peak (open)."""
    region: float = 1.0
    """Weight of the region loss (Dice or Lovász-softmax) beside cross-entropy (open)."""
    class_weights: bool = True
    """Weight the classes by the square root of their inverse frequency; off for the ablation."""
    clip: float = 5.0
    """Largest norm of the gradient (open)."""


@dataclass(frozen=True)
class HeadTraining:
    """Training of the point head: SGD, one-cycle, the networks frozen (section 4.1 of the paper)."""

    epochs: int = 20
    """Passes over the uncertain points of the training scans."""
    batch: int = 256
    """Uncertain points of one optimizer step, drawn at random."""
    lr: float = 0.1
    """Peak of the one-cycle learning rate (open)."""
    momentum: float = 0.9
    """SGD's momentum (open)."""
    weight_decay: float = 1e-4
    """SGD's weight decay (open)."""
    warmup: float = 0.2
    """Share of the steps before the learning rate's peak (open)."""
    class_weights: bool = False
    """Weight the classes as the networks' losses do (the paper has plain cross-entropy)."""
    views: int = 0
    """Times that each training scan is scored for the head, each time augmented anew; 0: once, as it is."""
    points_per_scan: int = 4096
    """Most uncertain points that are kept of a scan, drawn at random; 1.3 kB of disk each for K = 19, n = 15."""
    folds: int = 1
    """From 2: score each training scan by networks trained without its sequence (cross-fitting); 1: by the
    final networks, as in the paper."""


@dataclass(frozen=True)
class TrainingConfig:
    """The three stages of training."""

    rv: NetworkTraining = NetworkTraining(epochs=160, batch=32, lr=4e-3)
    """The range-view network."""
    bev: NetworkTraining = NetworkTraining(epochs=40, batch=8, lr=2e-3)
    """The bird's-eye-view network."""
    head: HeadTraining = HeadTraining()
    """The point head."""
    augment: AugmentConfig = AugmentConfig()
    """Augmentation of the points."""
    keep: Literal["best", "last"] = "best"
    """Which weights of a stage are used in the end: of the highest validation mIoU, or of the last epoch."""
    seed: int = 0
    """Seed of the weights, of the order of the scans and of the augmentation."""
    workers: int = 0
    """Processes that read and augment beside the training; 0: none."""
    precision: Literal["32-true", "bf16-mixed", "16-mixed"] = "32-true"
    """Arithmetic of the forward and backward passes, in Lightning's words."""
    accelerator: str = "auto"
    """Lightning's accelerator: auto, cpu, gpu."""
    accumulate: int = 1
    """Parts a batch is split into where it does not fit into memory."""


@dataclass(frozen=True)
class Recipe:
    """What to train, and how."""

    taxonomy: Literal["semantickitti", "nuscenes"] = "semantickitti"
    """The benchmark whose classes are learnt."""
    model: ModelConfig = ModelConfig()
    """The networks and their sizes."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """The three stages."""


def recipe_names() -> tuple[str, ...]:
    """The built-in recipes."""
    files = resources.files("amvnet.recipes").iterdir()
    return tuple(sorted(f.name.removesuffix(".yaml") for f in files if f.name.endswith(".yaml")))


def load_recipe(name_or_path: str) -> Recipe:
    """A built-in recipe by name, or a user's YAML file that states only what differs.

    The key `base` names the recipe that a file builds on; without it, the paper's sizes.

    Raises:
        InputError: where there is no such recipe, or a key or value in it is not one of ours.
    """
    return from_dict(Recipe, _recipe_tree(name_or_path), name_or_path)


def _recipe_tree(name_or_path: str) -> dict[str, Any]:
    if name_or_path in recipe_names():
        text = (resources.files("amvnet.recipes") / f"{name_or_path}.yaml").read_text()
    elif Path(name_or_path).is_file():
        text = Path(name_or_path).read_text()
    else:
        raise InputError(
            f"expected a recipe's name or a YAML file, found {name_or_path!r}; "
            f"the built-in ones are {', '.join(recipe_names())}"
        )
    try:
        tree = yaml.safe_load(text) or {}
    except yaml.YAMLError as error:
        raise InputError(f"{name_or_path}: expected YAML, found {str(error).splitlines()[0]}; mend the file") from None
    if not isinstance(tree, dict):
        raise InputError(f"{name_or_path}: expected keys and values, found {type(tree).__name__}; mend the file")
    base = tree.pop("base", None)
    return merge_trees(_recipe_tree(base), tree) if base else tree


def merge_trees(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with every leaf that `over` names replaced."""
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        both = isinstance(value, Mapping) and isinstance(below, Mapping)
        merged[key] = merge_trees(cast(Mapping[str, Any], below), value) if both else value
    return merged


def from_dict(cls: type[T], tree: Mapping[str, Any], where: str = "configuration") -> T:
    """A dataclass of this module from nested dictionaries; what is not named keeps its default.

    Raises:
        InputError: on a key that is not there, or a value of another kind than the default's.
    """
    default = _default(cls, tree, where)
    return _replace(default, tree, where)


def _default(cls: type[T], tree: Mapping[str, Any], where: str) -> T:
    needed = [f.name for f in dataclasses.fields(cast(Any, cls)) if _has_no_default(f)]
    missing = [name for name in needed if name not in tree]
    if missing:
        raise InputError(f"{where}: expected the key {missing[0]!r}, found none; add it")
    return cls(**{name: tree[name] for name in needed})


def _has_no_default(f: dataclasses.Field[Any]) -> bool:
    return f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING


def _replace(default: T, tree: Mapping[str, Any], where: str) -> T:
    kinds = get_type_hints(type(default))
    changes = {}
    for key, value in tree.items():
        if key not in kinds:
            raise InputError(f"{where}: expected one of {', '.join(kinds)}, found {key!r}; correct the key")
        changes[key] = _value(getattr(default, key), value, kinds[key], f"{where}: {key}")
    return dataclasses.replace(cast(Any, default), **changes)


def _value(default: Any, value: Any, kind: Any, where: str) -> Any:
    if dataclasses.is_dataclass(default):
        if isinstance(value, Mapping):
            return _replace(default, value, where)
    elif isinstance(default, tuple):
        if isinstance(value, list | tuple) and all(isinstance(v, int) for v in value):
            return tuple(value)
    elif allowed := getattr(kind, "__args__", None):
        if value in allowed:
            return value
        raise InputError(f"{where}: expected one of {', '.join(allowed)}, found {value!r}; correct the value")
    elif isinstance(default, float) and isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    elif type(value) is type(default):
        return value
    raise InputError(f"{where}: expected a value like {default!r}, found {value!r}; correct the value")


def to_dict(config: Any) -> dict[str, Any]:
    """Nested dictionaries and lists, as YAML and JSON hold them."""
    return {k: list(v) if isinstance(v, tuple) else to_dict(v) if dataclasses.is_dataclass(v) else v
            for k, v in vars(config).items()}  # fmt: skip
