"""The stage that trains both networks and the point head together, end to end.

The paper names it as future work.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.modules.batchnorm import _BatchNorm

from amvnet.config.schema import JointTraining, TrainingConfig
from amvnet.data.taxonomy import Taxonomy
from amvnet.distributed import ALONE, Processes
from amvnet.models.amvnet import AMVNet, Scores
from amvnet.models.assertions import Assertion
from amvnet.models.point_head import head_features, point_table
from amvnet.models.views.points import PointBatch
from amvnet.training.losses import at_least_float32
from amvnet.training.stages import Batch, PolarStage, RangeStage, ScanStage
from amvnet.weights.file import UNCERTAIN


class JointStage(ScanStage):
    """Stage `joint`: the loss is the sum of those of the stages `rv`, `bev` and `head`.

    The gradient of the head's loss reaches both networks through f and g.

    Args:
        model: with trained parts.
        assertion: finds the uncertain points to train the head with; may use labels.
        training: the recipe's numbers, of which those of the other stages decide the losses.
        taxonomy: the K classes.
        weights: (K,) class weights, for the losses that have them; None if none has.
        processes: those that share the training.
    """

    name = "joint"
    config: JointTraining

    def __init__(
        self,
        model: AMVNet,
        assertion: Assertion,
        training: TrainingConfig,
        taxonomy: Taxonomy,
        weights: np.ndarray | None,
        processes: Processes = ALONE,
    ) -> None:
        head_weights = weights if training.head.class_weights else None
        super().__init__(training.joint, taxonomy, head_weights, processes)
        self.trained: AMVNet = model
        self.assertion = assertion

        # The stages of the networks, for their logits and losses.
        rv_weights = weights if training.rv.class_weights else None
        self.rv = RangeStage(
            model.range_view, model.range_net, training.rv, taxonomy, weights=rv_weights
        )
        bev_weights = weights if training.bev.class_weights else None
        self.bev = PolarStage(
            model.polar_view, model.polar_net, training.bev, taxonomy, weights=bev_weights
        )

        self._clear_counts()

    @property
    def compilable(self) -> list[nn.Module]:
        return [self.trained.range_net, self.trained.polar_net]

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        # Statistics of a few scans would disturb trained parts more than so low a rate improves
        # them, and with fixed ones the loss of a scan does not depend on the others of its batch.
        for module in self.trained.modules():
            if isinstance(module, _BatchNorm):
                module.eval()

    def training_step(self, batch: Batch, index: int) -> Tensor:
        points, labels = batch
        rv_logits, rv_labels, f_logits = self.rv.logits(points, labels)
        bev_logits, bev_labels, g_logits = self.bev.logits(points, labels)

        config = self.config
        rv = self.rv.mean_loss(rv_logits, rv_labels)
        bev = self.bev.mean_loss(bev_logits, bev_labels)
        head = self.head_loss(points, labels, _probabilities(f_logits), _probabilities(g_logits))
        loss = config.rv_loss * rv + config.bev_loss * bev + config.head_loss * head

        self.check_finite(loss, f"at the scans {', '.join(points.names)}")
        self.log("train/loss", loss, prog_bar=True, batch_size=points.count)
        for name, part in (("rv", rv), ("bev", bev), ("head", head)):
            self.log(f"train/{name}", part, batch_size=points.count)
        return loss * self.share_of_step(points.count, index)

    def head_loss(self, batch: PointBatch, labels: Tensor, f: Tensor, g: Tensor) -> Tensor:
        """Return the head's loss at random uncertain points of each scan; the mean over scans.

        Args:
            batch: B scans.
            labels: (P,) train ids.
            f: (P, K) class probabilities by the range view.
            g: (P, K) class probabilities by the bird's-eye view.
        """
        head = self.trained.point_head
        assert head is not None

        # Which points are uncertain has no gradient.
        with torch.no_grad():
            uncertain = self.assertion(f, g, batch.points, labels) & (labels > 0)

        losses = []
        # The head multiplies so little that a lower precision would save nothing.
        with torch.autocast(batch.points.device.type, enabled=False):
            for scan in batch.slices():
                points = batch.points[scan]
                index = self._drawn(uncertain[scan])  # (U,)
                near = self.trained.find_neighbours(points, index)  # (U, n)

                table = point_table(points, f[scan], g[scan])
                logits = head(*head_features(head.config, table, index, near))
                losses.append(self._cross_entropy(logits, labels[scan][index]))
        return torch.stack(losses).mean()

    def score(self, batch: PointBatch) -> Scores:
        """Return the class probabilities of the points of a batch of scans, as AMVNet does."""
        labels = batch.scan.new_zeros(len(batch.points))  # only losses need labels
        _, _, f_logits = self.rv.logits(batch, labels)
        _, _, g_logits = self.bev.logits(batch, labels)

        with torch.autocast(batch.points.device.type, enabled=False):
            return self.trained.fuse(batch, _probabilities(f_logits), _probabilities(g_logits))

    def validation_step(self, batch: Batch, index: int) -> None:
        points, labels = batch
        scores = self.score(points)
        assert scores.rv is not None
        assert scores.bev is not None

        self.count(labels, scores.merged.argmax(dim=1) + 1)
        self.rv_matrix += self.confusion(labels, scores.rv.argmax(dim=1) + 1)
        self.bev_matrix += self.confusion(labels, scores.bev.argmax(dim=1) + 1)
        labelled = labels > 0
        self.points += [int((scores.uncertain & labelled).sum()), int(labelled.sum())]

    def on_validation_epoch_start(self) -> None:
        super().on_validation_epoch_start()
        self._clear_counts()

    def on_validation_epoch_end(self) -> None:
        super().on_validation_epoch_end()
        self.log_metrics("val/rv", self.summed(self.rv_matrix))
        self.log_metrics("val/bev", self.summed(self.bev_matrix))
        uncertain, labelled = self.summed(self.points)
        self.log(UNCERTAIN, float(uncertain / max(labelled, 1)))

    def _clear_counts(self) -> None:
        self.rv_matrix = self.empty_matrix()
        self.bev_matrix = self.empty_matrix()
        self.points = np.zeros(2)  # of the validation: uncertain ones, all; labelled ones only

    def _drawn(self, uncertain: Tensor) -> Tensor:
        """Return the indices of a random choice of the points (P,) that are uncertain."""
        index = uncertain.nonzero()[:, 0]
        order = torch.randperm(len(index), device=index.device)
        return index[order[: self.config.points]]

    def _cross_entropy(self, logits: Tensor, labels: Tensor) -> Tensor:
        if not len(labels):
            return logits.sum() * 0  # so that every parameter of the head has a gradient
        return F.cross_entropy(logits, labels - 1, self.class_weights)


def _probabilities(logits: Tensor) -> Tensor:
    return at_least_float32(logits).softmax(dim=1)
