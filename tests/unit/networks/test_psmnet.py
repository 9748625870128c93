"""PSMNet."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.networks import layers
from stereobench.networks.cost_volume_networks import PSMNet


def test_disparities_of_psmnet_are_those_of_costs_spread_to_full_size() -> None:
    network = PSMNet((-32, 32))
    cost = torch.randn(1, 16, 3, 5)
    spread = torch.nn.functional.interpolate(cost[:, None], scale_factor=4, mode="nearest")[:, 0]
    full = layers.soft_argmin(spread, -32.0)
    torch.testing.assert_close(network._disparity(cost), full)
