"""Calibrate trained networks: name rare classes less often, and let the ensemble trust BEV more.

    python -m amvnet.weights.calibrate WEIGHTS COUNTS OUT [--prior 0.1] [--bev 0.65]

COUNTS is the file `class_counts.npz` of the run. Calibrate weights once, and train the head
afterwards, because its inputs change.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import torch

from amvnet.errors import InputError
from amvnet.outputs import Signature, check_outputs
from amvnet.weights.file import Weights, load, save

WEIGHTS = Signature("a weights file", rb".{8}\{")
LEAST_FREQUENCY = 1e-4  # the least frequency of a class, as in the training's class weights


def calibrate(
    weights: Weights, counts: np.ndarray, prior: float = 0.1, bev: float = 0.65
) -> Weights:
    """Return weights with calibrated last layers of both networks.

    The class weights of the training are the inverse frequencies to the power of 1/2. The trained
    networks therefore name rare classes more often than these occur. The calibration adds a share
    of the logarithm of the frequencies to the biases, as if the power had been 1/2 - `prior`.

    The range-view network (RV) is too sure of itself, the bird's-eye-view network (BEV) is not sure
    enough. The scores before the softmax are multiplied, so that the geometric mean of the new
    probabilities is RV^(1 - bev) BEV^bev of the old ones. This factor does not change the labels
    of a single network.

    Args:
        weights: trained weights with both networks.
        counts: (K,) the number of points of each class in the training scans.
        prior: the share of the logarithm of the class frequencies.
        bev: the weight of BEV in the ensemble, above 0 and below 1.

    Raises:
        InputError: if a network is missing, the counts are of other classes, or `bev` is out of
            range.
    """
    if not 0 < bev < 1:
        raise InputError(f"--bev: expected a number above 0 and below 1, found {bev:g}")
    if counts.shape != (weights.taxonomy.size,):
        raise InputError(
            f"expected counts of {weights.taxonomy.size} classes, found {counts.shape}; give "
            "class_counts.npz of the run that trained the weights"
        )

    log_frequency = np.log(np.maximum(counts / max(counts.sum(), 1), LEAST_FREQUENCY))
    shift = torch.tensor(prior * (log_frequency - log_frequency.mean()), dtype=torch.float32)

    tensors = dict(weights.tensors)
    for network, factor in (("range_net", 2 * (1 - bev)), ("polar_net", 2 * bev)):
        if network not in weights.parts:
            raise InputError(f"expected weights with both networks, found no {network}; train it")
        # The kernels of the built-in weights are float16, which would round the product.
        kernel = tensors[f"{network}.scores.weight"].float()
        bias = tensors[f"{network}.scores.bias"]
        # BEV has a score for each class and voxel.
        shifted = (bias.unflatten(0, (-1, len(shift))) + shift).flatten()
        tensors[f"{network}.scores.weight"] = factor * kernel
        tensors[f"{network}.scores.bias"] = (factor * shifted).to(bias.dtype)
    return replace(weights, tensors=tensors)


def read_counts(path: Path) -> np.ndarray:
    """Read the (K,) class counts of a run; raise InputError if the file holds none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            counts: np.ndarray = file["counts"]
    except (OSError, ValueError, KeyError, BadZipFile):
        raise InputError(
            f"{path}: expected class_counts.npz of a run, found none; check the path"
        ) from None
    return counts


def main() -> None:
    """Calibrate a weights file."""
    parser = argparse.ArgumentParser(
        prog="python -m amvnet.weights.calibrate", description=calibrate.__doc__
    )
    parser.add_argument("weights")
    parser.add_argument("counts", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--prior", type=float, default=0.1)
    parser.add_argument("--bev", type=float, default=0.65)
    options = parser.parse_args()

    # A training that is continued calibrates again, but never its own input.
    check_outputs({options.out: WEIGHTS}, [options.weights, options.counts], overwrite=True)
    counts = read_counts(options.counts)
    save(calibrate(load(options.weights), counts, options.prior, options.bev), options.out)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"amvnet: {error}")
