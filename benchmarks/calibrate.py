"""Calibrate trained networks: rare classes are named less often, and the ensemble trusts BEV more.

    python benchmarks/calibrate.py WEIGHTS COUNTS OUT [--prior 0.1] [--bev 0.65]

- The class weights of the loss are the inverse frequencies to the power of 1/2, so the trained
  networks name rare classes more often than they occur. This adds the share `--prior` of the
  logarithm of the frequencies to the networks' last biases, as if the power had been 1/2 - share.
  COUNTS is the file `class_counts.npz` of the run.
- RV is too sure of itself, BEV not sure enough. This multiplies the scores before the softmax, RV's
  by 2 (1 - b) and BEV's by 2 b for `--bev` b, so that the geometric mean of the new probabilities
  is RV^(1 - b) BEV^b of the old ones. The labels of a single network stay the same.

Calibrate weights once, and train the head afterwards, as its inputs change.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from amvnet.training.losses import class_weights
from amvnet.weights.file import load, save


def main() -> None:
    """Write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights")
    parser.add_argument("counts", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--prior", type=float, default=0.1)
    parser.add_argument("--bev", type=float, default=0.65)
    options = parser.parse_args()

    with np.load(options.counts) as counted:
        # The weights are frequencies to the power of -1/2.
        log_frequency = -2 * np.log(class_weights(counted["counts"]))
    shift = torch.tensor(options.prior * (log_frequency - log_frequency.mean()))

    weights = load(options.weights)
    tensors = dict(weights.tensors)
    factors = {"range_net": 2 * (1 - options.bev), "polar_net": 2 * options.bev}
    for network, factor in factors.items():
        kernel = tensors[f"{network}.scores.weight"]
        bias = tensors[f"{network}.scores.bias"]
        shifted = (bias.unflatten(0, (-1, len(shift))) + shift).flatten()
        tensors[f"{network}.scores.weight"] = (factor * kernel).to(kernel.dtype)
        tensors[f"{network}.scores.bias"] = (factor * shifted).to(bias.dtype)
    save(replace(weights, tensors=tensors), options.out)


if __name__ == "__main__":
    main()
