"""What real pairs have and simulated ones lack: haze, shadows that moved, blur.

The faults are planted in images as they come, before any method scales them: to see how methods
bear them, and in training (:mod:`.networks.training_pairs`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
WEAKEST, STRONGEST = 0.25, 1.5  # of the faults of training, in those of the functions as they stand


def smooth(shape: tuple[int, ...], wavelength: float, rng: np.random.Generator) -> Image:
    """A random field of about 0 to 1 whose features are ``wavelength`` px wide."""
    coarse = tuple(int(np.ceil(n / wavelength)) + 3 for n in shape)
    values = rng.uniform(size=coarse).astype(np.float32)
    size = tuple(int(n * wavelength) for n in reversed(coarse))
    whole = cv2.resize(values, size, interpolation=cv2.INTER_CUBIC)
    return whole[: shape[0], : shape[1]]


def _field(image: Image, wavelength: float, rng: np.random.Generator) -> Image:
    """A field that has the bands of an image [h, w] or [h, w, 3]."""
    field = smooth(image.shape[:2], wavelength, rng)
    return field if image.ndim == 2 else field[..., None]


def blur(image: Image, rng: np.random.Generator, strength: float = 1.0) -> Image:
    """Out of focus by 1.5 px."""
    del rng
    return cv2.GaussianBlur(image, (0, 0), 1.5 * strength)


def shadows(image: Image, rng: np.random.Generator, strength: float = 1.0) -> Image:
    """An eighth of the image at 0.4 of its brightness, in patches of some 40 px."""
    field = _field(image, 40, rng)
    dark = max(1.0 - 0.6 * strength, 0.0)
    return np.where(field > np.quantile(field, 0.875), np.float32(dark) * image, image)


def haze(image: Image, rng: np.random.Generator, strength: float = 1.0) -> Image:
    """Half the contrast and more light, by places."""
    share = strength * _field(image, 256, rng).clip(0, 1)
    return image * np.maximum(1 - 0.5 * share, 0) + share * image.std()


Fault = Callable[[Image, np.random.Generator, float], Image]
FAULTS: dict[str, Fault] = {"blur": blur, "shadows": shadows, "haze": haze}  # in this order


def as_images(
    changed: Sequence[NDArray], originals: Sequence[NDArray]
) -> list[NDArray[np.unsignedinteger]]:
    """Changed images in the originals' whole numbers; nodata (0) stays, and nothing becomes it."""
    return [
        np.where(old == 0, 0, np.clip(np.rint(new), 1, np.iinfo(old.dtype).max)).astype(old.dtype)
        for new, old in zip(changed, originals)
    ]


def faulty_pair(
    left: NDArray, right: NDArray, chances: Mapping[str, float], rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """A pair with faults, each with its chance, in one of its images, of random strength.

    ``chances``: by name of FAULTS, 0 to 1. Images are whole numbers, nodata 0; they come back in
    their type. What is drawn follows from ``rng`` alone.
    """
    images = [image.astype(np.float32) for image in (left, right)]
    for name, fault in FAULTS.items():
        if rng.random() < chances.get(name, 0.0):
            side = int(rng.integers(2))
            images[side] = fault(images[side], rng, rng.uniform(WEAKEST, STRONGEST))
    left, right = as_images(images, (left, right))
    return left, right
