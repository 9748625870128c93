"""Cost volumes, soft-argmin and the convolutions' padding, against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
import torch.nn.functional as F

from stereobench.networks import layers
from stereobench.networks.layers import convolve


@pytest.mark.parametrize("low, high", [(-3, 4), (-12, -2)])
def test_volumes_hold_what_their_definition_says(low: int, high: int) -> None:
    rng = np.random.default_rng(1)
    left, right = (torch.from_numpy(rng.standard_normal((2, 3, 4, 9))) for _ in range(2))
    difference = layers.difference_volume(left, right, low, high)
    both = layers.concatenation_volume(left, right, low, high)
    assert difference.shape == (2, 3, high - low, 4, 9)
    for k, d in enumerate(range(low, high)):
        for x in range(9):
            inside = 0 <= x - d < 9
            match = right[..., x - d] if inside else torch.zeros(2, 3, 4)
            own = left[..., x] if inside else torch.zeros(2, 3, 4)
            assert torch.equal(difference[:, :, k, :, x], own - match)
            assert torch.equal(both[:, :, k, :, x], torch.cat([own, match], 1))


@pytest.mark.parametrize("volume", [layers.difference_volume, layers.concatenation_volume])
def test_gradients_of_volumes_are_those_of_finite_differences(volume) -> None:
    torch.manual_seed(2)
    left, right = (torch.randn(1, 2, 2, 5, dtype=torch.double, requires_grad=True) for _ in "lr")
    # gradients are added up in single precision
    assert torch.autograd.gradcheck(
        lambda a, b: volume(a, b, -6, 7), (left, right), eps=1e-3, atol=1e-5
    )


def test_soft_argmin_is_the_expectation() -> None:
    cost = torch.tensor([0.0, np.log(3.0)]).view(1, 2, 1, 1)  # probabilities 3/4 and 1/4
    assert layers.SoftArgmin()(cost, -2.0, 4.0).item() == pytest.approx(-2 + 4 * 0.25)
    sharp = torch.full((1, 5, 1, 1), 100.0)
    sharp[0, 3] = 0
    assert layers.SoftArgmin()(sharp, -1.0).item() == pytest.approx(2)


def test_strided_convolutions_pad_at_the_end() -> None:
    """Keras: output pixel 0 of a 3 x 3 kernel is centred on input pixel 1, not 0, of 2 steps."""
    convolution = layers.Conv2d(1, 1, 3, stride=2)
    with torch.no_grad():
        convolution.weight.zero_()
        convolution.weight[0, 0, 1, 1] = 1
    x = torch.arange(36.0).view(1, 1, 6, 6)
    assert torch.equal(convolution(x), x[..., 1::2, 1::2])


@pytest.mark.parametrize("planes", [4, 12])  # small, and not
@pytest.mark.parametrize("stride", [1, 2])
def test_small_volumes_are_convolved_like_large_ones(planes: int, stride: int) -> None:
    torch.manual_seed(4)
    convolution = layers.Conv3d(32, 16, stride=stride)
    x = torch.randn(1, 32, planes, 64, 4, requires_grad=True)
    assert layers._is_slow(x) == (planes == 4)
    both = convolution(torch.cat([x, x]))
    weights = torch.randn_like(both[:1])
    inputs = (x, convolution.weight)
    torch.testing.assert_close(convolution(x), both[:1])
    for a, b in zip(
        torch.autograd.grad(convolution(x), inputs, weights),
        torch.autograd.grad(both[:1], inputs, weights),
    ):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=1e-4)


@pytest.mark.parametrize("dilation", [1, 8])  # 8: some taps see nothing but padding
@pytest.mark.parametrize("last", [False, True])
def test_values_and_gradients_are_those_of_pytorch(dilation: int, last: bool) -> None:
    torch.manual_seed(3)
    memory = torch.channels_last if last else torch.contiguous_format
    x = torch.randn(2, 16, 7, 12, dtype=torch.double).contiguous(memory_format=memory)
    kernel = torch.randn(17, 16, 3, 3, dtype=torch.double)
    bias = torch.randn(17, dtype=torch.double)
    inputs = [t.requires_grad_() for t in (x, kernel, bias)]
    y = convolve(*inputs, dilation)
    expected = F.conv2d(*inputs, 1, dilation, dilation)
    assert y.grad_fn.name() != expected.grad_fn.name()  # or nothing is tested here
    torch.testing.assert_close(y, expected)
    weights = torch.randn_like(expected)
    found, sought = (torch.autograd.grad(z, inputs, weights) for z in (y, expected))
    for a, b in zip(found, sought):
        torch.testing.assert_close(a, b)
