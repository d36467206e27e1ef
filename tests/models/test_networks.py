"""Both networks pass one suite, and their layers equal plain loops over their formulas."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from amvnet.config.recipes import load_recipe
from amvnet.config.schema import RangeNetConfig
from amvnet.models import layers, range_net
from amvnet.models.layers import AzimuthGRU, PointLinear, RingConv2d, convolve_joined, wrap_width
from amvnet.models.polar_net import DropBlock, PolarNet
from amvnet.models.range_net import RangeNet
from amvnet.weights.file import load

from fixtures.networks import CASES, Case


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest) -> Case:
    return CASES[request.param]


def test_a_network_keeps_the_shape_of_odd_sizes(case: Case) -> None:
    assert case.run(case.in_eval(), 1, 2).shape == (2, *case.shape)


@pytest.mark.parametrize("training", [False, True])
def test_the_gradient_reaches_every_parameter_of_a_network(case: Case, training: bool) -> None:
    net = case.in_eval().train(training)
    scores = case.run(net, 3, 4)
    (scores * torch.randn_like(scores)).sum().backward()

    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        # A bias before a norm has a gradient only if the norm's statistics are fixed.
        assert parameter.grad.any() or (training and name.endswith("bias")), name


def test_a_network_gives_the_same_with_gradients_and_without(case: Case) -> None:
    net = case.in_eval()
    expected = case.run(net, 3)
    with torch.inference_mode():
        torch.testing.assert_close(case.run(net, 3), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rows", [0, 1, 500])
@pytest.mark.parametrize("sizes", [(1, 1), (9, 32), (42, 64)])
def test_a_point_linear_layer_is_a_linear_layer(rows: int, sizes: tuple[int, int]) -> None:
    layer = PointLinear(*sizes)
    x = torch.randn(rows, sizes[0], requires_grad=True)
    output = layer(x)
    expected = F.linear(x, layer.weight, layer.bias)
    torch.testing.assert_close(output, expected)
    with torch.inference_mode():
        torch.testing.assert_close(layer(x), expected)

    gradient = torch.autograd.grad(output.square().sum(), x)[0]
    expected_gradient = torch.autograd.grad(expected.square().sum(), x)[0]
    torch.testing.assert_close(gradient, expected_gradient)


def test_a_drive_of_scans_needs_code_for_few_numbers_of_points() -> None:
    """Each number of rows has code of its own in oneDNN, which the process keeps."""
    counts = set()

    class Counting(TorchDispatchMode):
        def __torch_dispatch__(
            self, func: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            if "linear" in str(func):
                counts.add(len(args[0]))
            return func(*args, **(kwargs or {}))

    layer = PointLinear(4, 3)
    with torch.inference_mode(), Counting():
        sizes = [len(layer(torch.zeros(rows, 4))) for rows in range(0, 10_000, 100)]
    assert sizes == list(range(0, 10_000, 100))
    assert 0 < len(counts) < 10


def test_the_rows_of_a_point_linear_layer_are_not_copied_if_they_have_code_of_their_own() -> None:
    places = []

    class Watching(TorchDispatchMode):
        def __torch_dispatch__(
            self, func: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            if "linear" in str(func):
                places.append(args[0].data_ptr())
            return func(*args, **(kwargs or {}))

    x = torch.zeros(layers.ROWS, 4)
    with torch.inference_mode(), Watching():
        PointLinear(4, 3)(x)
    assert places == [x.data_ptr()]


def test_a_batch_of_two_equals_each_alone_in_eval(case: Case) -> None:
    net = case.in_eval()
    together = case.run(net, 3, 4)
    alone = torch.cat([case.run(net, 3), case.run(net, 4)])

    torch.testing.assert_close(together, alone, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(together[0], together[1])


@pytest.mark.parametrize("columns", [8, -16])
@pytest.mark.parametrize("name", ["range", "range with steps"])
def test_range_net_without_gru_is_equivariant_to_its_stride(name: str, columns: int) -> None:
    net = CASES[name].in_eval()
    image = torch.randn(1, 6, 7, 40)
    shifted = net(image).roll(columns, 3)

    torch.testing.assert_close(net(image.roll(columns, 3)), shifted, rtol=1e-4, atol=1e-5)
    assert not torch.allclose(net(image), shifted)


def test_surface_steps_equal_a_loop_over_pixels_and_neighbours() -> None:
    height, width = 4, 5
    image = torch.randn(2, 6, height, width) * 10
    image[:, 5] = (torch.rand(2, height, width) < 0.7).float()
    image *= image[:, 5:]  # a pixel without a point is 0

    expected = torch.zeros(2, 8, height, width)
    for scan, row, column in product(range(2), range(height), range(width)):
        x, y, z, _, _, mask = image[scan, :, row, column].tolist()
        for index, (down, right) in enumerate([(0, -1), (0, 1), (-1, 0), (1, 0)]):
            if not 0 <= row + down < height:
                continue
            other = image[scan, :, row + down, (column + right) % width].tolist()
            if mask and other[5]:
                farther = math.hypot(other[0], other[1]) - math.hypot(x, y)
                steps = [math.asinh(farther / 0.1), math.asinh((other[2] - z) / 0.1)]
                expected[scan, 2 * index : 2 * index + 2, row, column] = torch.tensor(steps)

    assert expected.any(dim=(0, 2, 3)).all()
    torch.testing.assert_close(range_net.surface_steps(image), expected, rtol=1e-4, atol=1e-4)


def test_the_unet_of_polar_net_is_equivariant_to_a_shift_by_its_stride() -> None:
    net = CASES["polar"].in_eval()
    assert isinstance(net, PolarNet)
    pillars = torch.randn(1, 5, 9, 20)
    shifted = net.unet(pillars).roll(4, 3)
    torch.testing.assert_close(net.unet(pillars.roll(4, 3)), shifted, rtol=1e-4, atol=1e-5)


def joined_maps(coarse: Tensor, fine: Tensor) -> Tensor:
    """Return the input that `convolve_joined` avoids: both maps, the coarse one upsampled."""
    return torch.cat([layers.upsample(coarse, fine), fine], dim=1)


@pytest.mark.parametrize(
    "sizes", [(3, 4, 3, 4), (3, 4, 6, 8), (5, 3, 5, 12), (1, 1, 2, 4), (2, 5, 6, 5), (3, 4, 5, 8)]
)
@pytest.mark.parametrize("bias", [False, True])
def test_a_joined_convolution_equals_one_over_the_upsampled_map(
    sizes: tuple[int, int, int, int], bias: bool
) -> None:
    h, w, full_h, full_w = sizes
    convolution = RingConv2d(5, 4)
    convolution.bias = nn.Parameter(torch.randn(4)) if bias else None
    coarse = torch.randn(2, 3, h, w, requires_grad=True)
    fine = torch.randn(2, 2, full_h, full_w, requires_grad=True)

    def gradients(output: Tensor) -> list[Tensor]:
        wanted = [coarse, fine, *convolution.parameters()]
        return list(torch.autograd.grad((output * factors).sum(), wanted))

    expected = convolution(joined_maps(coarse, fine))
    factors = torch.randn_like(expected)
    with torch.inference_mode():
        without_gradients = convolve_joined(convolution, coarse, fine)
    output = convolve_joined(convolution, coarse, fine)

    torch.testing.assert_close(without_gradients, expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(output, expected, rtol=1e-4, atol=1e-5)
    for gradient, other in zip(gradients(output), gradients(expected), strict=True):
        torch.testing.assert_close(gradient, other, rtol=1e-4, atol=1e-4)


def test_a_joined_convolution_costs_less() -> None:
    convolution = RingConv2d(96, 32)
    coarse = torch.randn(1, 64, 40, 60)
    fine = torch.randn(1, 32, 80, 120)

    with FlopCounterMode(display=False) as counter:
        convolution(joined_maps(coarse, fine))
    with FlopCounterMode(display=False) as joined_counter:
        convolve_joined(convolution, coarse, fine)

    # (4 / 9 * 64 + 32) / 96, and the edges
    assert joined_counter.get_total_flops() < 0.65 * counter.get_total_flops()


def test_the_unet_of_polar_net_halves_odd_sizes_upwards() -> None:
    net = CASES["polar"].in_eval()
    assert isinstance(net, PolarNet)
    sizes = []
    for down in net.down:
        down.register_forward_hook(lambda _, __, output: sizes.append(tuple(output.shape[2:])))

    net.unet(torch.randn(1, 5, 9, 11))
    assert sizes == [(5, 6), (3, 3)]


@pytest.mark.full
def test_the_paper_size_range_net_costs_500_gmac_and_decodes_the_strides_4_to_128(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    width = 512  # an eighth of the image: every map, and the GRUs' padding, are an eighth too
    net = RangeNet(RangeNetConfig(), 19).eval()
    strides: list[int] = []
    for lateral in net.lateral:
        lateral.register_forward_hook(
            lambda _, inputs, __: strides.append(width // inputs[0].shape[-1])
        )

    # The paper's network upsamples.
    def convolve_upsampled(block: nn.Module, coarse: Tensor, fine: Tensor) -> Tensor:
        return block(joined_maps(coarse, fine))

    monkeypatch.setattr(layers, "apply_to_joined", convolve_upsampled)
    with FlopCounterMode(display=False) as counter:
        assert net(torch.zeros(1, 6, 64, width)).shape == (1, 19, 64, width)
    assert sorted(strides) == [4, 8, 16, 32, 64, 128]

    # The counter counts a multiply-add as two operations, the paper as one.
    gmac = counter.get_total_flops() / 2 * (4096 / width) / 1e9
    assert gmac == pytest.approx(500, rel=0.1)


@pytest.mark.parametrize("recipe", ["semantickitti", "nuscenes"])
def test_the_paper_size_polar_net_is_that_of_its_authors(recipe: str) -> None:
    model = load_recipe(recipe).model
    with torch.device("meta"):  # without memory
        net = PolarNet(model.polar_net, model.polar_view.vertical, 19)

    widths = [
        [layer.out_channels for layer in block.modules() if isinstance(layer, RingConv2d)]
        for block in (net.first, *net.down, *net.up)
    ]
    assert widths == [[width] * 2 for width in (64, 128, 256, 512, 512, 256, 128, 64, 64)]
    assert isinstance(net.norm, nn.BatchNorm2d)
    parameters = sum(parameter.numel() for parameter in net.parameters())
    assert parameters == pytest.approx(13.6e6, rel=0.01)

    # The authors' code makes each cell the centre of a dropped square of 7 x 7 with 0.5 / 7 ** 2.
    assert net.drop.size == 7
    assert net.drop.probability == pytest.approx(1 - (1 - 0.5 / 49) ** 49, abs=1e-3)


@pytest.mark.parametrize(
    ("recipe", "weights"),
    [("simulated-compact", "sim-hdl64e"), ("simulated-hdl32e-compact", "sim-hdl32e")],
)
def test_the_networks_of_the_shipped_weights_fit_the_recipe(recipe: str, weights: str) -> None:
    expected = load_recipe(recipe).model
    model = load(weights).model
    for part in ("range_view", "polar_view", "range_net", "polar_net", "point_head"):
        assert getattr(model, part) == getattr(expected, part)
    assert model.assertion == expected.assertion


@pytest.mark.parametrize(
    ("width", "left", "right"), [(5, 1, 1), (4, 0, 2), (4, 3, 0), (3, 3, 3), (1, 1, 1)]
)
def test_wrap_width_is_circular_and_has_its_gradient(width: int, left: int, right: int) -> None:
    x = torch.randn(2, 2, 3, width, dtype=torch.double, requires_grad=True)
    expected = x[..., torch.arange(-left, width + right) % width]

    assert torch.equal(wrap_width(x, left, right), expected)
    assert torch.equal(wrap_width(x.detach(), left, right), expected)
    assert torch.autograd.gradcheck(lambda x: wrap_width(x, left, right), x)


@pytest.mark.parametrize("width", [1, 2, 7, 8])
@pytest.mark.parametrize("kernel", [1, 3])
def test_a_ring_convolution_is_equivariant_to_a_shift(kernel: int, width: int) -> None:
    convolution = RingConv2d(2, 3, kernel).double()
    x = torch.randn(1, 2, 4, width).double()
    torch.testing.assert_close(convolution(x.roll(1, 3)), convolution(x).roll(1, 3))
    assert convolution(x).shape == (1, 3, 4, width)


def gru_by_cells(layer: AzimuthGRU, x: Tensor, padding: int) -> Tensor:
    """Run a GRU cell by cell: the padding's columns first, each column from top to bottom."""
    _, channels, height, width = x.shape
    cell = nn.GRUCell(channels, channels)
    for name, parameter in cell.named_parameters():
        parameter.data = layer.gru.state_dict()[f"{name}_l0"]

    hidden = torch.zeros(len(x), channels)
    output = torch.zeros_like(x)
    for column in range(-padding, width):
        for row in range(height):
            hidden = cell(x[:, :, row, column % width], hidden)
            output[:, :, row, max(column, 0)] = hidden
    return output


