"""Every number of the method and of its training, in one tree of frozen dataclasses.

The defaults are the paper's sizes for SemanticKITTI. A recipe (a YAML file in `recipes/`, or a
user's own) states only what differs from them. "Open" marks what the paper does not state.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from amvnet.config.bounds import Checked, Range, Share

StageName = Literal["rv", "bev", "head"]

# Upper limits, far above any use: a weights file or a recipe of a stranger cannot fill the memory.
MOST_CHANNELS = 8192
Channels = Annotated[int, Range(1, MOST_CHANNELS)]
Cells = Annotated[int, Range(1, 16384)]  # along one side of a view
MOST_CELLS = 2**22  # of a view; the paper's range image has 2**18
LASERS_SEEN = 0.75  # least share of a sensor's lasers that have returns in every scan
Degrees = Annotated[float, Range(-90, 90)]  # above the horizon
Metres = Annotated[float, Range(-1000, 1000)]
# Also far above any use: a mistyped number is refused before a run begins.
Epochs = Annotated[int, Range(1, 100_000)]
Scans = Annotated[int, Range(1, 100_000)]  # of a batch, or its parts
Points = Annotated[int, Range(1, 100_000_000)]
LearningRate = Annotated[float, Range(0, 100, open=True)]
Factor = Annotated[float, Range(0, 1000)]


def _check_cells(view: Checked, *sides: int) -> None:
    view.check(
        holds=math.prod(sides) <= MOST_CELLS,
        expected=f"at most {MOST_CELLS} cells",
        found=" x ".join(map(str, sides)),
    )


@dataclass(frozen=True)
class RangeViewConfig(Checked):
    """The range image (section 3.1 of the paper; its sizes: 4.2)."""

    rows: Literal["elevation", "laser", "ring"] = "elevation"
    """What sets a point's row: its elevation in the field of view; its laser, if the lasers of the
    scan are known and as many as the rows, else its elevation; or the index of its laser (ring),
    which every scan must have."""
    height: Cells = 64
    """Rows of the range image: the lasers of the sensor."""
    width: Cells = 4096
    """Columns of the range image, over 360 degrees."""
    fov_up: Degrees = 3.0
    """Upper end of the field of view, degrees above the horizon; row 0."""
    fov_down: Degrees = -25.0
    """Lower end of the field of view, degrees above the horizon; the last row."""
    nearest: Annotated[float, Range(0, 1000)] = 0.0
    """Nearer points, metres, are of the car's own body: not seen, but labelled; 0: none (open)."""

    def __post_init__(self) -> None:
        super().__post_init__()

        self.check(
            holds=self.fov_up > self.fov_down,
            expected="fov_up above fov_down",
            found=f"{self.fov_up} and {self.fov_down}",
        )
        _check_cells(self, self.height, self.width)

    @property
    def lasers(self) -> int:
        """Lasers to look for in a scan without rings: one a row; 0 if rows are no lasers."""
        return self.height if self.rows == "laser" else 0

    def has_laser_per_row(self, highest: Any) -> Any:
        """Return whether a sensor has a laser for each row, by the highest ring index of a scan.

        The highest lasers may look into the sky, without a return.

        Args:
            highest: an integer, or an array or tensor of integers.
        """
        return (highest >= LASERS_SEEN * self.height) & (highest < self.height)


