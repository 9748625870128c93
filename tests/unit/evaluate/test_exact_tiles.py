"""Tiles with exact labels, put together as a dataset."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_image
from stereotruth.evaluate.exact_tiles import gather, make_city
from stereotruth.tiles.stereo_dataset import StereoDataset, match_inside

SIZE = 192


@pytest.mark.slow
def test_labels_of_a_training_city_bring_the_right_image_to_the_left(tmp_path):
    make_city(5, tmp_path / "5", size=SIZE, seed=3)
    gather([tmp_path / "5"], [tmp_path / "5"], tmp_path / "three", 3)
    dataset = StereoDataset("three", tmp_path / "three", "whu", (-64, 128))
    assert len(dataset.pairs("val")) == 4
    pairs = dataset.pairs("train", labelled=True)
    names = [pair.left.name for pair in pairs]
    assert names == [f"Training5_left_{k}.tiff" for k in (1, 2, 3)]
    for pair in pairs:
        left, right = (read_image(file).astype(float) for file in (pair.left, pair.right))
        labels = dataset.labels(pair)
        known = np.isfinite(labels)
        assert left.shape == right.shape == labels.shape == (SIZE, SIZE)
        assert known.mean() > 0.6
        assert abs(np.nanmean(labels)) < 0.51  # the right image is moved by the mean
        known &= match_inside(labels)
        row, col = np.nonzero(known)
        at = col - labels[known]
        j = np.clip(np.floor(at).astype(int), 0, SIZE - 2)
        warped = right[row, j] * (1 - (at - j)) + right[row, j + 1] * (at - j)
        of = [np.corrcoef(left[known], warped)[0, 1]]
        # labels that are 2 px off correlate less
        wrong = np.clip(j + 2, 0, SIZE - 1)
        of.append(np.corrcoef(left[known], right[row, wrong])[0, 1])
        assert of[0] > 0.9 and of[0] > of[1] + 0.05
    with pytest.raises(InputError, match="4 tiles instead of 5"):
        gather([tmp_path / "5"], [], tmp_path / "five", 5)
