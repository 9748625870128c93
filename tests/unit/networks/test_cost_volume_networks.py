"""StereoNet, PSM-Net and HMSM-Net against the authors' own code and their definitions."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.methods.kinds import NETWORKS
from stereobench.networks import inference, layers, weights
from stereobench.networks.cost_volume_networks import PSMNet
from stereobench.networks.weights import SavedNetwork

from ...synthetic.real_data import PUBLISHED

with_published = pytest.mark.skipif(
    not PUBLISHED.is_dir(), reason=f"no published weights at {PUBLISHED}"
)


@pytest.mark.parametrize("kind", sorted(NETWORKS))
def test_outputs_have_the_sizes_that_the_loss_expects(kind: str) -> None:
    network = SavedNetwork(kind, (-64, 64)).build()
    side = 256
    pair = torch.randn(2, 1, 1, side, 2 * side)
    with torch.no_grad():
        outputs = network.train()(*pair)
        final = network.eval()(*pair)
    sizes = {"hmsmnet": (16, 8, 4, 1)}.get(kind, (1,) * len(network.loss_weights))
    assert [o.shape for o in outputs] == [(1, side // s, 2 * side // s) for s in sizes]
    assert len(outputs) == len(network.loss_weights)
    assert [o.shape for o in final] == [(1, side, 2 * side)]


def test_disparities_of_psmnet_are_those_of_costs_spread_to_full_size() -> None:
    network = PSMNet((-32, 32))
    cost = torch.randn(1, 16, 3, 5)
    spread = torch.nn.functional.interpolate(cost[:, None], scale_factor=4, mode="nearest")[:, 0]
    full = layers.SoftArgmin()(spread, -32.0)
    torch.testing.assert_close(network._disparity(cost), full)


@with_published
@pytest.mark.parametrize("name, channels, span", [("WHU", 1, (-128, 64)), ("US3D", 3, (-96, 96))])
def test_published_stereonet_gives_the_reference_outputs(
    name: str, channels: int, span: tuple[int, int]
) -> None:
    """All four outputs of the authors' code under TensorFlow, within 1e-3 px."""
    network = SavedNetwork("stereonet", span, channels).build()
    weights.load_keras(network, PUBLISHED / f"weights/StereoNet_{name}.h5")
    reference = np.load(PUBLISHED / f"reference/stereonet_{name}_synth256.npz")
    images = [
        torch.from_numpy(reference[k].transpose(2, 0, 1)[None].copy()) for k in ("left", "right")
    ]
    network.eval()
    network.training = True  # all outputs, the layers below as they are in use
    with torch.no_grad():
        found = network(*images)
    for k, disparity in enumerate(found):
        assert np.abs(disparity[0].numpy() - reference[f"d{k}"]).max() < 1e-3


@with_published
def test_published_stereonet_matches_a_real_tile_from_its_raw_pixels() -> None:
    settings = {"weights": PUBLISHED / "weights/StereoNet_WHU.h5", "device": "cpu"}
    reference = np.load(PUBLISHED / "reference/real_WHU_KM_253_crop512.npz")
    found = inference.make("mine", "stereonet", settings, 0)(
        reference["raw_left"], reference["raw_right"], (-128, 64)
    )
    assert np.abs(found - reference["d3"]).max() < 1e-3
