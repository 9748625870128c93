"""Makes ``reference/densemapnet.npz``: what the authors' own DenseMapNet gives for drawn weights.

It needs TensorFlow 2.15 and the file ``track2/densemapnet/densemapnet.py`` of the repository
pubgeo/dfc2019 (MIT), neither of which is part of this project:

    python tests/synthetic/keras_reference.py densemapnet.py
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

REFERENCE = Path(__file__).parent / "reference" / "densemapnet.npz"
SHAPE = (64, 96, 3)


def drawn_images() -> NDArray[np.float32]:
    """Left and right image [2, H, W, 3], scaled to -1/2 ... 1/2."""
    values = np.random.default_rng(5).integers(0, 256, (2, *SHAPE))
    return ((values - 127.5) / 255).astype(np.float32)


def drawn_weights(shapes: list[tuple[int, ...]]) -> list[NDArray[np.float32]]:
    """Arrays of these shapes, each from its number: kernels, and statistics that are positive."""
    arrays = []
    for number, shape in enumerate(shapes):
        rng = np.random.default_rng(number)
        if len(shape) == 1:
            arrays.append(rng.uniform(0.5, 1.5, shape).astype(np.float32))
        else:
            arrays.append(
                (rng.normal(size=shape) / np.sqrt(np.prod(shape[:-1]))).astype(np.float32)
            )
    return arrays


def _authors_network(file: str) -> object:
    import keras

    pooling = ModuleType("keras.layers.pooling")  # where Keras had it once
    pooling.MaxPooling2D = keras.layers.MaxPooling2D  # type: ignore[attr-defined]
    sys.modules["keras.layers.pooling"] = pooling
    spec = importlib.util.spec_from_file_location("densemapnet", file)
    code = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(code)
    settings = code.Settings()
    settings.ydim, settings.xdim, settings.channels = SHAPE
    settings.nopadding = True
    return code.DenseMapNet(settings).build_model()


def main() -> None:
    """Write the reference."""
    network = _authors_network(sys.argv[1])
    layers = [layer for layer in network.layers if layer.weights]
    shapes = [tuple(w.shape) for layer in layers for w in layer.weights]
    drawn = iter(drawn_weights(shapes))
    for layer in layers:
        layer.set_weights([next(drawn) for _ in layer.weights])
    left, right = drawn_images()
    found = network.predict([left[None], right[None]])[0, :, :, 0]
    counts = [len(layer.weights) for layer in layers]
    REFERENCE.parent.mkdir(exist_ok=True)
    sides = np.array([(*shape, 0, 0, 0)[:4] for shape in shapes])  # 0 after the last
    np.savez_compressed(REFERENCE, disparity=found.astype(np.float32), arrays=counts, shapes=sides)


if __name__ == "__main__":
    main()
