"""Define every number of the method and of its training in one tree of frozen dataclasses.

The defaults are the paper's sizes for SemanticKITTI. A recipe (a YAML file in `recipes/`, or a
user's own file) states only what differs from the defaults. "(open)" marks a number that the paper
does not state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, overload

from amvnet.config.bounds import Bounded, Range, Seed, Share
from amvnet.config.nested import flat, to_dict

NetworkName = Literal["rv", "bev"]  # of a stage that trains a network
StageName = Literal[NetworkName, "head"]

# These limits are far above any use. They keep a stranger's weights file or recipe from filling the
# memory.
MAX_CHANNELS = 8192  # largest number of channels in a layer
Channels = Annotated[int, Range(1, MAX_CHANNELS)]
Cells = Annotated[int, Range(1, 16384)]  # number of cells along one side of a view
MAX_CELLS = 2**22  # largest number of cells in a view; the paper's range image has 2**18
MIN_LASERS_SEEN = 0.75  # smallest share of a sensor's lasers that have returns in every scan
Degrees = Annotated[float, Range(-90, 90)]  # elevation above the horizon
Metres = Annotated[float, Range(-1000, 1000)]
# These limits are far above any use as well. They refuse a mistyped number before a run begins.
Epochs = Annotated[int, Range(1, 100_000)]
Scans = Annotated[int, Range(1, 100_000)]  # number of scans in a batch, or of its parts
Points = Annotated[int, Range(1, 100_000_000)]
LearningRate = Annotated[float, Range(0, 100, open=True)]
Factor = Annotated[float, Range(0, 1000)]


def _check_cells(view: Bounded, *sides: int) -> None:
    view.check(
        holds=math.prod(sides) <= MAX_CELLS,
        expected=f"at most {MAX_CELLS} cells",
        found=" x ".join(map(str, sides)),
    )


@dataclass(frozen=True)
class RangeViewConfig(Bounded):
    """The range image (section 3.1 of the paper; section 4.2 has its sizes)."""

    rows: Literal["elevation", "laser", "ring"] = "elevation"
    """What sets a point's row. elevation: its elevation in the field of view. laser: its laser if
    the scan's lasers are known and there is one for each row, else its elevation. ring: the index
    of its laser, which every scan must have."""
    height: Cells = 64
    """Rows of the range image, one for each laser of the sensor."""
    width: Cells = 4096
    """Columns of the range image, over 360 degrees."""
    fov_up: Degrees = 3.0
    """Upper end of the field of view (row 0), degrees above the horizon."""
    fov_down: Degrees = -25.0
    """Lower end of the field of view (the last row), degrees above the horizon."""
    nearest: Annotated[float, Range(0, 1000)] = 0.0
    """Range below which points belong to the car itself, metres: the network does not see them, but
    they get labels. 0: no points (open)."""
    hidden: Annotated[float, Range(0, 1000)] = 0.0
    """A point is hidden if its range differs by more than this from the range that its pixel shows,
    metres. It gets the mean scores of the pixels around it that show its own range (not in the
    paper). 0: each point gets the scores of its pixel."""

    def __post_init__(self) -> None:
        super().__post_init__()

        self.check(
            holds=self.fov_up > self.fov_down,
            expected="fov_up above fov_down",
            found=f"{self.fov_up} and {self.fov_down}",
        )
        _check_cells(self, self.height, self.width)

    def has_laser_per_row(self, highest: Any) -> Any:
        """Return whether a sensor has one laser for each row.

        The highest lasers may look into the sky, where nothing returns.

        Args:
            highest: highest ring index in a scan: an integer, or an array or tensor of integers.
        """
        return (highest >= MIN_LASERS_SEEN * self.height) & (highest < self.height)


@dataclass(frozen=True)
class PolarViewConfig(Bounded):
    """The polar grid (section 3.1 of the paper and 3 of PolarNet's; section 4.2 has its sizes)."""

    radial: Cells = 480
    """Cells along the radius."""
    angular: Cells = 360
    """Cells around the sensor."""
    vertical: Annotated[int, Range(1, 512)] = 32
    """Cells along the height, which are the voxels of a pillar."""
    radius_min: Annotated[float, Range(0, 1000)] = 3.0
    """Inner radius of the grid, metres; nearer points go to the innermost cells."""
    radius_max: Metres = 50.0
    """Outer radius of the grid, metres; farther points go to the outermost cells."""
    z_min: Metres = -3.0
    """Lower end of the grid, metres above the sensor."""
    z_max: Metres = 1.5
    """Upper end of the grid, metres above the sensor."""
    nearest: Annotated[float, Range(0, 1000)] = 0.0
    """Range below which points belong to the car itself, metres: the network does not see them, but
    they get labels. 0: no points (open)."""

    def __post_init__(self) -> None:
        super().__post_init__()

        self.check(
            holds=self.radius_min < self.radius_max,
            expected="radius_min below radius_max",
            found=f"{self.radius_min} and {self.radius_max}",
        )
        self.check(
            holds=self.z_min < self.z_max,
            expected="z_min below z_max",
            found=f"{self.z_min} and {self.z_max}",
        )
        _check_cells(self, self.radial, self.angular)


@dataclass(frozen=True)
class RangeNetConfig(Bounded):
    """The range-view network (sections 3.1 and 4.2 of the paper; its widths are open).

    With these defaults, an image of 64 x 4096 costs 500 GMAC (billion multiply-adds). This is what
    the paper implies: its head costs 1 GMAC for 10,000 points, 0.2 % of this network (section 3.3).
    """

    stem: Channels = 32
    """Channels at full resolution."""
    stem_blocks: Annotated[int, Range(0, 16)] = 0
    """Residual blocks at full resolution."""
    steps: bool = False
    """Also show the network how far and how high each pixel's surface steps to its neighbours."""
    widths: tuple[Channels, ...] = (96, 128, 224, 384, 384, 384, 384)
    """Channels of each stage. The width strides of the stages are 2, 4, 8, ..."""
    blocks: tuple[Annotated[int, Range(1, 16)], ...] = (2, 4, 4, 4, 2, 2, 2)
    """Residual blocks of each stage."""
    height_strides: tuple[Annotated[int, Range(1, 64)], ...] = (1, 1, 1, 1, 2, 2, 2)
    """Height stride of each stage. Only the later stages reduce the height."""
    decoder: Channels = 160
    """Channels of the decoder."""
    head: Channels = 96
    """Channels of the last layers, at full resolution."""
    dropout: Annotated[float, Range(0, 0.99)] = 0.0
    """Probability of dropping a channel of the decoder's maps in training (open)."""
    gru: bool = True
    """Run GRU layers over the maps of the last two stages; off for the ablation (Table 5)."""
    gru_padding: Share = 0.25
    """Share of a map's width that is padded circularly before the GRU runs over the map."""

    def __post_init__(self) -> None:
        super().__post_init__()

        widths = len(self.widths)
        blocks = len(self.blocks)
        strides = len(self.height_strides)
        self.check(
            holds=widths == blocks == strides and widths > 1,
            expected="as many widths as blocks and height_strides, two or more",
            found=f"{widths}, {blocks} and {strides}",
        )


@dataclass(frozen=True)
class PolarNetConfig(Bounded):
    """The bird's-eye-view network: PolarNet (Zhang et al., CVPR 2020)."""

    point_widths: tuple[Channels, ...] = (64, 128, 256, 512)
    """Channels of the layers of the shared MLP over the points of a pillar."""
    pillar: Channels = 32
    """Channels of a pillar after pooling."""
    widths: tuple[Channels, ...] = (64, 128, 256, 512, 512)
    """Channels of the levels of the U-Net, from fine to coarse."""
    decoder: tuple[Channels, ...] = ()
    """Channels of the levels of the U-Net's decoder, from coarse to fine, one level fewer than
    `widths`; none: the channels of `widths`. The authors' code: 256, 128, 64, 64."""
    input_norm: bool = False
    """Normalise the map of the pillars by batch norm before the U-Net, as in the authors' code."""
    dropblock: Annotated[float, Range(0, 0.99)] = 0.5
    """Probability that DropBlock drops a cell of the decoder's maps in training. 0.395 is the
    share that the authors' code drops with its p = 0.5."""
    dropblock_size: Annotated[int, Range(1, 99)] = 7
    """Side of the squares that DropBlock drops, cells."""

    def __post_init__(self) -> None:
        super().__post_init__()

        layers = len(self.point_widths)
        self.check(layers > 1, "two or more point_widths", str(layers))
        self.check(len(self.widths) > 0, "one or more widths", "none")
        levels = len(self.widths) - 1
        self.check(
            len(self.decoder) in (0, levels),
            f"{levels} values of decoder, one fewer than widths",
            str(len(self.decoder)),
        )


@dataclass(frozen=True)
class AssertionConfig(Bounded):
    """The assertion that decides which points are uncertain (section 3.2 of the paper)."""

    threshold: Share = 0.85
    """tau: largest cosine similarity of the two networks' scores at an uncertain point."""
    lead: Annotated[float, Range(0, 1e6)] = 0.0
    """The head classifies only disputed points: the uncertain points to which the networks give
    different classes, or at which the ensemble's best class is at most this many times as probable
    as its second. 0: all uncertain points (paper)."""


@dataclass(frozen=True)
class PointHeadConfig(Bounded):
    """The point head (section 3.3 of the paper)."""

    neighbours: Annotated[int, Range(1, 1000)] = 15
    """n: number of nearest neighbours of an uncertain point, chosen from all points of the scan."""
    hidden: tuple[Channels, ...] = (64, 32, 32)
    """Channels of the layers of the shared MLP over the neighbours."""
    fc: Channels = 128
    """Channels of the fully connected layer before the scores."""
    position_scale: Factor = 0.05
    """Factor on x, y, z in metres as features, which brings them to the magnitude of the scores."""
    share: Share = 1.0
    """Weight of the head in predictions, in its geometric mean with the ensemble. Paper: 1."""
    cell: Annotated[float, Range(0, 10)] = 0.0
    """Edge of cubes of space, metres: the head classifies the first disputed point in each cube,
    and the others there get its scores. 0: it classifies all of them (paper)."""

    def __post_init__(self) -> None:
        super().__post_init__()

        self.check(len(self.hidden) > 0, "one or more hidden layers", "none")


@dataclass(frozen=True)
class ModelConfig(Bounded):
    """The whole model."""

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
class Part:
    """A part of the method.

    Attributes:
        name: its name in `AMVNet` and in weights.
        sizes: the fields of `ModelConfig` that set its sizes.
        title: its name in words.
        short: its name in tables and figures.
    """

    name: str
    sizes: tuple[str, ...]
    title: str
    short: str

    def differences(self, model: ModelConfig, other: ModelConfig) -> list[str]:
        """Return in words the sizes of the part in a model that differ in another model."""
        others = dict(flat(to_dict(other), "model"))
        found = []
        for section in self.sizes:
            for key, value in flat(to_dict(getattr(model, section)), f"model.{section}"):
                if value != others[key]:
                    found.append(f"{key} is {value}, not {others[key]}")
        return found


# The parts by the stage that trains each of them, in the order of the stages.
PART_OF: dict[StageName, Part] = {
    "rv": Part("range_net", ("range_view", "range_net"), "Range-view network", "RV"),
    "bev": Part("polar_net", ("polar_view", "polar_net"), "Bird's-eye-view network", "BEV"),
    "head": Part("point_head", ("assertion", "point_head"), "Point head", "head"),
}
NETWORK_STAGES: tuple[NetworkName, ...] = ("rv", "bev")
PARTS = tuple(part.name for part in PART_OF.values())
BOTH_NETWORKS = tuple(PART_OF[stage].name for stage in NETWORK_STAGES)


@dataclass(frozen=True)
class AugmentConfig(Bounded):
    """Augmentation of the points in training (section 3.1 of the paper lists the kinds)."""

    scale: Annotated[float, Range(0, 0.99)] = 0.05
    """Scaling by a factor from 1 - this to 1 + this, one for each scan."""
    flip: Share = 0.5
    """Probability of mirroring x, and of mirroring y."""
    jitter: Annotated[float, Range(0, 10)] = 0.01
    """Standard deviation of the noise on each coordinate, metres."""
    yaw: Annotated[float, Range(0, 360)] = 180.0
    """Largest rotation about the vertical axis in either direction, degrees."""
    height: Annotated[float, Range(0, 100)] = 0.0
    """Largest shift up or down, metres: the mounting heights of sensors differ (open)."""
    tilt: Annotated[float, Range(0, 45)] = 0.0
    """Largest roll, and largest pitch, of the sensor in either direction, degrees (open)."""
    intensity: Annotated[float, Range(0, 0.99)] = 0.0
    """Scaling of the intensity by a factor from 1 - this to 1 + this, one for each scan: the
    calibrations of sensors differ (open)."""
    intensity_offset: Share = 0.0
    """Largest shift of the intensity up or down, one for each scan (open)."""
    intensity_gamma: Annotated[float, Range(0, 3)] = 0.0
    """Power of the intensity from exp(-this) to exp(this), one for each scan (open)."""
    laser_gain: Annotated[float, Range(0, 0.99)] = 0.0
    """Scaling of the intensity by a factor from 1 - this to 1 + this, one for each laser of each
    scan (open)."""
    no_intensity: Share = 0.0
    """Probability of removing the intensity of a scan (open)."""
    drop: Annotated[float, Range(0, 0.99)] = 0.0
    """Largest share of a scan's points that is dropped at random (open)."""
    no_lasers: Share = 0.0
    """Probability of forgetting the lasers of a scan, so that elevations set its rows (open)."""
    laser_drop: Share = 0.0
    """Probability of dropping every second laser of a scan, or up to half of its lasers (open)."""
    block_drop: Share = 0.0
    """Probability of dropping a few rectangles of azimuth and elevation, as if hidden (open)."""
    mix: Share = 0.0
    """Probability of replacing a sector by the same sector of another scan (PolarMix; open)."""
    laser_mix: Share = 0.0
    """Probability of taking every second band of elevation from another scan (LaserMix; open)."""
    paste: Share = 0.0
    """Probability of adding the rare objects of another scan, some of them turned (PolarMix;
    open)."""


@dataclass(frozen=True)
class NetworkTraining(Bounded):
    """Training of one network: an optimizer and a one-cycle schedule (section 4.2 of the paper)."""

    epochs: Epochs
    """Number of passes over the training scans."""
    batch: Scans
    """Number of scans in one optimizer step."""
    lr: LearningRate
    """Peak of the one-cycle learning rate (open)."""
    optimizer: Literal["adamw", "muon"] = "adamw"
    """adamw: the paper's optimizer. muon: the same for the first and the last layer, for biases and
    for norms; all other kernels take steps of equal length in all directions (not in the paper)."""
    weight_decay: Factor = 0.01
    """Decoupled weight decay (open)."""
    warmup: Annotated[float, Range(0, 1, open=True)] = 0.2
    """Share of the steps before the peak of the learning rate (open)."""
    hold: Annotated[float, Range(0, 0.9)] = 0.0
    """Share of the steps at the peak of the learning rate, before it falls (open)."""
    region: Factor = 1.0
    """Weight of the region loss (Dice or Lovász-softmax) relative to cross-entropy (open)."""
    region_loss: Literal["default", "dice", "lovasz"] = "default"
    """The region loss. default: the paper's loss, Dice for rv and Lovász-softmax for bev."""
    class_weights: Share = 0.5
    """Power of the inverse frequency that weighs a class; 0.5 is its square root. 0: no weights."""
    clip: Annotated[float, Range(0, 1e6, open=True)] = 5.0
    """Largest norm of the gradient; larger gradients are scaled down (open)."""
    ema: Annotated[float, Range(0, 0.99999)] = 0.0
    """Decay of the exponential moving average of the weights, which becomes the result; 0: no
    average."""
    initial: Share = 0.0
    """Share of the initial weights of `--init` in the result, which is a mean (open)."""
    distill: Factor = 0.0
    """Weight of the distillation (not in the paper). On scans of a dataset that lacks a class which
    another dataset has, it keeps the probabilities of the class near those of `--init`."""
    accumulate: Scans = 1
    """Number of parts into which each process splits a batch that does not fit into memory."""

    def __post_init__(self) -> None:
        super().__post_init__()

        self.check(
            holds=self.batch % self.accumulate == 0,
            expected=f"a batch that is a multiple of {self.accumulate}",
            found=str(self.batch),
        )
        self.check(
            holds=self.warmup + self.hold < 1,
            expected=f"a hold below {1 - self.warmup:g}, because the warm-up is {self.warmup:g}",
            found=f"{self.hold:g}",
        )


@dataclass(frozen=True)
class HeadTraining(Bounded):
    """Training of the head on frozen networks: SGD, one-cycle (section 4.2 of the paper)."""

    epochs: Epochs = 20
    """Number of passes over the uncertain points of the training scans."""
    batch: Points = 256
    """Number of uncertain points in one optimizer step, drawn at random."""
    lr: LearningRate = 0.1
    """Peak of the one-cycle learning rate (open)."""
    momentum: Annotated[float, Range(0.1, 0.999)] = 0.95
    """SGD's largest momentum. At the peak of the learning rate it is lower by 0.1 (open)."""
    weight_decay: Factor = 1e-4
    """SGD's weight decay (open)."""
    warmup: Annotated[float, Range(0, 1, open=True)] = 0.2
    """Share of the steps before the peak of the learning rate (open)."""
    views: Annotated[int, Range(0, 10_000)] = 0
    """Number of augmented copies of each training scan to score for the head; 0: score the scan
    itself."""
    tau: Share = 0.0
    """Largest cosine similarity of the points that the head learns from; 0: take the threshold of
    the model's assertion (open)."""
    disturb: Share = 0.0
    """Probability of disturbing the scores of a network in a view of a scan (open)."""
    points: Points = 300_000
    """Largest number of uncertain points of all scans, which share it equally. Each point takes 1.3
    kB on disk (for 19 classes)."""
    drawn: Annotated[int, Range(0, 100_000_000)] = 0
    """Number of points that each epoch draws at random from the points on disk; 0: take all
    (open)."""
    balance: Share = 0.0
    """How much draws balance the classes. 0: all points are equally likely; 1: all classes are
    (open)."""


@dataclass(frozen=True)
class TrainingConfig(Bounded):
    """The stages of training."""

    rv: NetworkTraining = NetworkTraining(epochs=160, batch=32, lr=4e-3)
    """The range-view network."""
    bev: NetworkTraining = NetworkTraining(epochs=40, batch=8, lr=2e-3)
    """The bird's-eye-view network."""
    head: HeadTraining = HeadTraining()
    """The point head."""
    augment: AugmentConfig = AugmentConfig()
    """Augmentation of the points."""
    keep: Literal["best", "last"] = "last"
    """The epoch whose weights a stage keeps. best: the epoch with the highest validation mIoU;
    last: the last epoch."""
    others: Share = 0.0
    """Share of an epoch that the second and later --data take together; 0: take all their scans."""
    seed: Seed = 0
    """Seed of the initial weights, the order of the scans in an epoch and the augmentation."""
    workers: Annotated[int, Range(0, 1024)] = 0
    """Number of worker processes that read and augment scans; 0: the training itself does it."""
    precision: Literal["auto", "32-true", "bf16-mixed", "16-mixed", "64-true"] = "32-true"
    """Lightning's precision of the forward and backward passes. auto: bf16-mixed on a device with
    bfloat16 arithmetic, 32-true on others. 64-true serves to compare trainings."""
    accelerator: str = "auto"
    """Lightning's accelerator: auto, cpu or gpu."""

    @overload
    def of(self, stage: NetworkName) -> NetworkTraining: ...
    @overload
    def of(self, stage: StageName) -> NetworkTraining | HeadTraining: ...
    def of(self, stage: StageName) -> NetworkTraining | HeadTraining:
        """Return the training of a stage."""
        if stage == "head":
            return self.head
        return self.rv if stage == "rv" else self.bev


@dataclass(frozen=True)
class Recipe:
    """What to train, and how."""

    taxonomy: Literal["semantickitti", "nuscenes"] = "semantickitti"
    """The benchmark that defines the classes."""
    sensor: str = "hdl64e"
    """Name of the scans' sensor, for the weights file."""
    from_init: bool = False
    """Take the sensor and the sizes of the model from the weights of --init."""
    stages: tuple[StageName, ...] = ("rv", "bev", "head")
    """The stages to train by default. A baseline trains only one network."""
    model: ModelConfig = ModelConfig()
    """The networks and their sizes."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """The stages."""