@dataclass(frozen=True)
class PolarViewConfig(Checked):
    """The polar grid (section 3.1 of the paper, sizes: 4.2; section 3 of PolarNet's paper)."""

    radial: Cells = 480
    """Cells along the radius."""
    angular: Cells = 360
    """Cells around the sensor."""
    vertical: Annotated[int, Range(1, 512)] = 32
    """Cells along the height: the voxels of a pillar."""
    radius_min: Annotated[float, Range(0, 1000)] = 3.0
    """Inner radius of the grid, metres; nearer points go to the innermost cells."""
    radius_max: Metres = 50.0
    """Outer radius of the grid, metres; farther points go to the outermost cells."""
    z_min: Metres = -3.0
    """Lower end of the grid, metres above the sensor."""
    z_max: Metres = 1.5
    """Upper end of the grid, metres above the sensor."""
    nearest: Annotated[float, Range(0, 1000)] = 0.0
    """Nearer points, metres, are of the car's own body: not seen, but labelled; 0: none (open)."""

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
class RangeNetConfig(Checked):
    """The range-view network (sections 3.1 and 4.2 of the paper; its widths are open).

    With these defaults it costs 500 GMAC (billion multiply-adds) for an image of 64 x 4096: the
    paper's head costs 1 GMAC for 10,000 points, which it calls 0.2 % of this network (3.3).
    """

    stem: Channels = 32
    """Channels at full resolution."""
    stem_blocks: Annotated[int, Range(0, 16)] = 0
    """Residual blocks at full resolution."""
    widths: tuple[Channels, ...] = (96, 128, 224, 384, 384, 384, 384)
    """Channels at the width strides 2, 4, 8, ..., one entry per stride."""
    blocks: tuple[Annotated[int, Range(1, 16)], ...] = (2, 4, 4, 4, 2, 2, 2)
    """Residual blocks at each of these strides."""
    height_strides: tuple[Annotated[int, Range(1, 64)], ...] = (1, 1, 1, 1, 2, 2, 2)
    """Height stride of each of these stages: only the later ones reduce the height."""
    decoder: Channels = 160
    """Channels of the decoder."""
    head: Channels = 96
    """Channels of the last layers, at full resolution."""
    dropout: Annotated[float, Range(0, 0.99)] = 0.0
    """Probability of dropping a channel of the decoder's maps, in training (open)."""
    gru: bool = True
    """GRU layers over the maps of the last two strides; off for the ablation (Table 5)."""
    gru_padding: Share = 0.25
    """Share of the map's width that pads it circularly before the GRU runs over it."""

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
class PolarNetConfig(Checked):
    """The bird's-eye-view network: PolarNet (Zhang et al., CVPR 2020)."""

    point_widths: tuple[Channels, ...] = (64, 128, 256, 512)
    """Channels of the shared MLP over the points of a pillar."""
    pillar: Channels = 32
    """Channels of a pillar after pooling."""
    widths: tuple[Channels, ...] = (64, 128, 256, 512, 512)
    """Channels of the U-Net, from the full grid down."""
    dropblock: Annotated[float, Range(0, 0.99)] = 0.5
    """Probability of DropBlock in the decoder, in training."""
    dropblock_size: Annotated[int, Range(1, 99)] = 7
    """Side of the squares that DropBlock drops, cells."""

    def __post_init__(self) -> None:
        super().__post_init__()

        layers = len(self.point_widths)
        self.check(layers > 1, "two or more point_widths", str(layers))
        self.check(len(self.widths) > 0, "one or more widths", "none")


@dataclass(frozen=True)
class AssertionConfig(Checked):
    """The assertion that decides which points are uncertain (section 3.2 of the paper)."""

    threshold: Share = 0.85
    """tau: the largest cosine similarity of the two networks' scores of an uncertain point."""


@dataclass(frozen=True)
class PointHeadConfig(Checked):
    """The point head (section 3.3 of the paper)."""

    neighbours: Annotated[int, Range(1, 1000)] = 15
    """n: nearest neighbours of an uncertain point, among all raw points."""
    hidden: tuple[Channels, ...] = (64, 32, 32)
    """Channels of the shared MLP over the neighbours."""
    fc: Channels = 128
    """Channels of the fully connected layer before the scores."""
    position_scale: Factor = 0.05
    """Factor on x, y, z (metres) as features: brings them to the magnitude of the scores."""
    share: Share = 1.0
    """Weight of the head in its geometric mean with the ensemble, in predictions (1: the paper)."""

    def __post_init__(self) -> None:
        super().__post_init__()

        self.check(len(self.hidden) > 0, "one or more hidden layers", "none")


