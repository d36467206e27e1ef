"""Make the networks of some weights name rare classes less often.

    python benchmarks/shift_priors.py WEIGHTS COUNTS OUT [--share 0.1]

The class weights of the loss are the inverse frequencies to the power of 1/2, so the trained
networks name rare classes more often than they occur. This adds the share of the logarithm of the
frequencies to the networks' last biases, as if the power had been 1/2 - share. COUNTS is the file
`class_counts.npz` of the run. Train the head afterwards, as its inputs change.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from amvnet.training.losses import class_weights
from amvnet.weights.file import load, save

BIASES = ("range_net.scores.bias", "polar_net.scores.bias")


def main() -> None:
    """Write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights")
    parser.add_argument("counts", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--share", type=float, default=0.1)
    options = parser.parse_args()

    with np.load(options.counts) as counted:
        # The weights are frequencies to the power of -1/2.
        log_frequency = -2 * np.log(class_weights(counted["counts"]))
    shift = torch.tensor(options.share * (log_frequency - log_frequency.mean()))

    weights = load(options.weights)
    tensors = dict(weights.tensors)
    for name in BIASES:
        bias = tensors[name]
        tensors[name] = (bias.unflatten(0, (-1, len(shift))) + shift).flatten().to(bias.dtype)
    save(replace(weights, tensors=tensors), options.out)


if __name__ == "__main__":
    main()
