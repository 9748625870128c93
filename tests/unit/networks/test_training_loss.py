"""The loss."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.networks.training import loss_of


def test_the_loss_counts_labelled_pixels_only() -> None:
    disparity = torch.full((1, 4, 4), float("nan"))
    disparity[0, 0, 0], disparity[0, 0, 1] = 4.0, 10.0
    output = torch.zeros(1, 4, 4)
    # smooth L1: |e| - 1/2 beyond one pixel
    assert loss_of([output], disparity, [1.0]).item() == pytest.approx((3.5 + 9.5) / 2)
    assert loss_of([output] * 2, disparity, [1.0, 0.5]).item() == pytest.approx(1.5 * 6.5)
    # at half the size: one pixel is labelled, by the mean of its two labels, in its own pixels
    assert loss_of([torch.zeros(1, 2, 2)], disparity, [1.0]).item() == pytest.approx(3.5 - 0.5)
    assert loss_of([output], torch.full((1, 4, 4), float("nan")), [1.0]).item() == 0
