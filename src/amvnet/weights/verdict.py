"""Judge by the share of uncertain points whether the labels by some weights can be relied on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from amvnet.models.methods import METHODS

# The ratio of the odds of an uncertain point to the usual odds, above which labels are doubtful.
# A ratio of odds suits every tau, a difference of shares does not. With the built-in weights and
# their tau of 0.85, real scans of the right sensor have a ratio of up to 4; scans in another frame
# or unit mostly have a larger one (docs/log.md).
UNUSUAL_ODDS = 4.0
# The share of uncertain points below which labels are not doubtful, whatever the usual share is.
# Networks that hardly ever disagree have a usual share near 0.
FEW_UNCERTAIN = 0.01
# The mean entropy of a network that the built-in weights have on real scans of their sensor, by its
# part of the weights, and the ratio of its odds above which labels are doubtful. In another frame,
# the range view has 0.40 to 0.55 and the bird's-eye view 0.35 to 0.48 (docs/log.md).
USUAL_ENTROPY = {"range_net": 0.15, "polar_net": 0.22}
UNUSUAL_ENTROPY_ODDS = 1.6


@dataclass(frozen=True)
class Verdict:
    """The verdict on how sure the labels of some scans are; it prints as one line.

    Attributes:
        share: the share of the points that are uncertain, in [0, 1] (`Segmentation.doubt`).
        usual: this share in the scans that the weights were validated on, in [0, 1]; None if it is
            not known, for example because tau is another one.
    """

    share: float
    usual: float | None
    unusual_odds: ClassVar[float] = UNUSUAL_ODDS
    name: ClassVar[str] = "uncertain points"
    quantity: ClassVar[str] = "of the points are uncertain"

    @classmethod
    def of(cls, method: str, share: float, usual_uncertain: float | None) -> Verdict:
        """Return the verdict on the labels of a method.

        Args:
            method: the name of the method.
            share: `Segmentation.doubt` of its labels.
            usual_uncertain: the usual share of uncertain points, which only two networks have.
        """
        if METHODS[method].has_two_networks:
            return Verdict(share, usual_uncertain)
        return EntropyVerdict(share, USUAL_ENTROPY[METHODS[method].parts[0]])

    @property
    def is_doubtful(self) -> bool:
        """Whether so many points are uncertain that the weights hardly know such scans.

        False if the usual share is not known, or few points are uncertain.
        """
        if self.usual is None or self.share < FEW_UNCERTAIN:
            return False
        return self.share * (1 - self.usual) > (self.unusual_odds * self.usual * (1 - self.share))

    @property
    def shares(self) -> str:
        """Both shares as text, in percent."""
        text = f"{self.share:.1%} {self.quantity}"
        return text if self.usual is None else f"{text} (usual: {self.usual:.1%})"

    def __str__(self) -> str:
        return f"do not rely on these labels: {self.shares}" if self.is_doubtful else self.shares


class EntropyVerdict(Verdict):
    """The verdict on the labels of a single network, whose shares are mean entropies."""

    unusual_odds = UNUSUAL_ENTROPY_ODDS
    name = "mean entropy"
    quantity = "is the mean entropy of the network"