@pytest.mark.parametrize(("share", "padding"), [(0.0, 0), (0.4, 2), (1.0, 5)])
def test_the_gru_equals_a_loop_over_the_cells(share: float, padding: int) -> None:
    layer = AzimuthGRU(3, share)
    x = torch.randn(2, 3, 4, 5)
    assert layer(x).shape == x.shape
    torch.testing.assert_close(layer(x), gru_by_cells(layer, x, padding))


@pytest.mark.parametrize(
    ("height", "width", "factor"), [(5, 7, 2), (6, 8, 2), (1, 1, 2), (4, 12, 4)]
)
def test_upsample_gives_values_to_the_cells_they_mean(height: int, width: int, factor: int) -> None:
    coarse = torch.randn(1, 2, math.ceil(height / factor), math.ceil(width / factor))
    fine = layers.upsample(coarse, torch.zeros(1, 9, height, width))
    assert fine.shape == (1, 2, height, width)

    for row in range(height):
        for column in range(width):
            expected = coarse[:, :, row // factor, column // factor]
            assert torch.equal(fine[:, :, row, column], expected)


def count_norms(net: nn.Module) -> int:
    return sum(isinstance(m, nn.BatchNorm1d | nn.BatchNorm2d) for m in net.modules())


def test_folded_batch_norms_change_no_output_of_a_network(case: Case) -> None:
    net = case.in_eval()
    before = case.run(net, 3)
    assert count_norms(net) > 1

    layers.freeze(net)
    torch.testing.assert_close(case.run(net, 3), before, rtol=1e-4, atol=1e-4)
    # The norms of the inputs of the MLP and of the U-Net stay: no layer is before them.
    assert count_norms(net) == 1 + isinstance(getattr(net, "norm", None), nn.BatchNorm2d)


def test_dropblock_is_identity_in_eval_and_at_probability_zero() -> None:
    x = torch.randn(2, 3, 9, 9)
    assert torch.equal(DropBlock(0.5, 3).eval()(x), x)
    assert torch.equal(DropBlock(0.0, 3).train()(x), x)
    assert DropBlock(0.5, 17).train()(x).shape == x.shape  # smaller than its squares


@pytest.mark.parametrize("probability", [0.1, 0.5])
@pytest.mark.parametrize("size", [1, 4, 7])
def test_dropblock_drops_its_share_and_keeps_the_mean(probability: float, size: int) -> None:
    torch.manual_seed(0)
    dropped = DropBlock(probability, size).train()(torch.ones(16, 2, 80, 80))

    assert (dropped == 0).float().mean().item() == pytest.approx(probability, rel=0.15)
    assert dropped.mean().item() == pytest.approx(1, abs=1e-4)
    assert dropped.unique().numel() == 2
    assert torch.equal(dropped[:, 0], dropped[:, 1])


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32])
def test_dropblock_keeps_the_mean_of_a_large_map_in_any_precision(kind: torch.dtype) -> None:
    torch.manual_seed(0)
    dropped = DropBlock(0.3, 7).train()(torch.ones(1, 2, 480, 360, dtype=kind))
    assert dropped.float().mean() == pytest.approx(1, abs=0.02)


