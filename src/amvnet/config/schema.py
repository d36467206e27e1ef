"""Every number of the method and of its training, in one tree of frozen dataclasses.

The defaults are the paper's sizes for SemanticKITTI; a recipe (a YAML file in `recipes/`, or a
user's own) states only what differs from them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from amvnet.config.bounds import Checked, Count, NotNegative, Positive, Range, Share

StageName = Literal["rv", "bev", "head"]


@dataclass(frozen=True)
class RangeViewConfig(Checked):
    """The range image (section 3.1 of the paper)."""

    rows: Literal["elevation", "ring"] = "elevation"
    """What a point's row is: its elevation within the field of view, or the index of its laser."""
    height: Count = 64
    """Rows of the range image; the lasers of the sensor."""
    width: Count = 4096
    """Columns of the range image, over 360 degrees."""
    fov_up: float = 3.0
    """Upper end of the field of view, degrees above the horizon; row 0."""
    fov_down: float = -25.0
    """Lower end of the field of view, degrees above the horizon; the last row."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check(
            self.fov_up > self.fov_down,
            "fov_up above fov_down",
            f"{self.fov_up} and {self.fov_down}",
        )


@dataclass(frozen=True)
class PolarViewConfig(Checked):
    """The polar grid (section 3.1 of the paper; PolarNet, section 3)."""

    radial: Count = 480
    """Cells along the radius."""
    angular: Count = 360
    """Cells around the sensor."""
    vertical: Count = 32
    """Cells along the height: the voxels of a pillar."""
    radius_min: NotNegative = 3.0
    """Inner radius of the grid, metres; nearer points go to the innermost cells."""
    radius_max: float = 50.0
    """Outer radius of the grid, metres; farther points go to the outermost cells."""
    z_min: float = -3.0
    """Lower end of the grid, metres above the sensor."""
    z_max: float = 1.5
    """Upper end of the grid, metres above the sensor."""

    def __post_init__(self) -> None:
        super().__post_init__()
        radii, heights = (self.radius_min, self.radius_max), (self.z_min, self.z_max)
        self.check(radii[0] < radii[1], "radius_min below radius_max", f"{radii[0]} and {radii[1]}")
        self.check(heights[0] < heights[1], "z_min below z_max", f"{heights[0]} and {heights[1]}")


@dataclass(frozen=True)
class RangeNetConfig(Checked):
    """The range-view network (section 3.1 of the paper; its widths are open)."""

    stem: Count = 32
    """Channels at full resolution."""
    widths: tuple[Count, ...] = (64, 96, 160, 256, 256, 256, 256)
    """Channels at the width strides 2, 4, 8, ..., one entry a stride."""
    blocks: tuple[Count, ...] = (2, 4, 4, 4, 2, 2, 2)
    """Residual blocks at each of these strides."""
    height_strides: tuple[Count, ...] = (1, 1, 1, 1, 2, 2, 2)
    """By what each of these stages divides the height: only the later ones do."""
    decoder: Count = 128
    """Channels of the decoder."""
    head: Count = 64
    """Channels of the last layers, at full resolution."""
    dropout: Annotated[float, Range(0, 0.99)] = 0.0
    """Probability of dropping a channel of the decoder's maps, in training (open)."""
    gru: bool = True
    """GRU layers over the maps of the last two strides; off for the ablation (Table 5)."""
    gru_padding: NotNegative = 0.25
    """Share of the map's width that pads it circularly before the GRU runs over it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        stages = len(self.widths), len(self.blocks), len(self.height_strides)
        fit = len(set(stages)) == 1 and stages[0] > 1
        self.check(
            fit,
            "as many widths, blocks and height_strides, two or more",
            "{}, {} and {}".format(*stages),
        )


@dataclass(frozen=True)
class PolarNetConfig(Checked):
    """The bird's-eye-view network: PolarNet (Zhang et al., CVPR 2020)."""

    point_widths: tuple[Count, ...] = (64, 128, 256, 512)
    """Channels of the shared MLP over the points of a pillar."""
    pillar: Count = 32
    """Channels of a pillar after pooling."""
    widths: tuple[Count, ...] = (64, 128, 256, 512, 512)
    """Channels of the U-Net, from the full grid down."""
    dropblock: Annotated[float, Range(0, 0.99)] = 0.5
    """Probability of DropBlock in the decoder, in training."""
    dropblock_size: Count = 7
    """Side of the squares that DropBlock drops, cells."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check(
            len(self.point_widths) > 1, "two or more point_widths", str(len(self.point_widths))
        )
        self.check(len(self.widths) > 0, "one or more widths", "none")


@dataclass(frozen=True)
class AssertionConfig(Checked):
    """Which points are uncertain (section 3.2 of the paper)."""

    name: Literal["disagreement", "entropy", "loss"] = "disagreement"
    """The assertion: cosine similarity of the two networks' scores, their entropy, or a high loss."""
    threshold: float = 0.85
    """tau: uncertain where the cosine similarity is at most this (nats for the other assertions: at least this)."""