@dataclass(frozen=True)
class ModelConfig(Checked):
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
class AugmentConfig(Checked):
    """Augmentation of the points in training (section 3.1 of the paper lists the kinds)."""

    scale: Annotated[float, Range(0, 0.99)] = 0.05
    """Scaling by 1 +- this, one factor per scan."""
    flip: Share = 0.5
    """Probability of mirroring x, and of mirroring y."""
    jitter: Annotated[float, Range(0, 10)] = 0.01
    """Standard deviation of the noise on each coordinate, metres."""
    yaw: Annotated[float, Range(0, 360)] = 180.0
    """Rotation about the vertical by up to +- this, degrees."""
    height: Annotated[float, Range(0, 100)] = 0.0
    """Vertical shift by up to +- this, metres: sensors are mounted at various heights (open)."""
    tilt: Annotated[float, Range(0, 45)] = 0.0
    """Roll and pitch of the sensor by up to +- this each, degrees (open)."""
    intensity: Annotated[float, Range(0, 0.99)] = 0.0
    """Scaling of the intensity by 1 +- this, one factor per scan: calibrations differ (open)."""
    intensity_offset: Share = 0.0
    """Shift of the intensity by up to +- this, the same in all of a scan (open)."""
    intensity_gamma: Annotated[float, Range(0, 3)] = 0.0
    """Intensity to the power of exp(+- up to this), one exponent per scan (open)."""
    laser_gain: Annotated[float, Range(0, 0.99)] = 0.0
    """Scaling of the intensity by 1 +- this, one factor per scan and laser (open)."""
    no_intensity: Share = 0.0
    """Probability of removing the intensity of a scan (open)."""
    drop: Annotated[float, Range(0, 0.99)] = 0.0
    """Largest share of the points that is dropped from a scan at random (open)."""
    no_lasers: Share = 0.0
    """Probability of forgetting the lasers of a scan, so that elevations set its rows (open)."""
    laser_drop: Share = 0.0
    """Probability of dropping every second laser of a scan, or up to half of them (open)."""
    block_drop: Share = 0.0
    """Probability of dropping a few rectangles of azimuth and elevation, as if hidden (open)."""
    mix: Share = 0.0
    """Probability of replacing a sector by that of another training scan (PolarMix; open)."""
    laser_mix: Share = 0.0
    """Probability of taking every second band of elevation from another scan (LaserMix; open)."""
    paste: Share = 0.0
    """Probability of adding the rare objects of another scan, also turned (PolarMix; open)."""


@dataclass(frozen=True)
class NetworkTraining(Checked):
    """Training of one of the two networks: AdamW, one-cycle (section 4.2 of the paper)."""

    epochs: Epochs
    """Passes over the training scans."""
    batch: Scans
    """Scans of one optimizer step."""
    lr: LearningRate
    """Peak of the one-cycle learning rate (open)."""
    weight_decay: Factor = 0.01
    """AdamW's weight decay (open)."""
    warmup: Annotated[float, Range(0, 1, open=True)] = 0.2
    """Share of the steps before the learning rate's peak (open)."""
    hold: Annotated[float, Range(0, 0.9)] = 0.0
    """Share of the steps at the learning rate's peak, before it falls (open)."""
    region: Factor = 1.0
    """Weight of the region loss (Dice or Lovász-softmax) relative to cross-entropy (open)."""
    region_loss: Literal["default", "dice", "lovasz"] = "default"
    """The region loss; by default the paper's: Dice for rv, Lovász-softmax for bev."""
    class_weights: bool = True
    """Weight the classes by the square root of their inverse frequency; off for the ablation."""
    clip: Annotated[float, Range(0, 1e6, open=True)] = 5.0
    """Largest norm of the gradient; larger ones are scaled down (open)."""
    ema: Annotated[float, Range(0, 0.99999)] = 0.0
    """Decay of the exponential moving average of the weights that is used in the end; 0: none."""
    initial: Share = 0.0
    """Share of the initial weights in those that are used in the end, for `--init` (open)."""
    accumulate: Scans = 1
    """Parts that each process splits its batch into, if it does not fit into memory."""

    def __post_init__(self) -> None:
        super().__post_init__()

        self.check(
            holds=self.batch % self.accumulate == 0,
            expected=f"a batch that is a multiple of {self.accumulate}",
            found=str(self.batch),
        )
        self.check(
            holds=self.warmup + self.hold < 1,
            expected=f"a hold below {1 - self.warmup:g}, as the warm-up is {self.warmup:g}",
            found=f"{self.hold:g}",
        )


