"""Stereo pairs with labels as a PyTorch dataset.

    from torch.utils.data import DataLoader
    from stereobench.networks.training_pairs import LabelledPairs
    from stereotruth.tiles.stereo_dataset import StereoDataset

    whu = StereoDataset("whu", Path("WHU-Stereo"), "whu", (-128, 64))
    loader = DataLoader(LabelledPairs.of(whu, "train", crop_px=(512, 512)), num_workers=4)
    for left, right, disparity in loader: ...

Files are read when they are asked for, by whichever worker is asked; nothing is copied or kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from stereotruth.core.config.methods import Augmentation
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_image
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset, match_inside

from ..methods.image_faults import FAULTS, faulty_pair
from .weights import SavedNetwork, scaled

TRIES = 10  # random windows looked at for one with enough labels
LABELLED_SHARE = 0.1  # that is enough


def augmented(
    images: NDArray[np.float32],
    disparity: NDArray[np.float32],
    by: Augmentation,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Changed copies of the images [2, C, h, w] and the disparity [h, w]."""
    if by.flip_rows and rng.random() < 0.5:
        images, disparity = images[..., ::-1, :], disparity[::-1]
    if by.contrast or by.brightness:
        factor = np.exp(rng.normal(0, by.contrast, (2, 1, 1, 1))).astype(np.float32)
        offset = rng.normal(0, by.brightness, (2, 1, 1, 1)).astype(np.float32)
        images = images * factor + offset
    if by.noise:
        sigma = np.float32(rng.uniform(0, by.noise))
        images = images + sigma * rng.standard_normal(images.shape, dtype=np.float32)
    return images, disparity


@dataclass
class LabelledPairs(Dataset):
    """Labelled pairs as (left [C, h, w], right [C, h, w], disparity [h, w]), float32.

    Images are scaled as ``model`` says, by the statistics of the whole image. Disparity is in px;
    NaN where there is no label, where it is out of the dataset's range, and where the window
    cuts off a match that the whole right image has. Where that ends before the match, as it may
    in any pair that is to be matched, the label stays.

    ``crop_px``: rows and columns of a random window of each pair, the same in both images; None:
    the whole pair. ``epoch``: windows and changes follow from ``seed``, ``epoch`` and the pair's
    number alone, whoever reads it.
    """

    dataset: StereoDataset
    pairs: Sequence[Pair]
    model: SavedNetwork
    crop_px: tuple[int, int] | None = None
    crops_per_pair: int = 1
    augmentation: Augmentation = field(default_factory=Augmentation)
    seed: int = 0
    epoch: int = 0

    @classmethod
    def of(
        cls, dataset: StereoDataset, split: str, model: SavedNetwork | None = None, **settings: Any
    ) -> LabelledPairs:
        """The labelled pairs of a split; raises InputError if there are none."""
        model = model or SavedNetwork("stereonet", dataset.disparity_range)
        return cls(dataset, dataset.pairs(split, labelled=True), model, **settings)

    def __len__(self) -> int:
        return len(self.pairs) * self.crops_per_pair

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor, Tensor]:
        pair = self.pairs[index % len(self.pairs)]
        pair.refuse_changed()
        left, right = read_image(pair.left), read_image(pair.right)
        disparity = self.dataset.labels(pair)
        if not left.shape[:2] == right.shape[:2] == disparity.shape:
            raise InputError(
                f"left {left.shape[:2]}, right {right.shape[:2]}, labels {disparity.shape}",
                file=pair.left,
                remedy="give both images and the labels one size",
            )
        low, high = self.dataset.disparity_range
        disparity[~((disparity >= low) & (disparity < high))] = np.nan
        rng = np.random.default_rng([self.seed, self.epoch, index])
        chances = self.augmentation.model_dump(include=set(FAULTS))
        if any(chances.values()):
            left, right = faulty_pair(left, right, chances, rng)
        images = np.stack([scaled(image, self.model, None) for image in (left, right)])
        if self.crop_px is not None:
            window = self._window(disparity, rng)
            seen = match_inside(disparity)[window]
            images, disparity = images[..., *window], disparity[window].copy()
            disparity[seen & ~match_inside(disparity)] = np.nan
        images, disparity = augmented(images, disparity, self.augmentation, rng)
        images = np.ascontiguousarray(images)
        return (
            torch.from_numpy(images[0]),
            torch.from_numpy(images[1]),
            torch.from_numpy(np.ascontiguousarray(disparity)),
        )

    def _window(
        self, disparity: NDArray[np.float32], rng: np.random.Generator
    ) -> tuple[slice, slice]:
        """A random window, the first of some in which enough pixels are labelled.

        It is drawn from all that overlap the pair and moved into it, so that the rims, where the
        right image ends, are seen about as often as the rest.
        """
        assert self.crop_px is not None
        height, width = self.crop_px
        if height > disparity.shape[0] or width > disparity.shape[1]:
            raise InputError(
                f"crops of {height} x {width} px of tiles of "
                f"{disparity.shape[0]} x {disparity.shape[1]} px",
                remedy="make training.crop_px smaller",
            )
        best, most = (slice(0, height), slice(0, width)), -1.0
        for _ in range(TRIES):
            r, c = (
                int(np.clip(rng.integers(1 - side, size), 0, size - side))
                for side, size in zip(self.crop_px, disparity.shape)
            )
            window = slice(r, r + height), slice(c, c + width)
            share = float(np.isfinite(disparity[window]).mean())
            if share > most:
                best, most = window, share
            if most >= LABELLED_SHARE:
                break
        return best