def test_dropblock_drops_squares() -> None:
    torch.manual_seed(0)
    dropped = (DropBlock(0.02, 5).train()(torch.ones(1, 1, 60, 60)) == 0)[0, 0]
    assert dropped.any()

    # The cells that lie in some square of nothing but dropped cells
    covered = torch.zeros_like(dropped)
    for row, column in dropped[2:-2, 2:-2].nonzero().tolist():
        if dropped[row : row + 5, column : column + 5].all():
            covered[row : row + 5, column : column + 5] = True
    assert torch.equal(covered[5:-5, 5:-5], dropped[5:-5, 5:-5])


def test_under_autocast_the_recurrence_and_sums_of_weights_stay_in_float32() -> None:
    gru = AzimuthGRU(8, 0.5).eval()
    convolution = RingConv2d(6, 4)
    weight = convolution.weight[:, :4]
    x = torch.randn(1, 8, 2, 16)
    with torch.inference_mode():
        expected = gru(x)
        kernels = layers._kernels(convolution, weight, (1, 2))
        with torch.autocast("cpu", torch.bfloat16):
            assert gru(x).dtype == torch.float32
            assert torch.equal(gru(x), expected)
            assert layers._kernels(convolution, weight, (1, 2)).dtype == torch.float32
            assert torch.equal(layers._kernels(convolution, weight, (1, 2)), kernels)
