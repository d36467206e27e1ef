"""How sure the labels of scans are, judged by how often the two networks disagree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# A share of uncertain points is unusual if its odds are more than this multiple of the usual odds.
# Unlike a difference of shares, the odds suit every tau: for weights of simulated streets, real
# scans of the right sensor have up to 5 times the usual odds at a tau of 0.5 and of 0.82, and scans
# in another frame or unit more (docs/log/real_scans.md).
UNUSUAL_ODDS = 5.0


@dataclass(frozen=True)
class Verdict:
    """How sure the labels of some scans are; it prints as one line.

    Attributes:
        share: the share of the points that are uncertain, in [0, 1].
        usual: this share in the scans that the weights were validated on.
    """

    share: float
    usual: float

    @property
    def is_doubtful(self) -> bool:
        """Whether so many points are uncertain that the weights do not know such scans."""
        return self.share * (1 - self.usual) > UNUSUAL_ODDS * self.usual * (1 - self.share)

    @property
    def shares(self) -> str:
        """Both shares, as text."""
        return f"{self.share:.1%} of the points are uncertain (usual: {self.usual:.1%})"

    def __str__(self) -> str:
        return f"do not rely on these labels: {self.shares}" if self.is_doubtful else self.shares


def uncertain_share(labels: np.ndarray, uncertain: np.ndarray) -> float:
    """Return the share of a scan's valid points that are uncertain; 0 if there are none.

    Args:
        labels: (N,) train ids; 0 for points that are not valid.
        uncertain: (N,) bool.
    """
    return int(np.count_nonzero(uncertain)) / max(int(np.count_nonzero(labels)), 1)
