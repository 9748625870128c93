"""DenseMapNet against the authors' own code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
h5py = pytest.importorskip("h5py", reason="h5py is not installed: make test-networks")
from stereobench.networks import weights
from stereobench.networks.weights import scaled

from ...synthetic.keras_reference import REFERENCE, SHAPE, drawn_images, drawn_weights
from ...synthetic.small_networks import method


def written_as_keras(path: Path) -> None:
    """The weights that the reference was made with, as a file of Keras."""
    with np.load(REFERENCE) as reference:
        counts, sides = reference["arrays"], reference["shapes"]
    drawn = iter(drawn_weights([tuple(side for side in of if side) for of in sides.tolist()]))
    with h5py.File(path, "w") as file:
        file.attrs["layer_names"] = [f"layer_{k}".encode() for k in range(counts.size)]
        for layer, count in enumerate(counts):
            group = file.create_group(f"layer_{layer}")
            group.attrs["weight_names"] = [f"w_{k}".encode() for k in range(count)]
            for k in range(count):
                group[f"w_{k}"] = next(drawn)


def test_results_are_those_of_the_authors_code(tmp_path: Path) -> None:
    """Keras' weights, by their order, give the authors' result under TensorFlow within 1e-4 px."""
    written_as_keras(tmp_path / "drawn.h5")
    model, network = weights.read_keras(tmp_path / "drawn.h5", "densemapnet")
    assert (model.channels, model.scaling) == (3, "dfc2019")
    left, right = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in drawn_images())
    with torch.no_grad():
        (found,) = network.eval()(left, right)
    with np.load(REFERENCE) as reference:
        known = reference["disparity"]
    assert known.shape == SHAPE[:2] and np.ptp(known) > 1
    assert np.abs(found[0].numpy() - known).max() < 1e-4


def test_images_are_scaled_as_in_the_contest() -> None:
    """Grey values less 127.5, over 255; red first."""
    image = np.random.default_rng(0).integers(1, 256, (8, 8, 3)).astype(np.uint8)
    found = scaled(image, method("densemapnet", channels=3, scaling="dfc2019").model, None)
    assert np.allclose(found, (image.transpose(2, 0, 1) - 127.5) / 255, atol=1e-6)


def test_pixels_beyond_the_margin_change_nothing() -> None:
    network = method("densemapnet").network
    side, margin = 8, network.margin_px
    pair = torch.rand(2, 1, 1, 2 * margin + side, 2 * margin + side)
    inner = slice(margin, margin + side)
    other = torch.rand_like(pair)
    other[..., 8:-8, 8:-8] = pair[..., 8:-8, 8:-8]
    with torch.no_grad():
        found, again = (network(*images)[-1][0, inner, inner] for images in (pair, other))
    assert torch.equal(found, again)