@dataclass(frozen=True)
class PointHeadConfig(Checked):
    """The point head (section 3.2 of the paper)."""

    neighbours: Count = 15
    """n: nearest neighbours of an uncertain point, among all raw points."""
    hidden: tuple[Count, ...] = (64, 32, 32)
    """Channels of the shared MLP over the neighbours."""
    fc: Count = 128
    """Channels of the fully connected layer before the scores."""
    position_scale: float = 0.05
    """By what a point's own x, y, z in metres are multiplied, to be of the order of its scores."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check(len(self.hidden) > 0, "one or more hidden layers", "none")


@dataclass(frozen=True)
class ModelConfig(Checked):
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
class AugmentConfig(Checked):
    """Augmentation of the points in training (section 4.1 of the paper names the kinds)."""

    scale: Annotated[float, Range(0, 0.99)] = 0.05
    """Scaling by 1 +- this, one factor a scan."""
    flip: Share = 0.5
    """Probability of mirroring x, and of mirroring y."""
    jitter: NotNegative = 0.01
    """Standard deviation of the noise on each coordinate, metres."""
    yaw: NotNegative = 180.0
    """Rotation about the vertical by up to +- this, degrees."""
    height: NotNegative = 0.0
    """Shift of all points up or down by up to +- this, metres: sensors are not mounted alike (open)."""
    intensity: Annotated[float, Range(0, 0.99)] = 0.0
    """Scaling of the intensity by 1 +- this, one factor a scan: sensors are not calibrated alike (open)."""
    no_intensity: Share = 0.0
    """Probability that a scan has no intensity at all (open)."""
    drop: Annotated[float, Range(0, 0.99)] = 0.0
    """Greatest share of the points that a scan loses at random (open)."""
    mix: Share = 0.0
    """Probability that a sector of the scan is taken from another training scan (PolarMix; open)."""


@dataclass(frozen=True)
class NetworkTraining(Checked):
    """Training of one of the two networks: AdamW, one-cycle (section 4.1 of the paper)."""

    epochs: Count
    """Passes over the training scans."""
    batch: Count
    """Scans of one optimizer step."""
    lr: Positive
    """Peak of the one-cycle learning rate (open)."""
    weight_decay: NotNegative = 0.01
    """AdamW's weight decay (open)."""
    warmup: Annotated[float, Range(0, 1, open=True)] = 0.2
    """Share of the steps before the learning rate's peak (open)."""
    region: NotNegative = 1.0
    """Weight of the region loss (Dice or Lovász-softmax) beside cross-entropy (open)."""
    class_weights: bool = True
    """Weight the classes by the square root of their inverse frequency; off for the ablation."""
    clip: Positive = 5.0
    """Largest norm of the gradient (open)."""
    accumulate: Count = 1
    """Parts a batch is split into where it does not fit into memory; over several processes, that of each."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check(
            self.batch % self.accumulate == 0,
            f"a batch of a multiple of {self.accumulate}",
            str(self.batch),
        )


@dataclass(frozen=True)
class HeadTraining(Checked):
    """Training of the point head: SGD, one-cycle, the networks frozen (section 4.1 of the paper)."""

    epochs: Count = 20
    """Passes over the uncertain points of the training scans."""
    batch: Count = 256
    """Uncertain points of one optimizer step, drawn at random."""
    lr: Positive = 0.1
    """Peak of the one-cycle learning rate (open)."""
    momentum: Annotated[float, Range(0.1, 0.999)] = 0.95
    """SGD's greatest momentum; the one-cycle schedule lowers it by 0.1 where the learning rate peaks (open)."""
    weight_decay: NotNegative = 1e-4
    """SGD's weight decay (open)."""
    warmup: Annotated[float, Range(0, 1, open=True)] = 0.2
    """Share of the steps before the learning rate's peak (open)."""
    class_weights: bool = False
    """Weight the classes as the networks' losses do (the paper has plain cross-entropy)."""
    views: Annotated[int, Range(0)] = 0
    """Times that each training scan is scored for the head, each time augmented anew; 0: once, as it is."""
    points: Count = 300_000
    """Most uncertain points that are kept, as many of each scan, drawn at random; 1.3 kB of disk each (K = 19)."""
    folds: Count = 1
    """From 2: score each training scan by networks trained without its sequence (cross-fitting); 1: by the
    final networks, as in the paper."""


@dataclass(frozen=True)
class TrainingConfig(Checked):
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
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the weights, of the order of the scans and of the augmentation."""
    workers: Annotated[int, Range(0)] = 0
    """Processes that read and augment beside the training; 0: none."""
    precision: Literal["32-true", "bf16-mixed", "16-mixed", "64-true"] = "32-true"
    """Arithmetic of the forward and backward passes, in Lightning's words; 64 to compare trainings."""
    accelerator: str = "auto"
    """Lightning's accelerator: auto, cpu, gpu."""
    compile: bool = False
    """Compile the network by torch.compile: a slow start, then faster steps."""


@dataclass(frozen=True)
class Recipe:
    """What to train, and how."""

    taxonomy: Literal["semantickitti", "nuscenes"] = "semantickitti"
    """The benchmark whose classes are learnt."""
    sensor: str = "hdl64e"
    """Name of the sensor of the scans, for the weights file."""
    stages: tuple[StageName, ...] = ("rv", "bev", "head")
    """What is trained where no stage is named; a baseline is a part of the method."""
    model: ModelConfig = ModelConfig()
    """The networks and their sizes."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """The three stages."""
