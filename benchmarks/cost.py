"""Count the parameters and the multiply-adds of both networks of recipes.

    python benchmarks/cost.py [RECIPE ...]

By default, the recipes are `semantickitti` and `nuscenes`. The networks run once on a simulated
scan of their sensor, and torch counts the operations: GMAC are billions of multiply-adds. The
second number is what is computed here, because a convolution of an upsampled map is computed on the
coarse map (`apply_to_joined` of `models/layers.py`).
"""

from __future__ import annotations

import sys
from unittest.mock import patch

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from amvnet.config.recipes import load_recipe
from amvnet.data.datasets.open import open_dataset
from amvnet.data.datasets.simulated import simulate
from amvnet.data.taxonomy import CLASSES_BY_SENSOR
from amvnet.files import temporary_folder
from amvnet.models.amvnet import build_amvnet
from amvnet.models.layers import upsample
from amvnet.models.views.points import PointBatch
from amvnet.sensors.expectation import Expectation


def convolve_upsampled(block: nn.Module, coarse: Tensor, fine: Tensor) -> Tensor:
    """Apply a block to the upsampled map, as the definition says."""
    output: Tensor = block(torch.cat([upsample(coarse, fine), fine], dim=1))
    return output


def gmac(network: nn.Module, view: object) -> float:
    """Return the billions of multiply-adds of a forward pass."""
    # With gradients: the operations of oneDNN that torch calls without them are not counted.
    with FlopCounterMode(display=False) as counter:
        network(view)
    return counter.get_total_flops() / 2e9  # the counter counts a multiply-add as two operations


def add_rows(table: Table, name: str) -> None:
    """Add the figures of both networks of a recipe."""
    recipe = load_recipe(name)
    with temporary_folder() as folder:
        simulate(folder, sensor=recipe.sensor, sequences=1, scans=1, seed=78)
        dataset = open_dataset(str(folder))
        scan = dataset.read(dataset.records(dataset.sequences("all"))[0])

    model = build_amvnet(recipe.model, CLASSES_BY_SENSOR[recipe.sensor].size).eval()
    prepared = Expectation(view=recipe.model.range_view).prepare(scan)
    image, grid = model.project(PointBatch.of([prepared]))
    for title, net, view in (("RV", model.range_net, image.image), ("BEV", model.polar_net, grid)):
        millions = sum(parameter.numel() for parameter in net.parameters()) / 1e6
        computed = gmac(net, view)
        with (
            patch("amvnet.models.layers.apply_to_joined", convolve_upsampled),
            patch("amvnet.models.polar_net.apply_to_joined", convolve_upsampled),
        ):
            defined = gmac(net, view)
        table.add_row(name, title, f"{millions:.2f}", f"{defined:.0f}", f"{computed:.0f}")


def main() -> None:
    """Print the table."""
    table = Table("recipe", "network", "million parameters", "GMAC", "GMAC, computed")
    for name in sys.argv[1:] or ("semantickitti", "nuscenes"):
        add_rows(table, name)
    Console().print(table)


if __name__ == "__main__":
    main()
