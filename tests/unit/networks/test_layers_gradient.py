"""Convolutions whose kernel's gradient is taken as products of matrices, against PyTorch's own."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
import torch.nn.functional as F

from stereobench.networks import layers
from stereobench.networks.layers import convolve


@pytest.mark.parametrize("dilation", [1, 2, 8])  # 8: some taps see nothing but padding
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


def test_where_nothing_is_learned_or_channels_are_few_it_is_pytorchs_own(monkeypatch) -> None:
    monkeypatch.setattr(layers, "_Convolution", None)
    x, kernel = torch.randn(1, 32, 5, 5), torch.randn(32, 32, 3, 3)
    assert torch.equal(convolve(x, kernel, None, 1), F.conv2d(x, kernel, None, 1, 1))
    with torch.no_grad():
        convolve(x, kernel.requires_grad_(), None, 1)
    convolve(x[:, :2], kernel[:, :2].detach().requires_grad_(), None, 1)