@dataclass(frozen=True)
class HeadTraining(Checked):
    """Training of the point head: SGD, one-cycle, frozen networks (section 4.2 of the paper)."""

    epochs: Epochs = 20
    """Passes over the uncertain points of the training scans."""
    batch: Points = 256
    """Uncertain points of one optimizer step, drawn at random."""
    lr: LearningRate = 0.1
    """Peak of the one-cycle learning rate (open)."""
    momentum: Annotated[float, Range(0.1, 0.999)] = 0.95
    """SGD's largest momentum; at the learning rate's peak it is lower by 0.1 (open)."""
    weight_decay: Factor = 1e-4
    """SGD's weight decay (open)."""
    warmup: Annotated[float, Range(0, 1, open=True)] = 0.2
    """Share of the steps before the learning rate's peak (open)."""
    views: Annotated[int, Range(0, 10_000)] = 0
    """Augmented copies of each training scan to score for the head; 0: the scan itself."""
    tau: Share = 0.0
    """Largest cosine similarity of the points that the head learns from; 0: that of the model's
    uncertain points (open)."""
    disturb: Share = 0.0
    """Probability of disturbing the scores of a network in a view of a scan (open)."""
    points: Points = 300_000
    """Limit on the uncertain points of all scans, shared equally; 1.3 kB each on disk (K = 19)."""
    drawn: Annotated[int, Range(0, 100_000_000)] = 0
    """Points of an epoch, other ones in each, drawn at random from those on disk; 0: all (open)."""
    balance: Share = 0.0
    """How far draws even out the classes: 0 draws points alike, 1 classes equally often (open)."""


@dataclass(frozen=True)
class TrainingConfig(Checked):
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
    """Weights of a stage to use: of the last epoch, or of that of the highest validation mIoU."""
    others: Share = 0.0
    """Share of an epoch for the second and later --data in all; 0: all of their scans."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the initial weights, the order of the scans and the augmentation."""
    workers: Annotated[int, Range(0, 1024)] = 0
    """Worker processes that read and augment scans; 0: none."""
    precision: Literal["auto", "32-true", "bf16-mixed", "16-mixed", "64-true"] = "32-true"
    """Lightning's precision of the forward and backward passes; auto: bf16-mixed on a device with
    bfloat16 arithmetic, 32-true on others; 64 to compare trainings."""
    accelerator: str = "auto"
    """Lightning's accelerator: auto, cpu, gpu."""


@dataclass(frozen=True)
class Recipe:
    """What to train, and how."""

    taxonomy: Literal["semantickitti", "nuscenes"] = "semantickitti"
    """The benchmark that defines the classes."""
    sensor: str = "hdl64e"
    """Name of the scans' sensor, for the weights file."""
    from_init: bool = False
    """Take the classes, the sensor and the sizes of the model from the weights of --init."""
    stages: tuple[StageName, ...] = ("rv", "bev", "head")
    """The stages that are trained by default. A baseline trains only one of the networks."""
    model: ModelConfig = ModelConfig()
    """The networks and their sizes."""
    training: TrainingConfig = field(default_factory=TrainingConfig)
    """The stages."""
