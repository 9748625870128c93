"""Labelled pairs as a PyTorch dataset."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from torch.utils.data import DataLoader

from stereobench.networks.training_pairs import LabelledPairs
from stereobench.networks.weights import scaled
from stereotruth.core.config.methods import Augmentation
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_image
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.small_pairs import SIZE


def test_pairs_are_scaled_and_unlabelled_pixels_are_nan(dataset: StereoDataset) -> None:
    data = LabelledPairs.of(dataset, "train")
    assert len(data) == 3
    left, right, disparity = data[0]
    raw = read_image(data.pairs[0].left).astype(float)
    np.testing.assert_allclose(left[0].numpy(), (raw - raw.mean()) / raw.std(), atol=1e-5)
    assert left.shape == right.shape == (1, SIZE, SIZE) and disparity.shape == (SIZE, SIZE)
    assert torch.isnan(disparity[: SIZE // 4]).all()
    assert (disparity[SIZE // 4 :] == -6).all()
    narrow = LabelledPairs.of(replace(dataset, disparity_range=(-6, 9)), "train")
    assert [bool(torch.isfinite(narrow[k][2]).any()) for k in range(3)] == [True, True, False]
    with pytest.raises(InputError, match="128 x 64 px"):
        LabelledPairs.of(dataset, "train", crop_px=(128, 64))[0]


def test_the_three_lines_of_the_documentation(
    dataset: StereoDataset, tmp_path, monkeypatch
) -> None:
    page = Path(__file__).parents[3] / "docs" / "how-to" / "pytorch.md"
    blocks = re.findall(
        r"```[{}a-z -]*python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL
    )
    (lines,) = (block for block in blocks if "Labelled" in block)
    assert len(list(filter(None, lines.splitlines()))) == 3
    (tmp_path / "dataset").symlink_to(dataset.root)
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    exec(lines, found)
    left, right, disparity = found["pairs"][0]
    assert left.shape == right.shape == (1, SIZE, SIZE) and disparity.shape == (SIZE, SIZE)
    assert len(found["pairs"]) == 3 and torch.isfinite(disparity).any()


def test_windows_lose_matches_that_they_cut_off_and_no_others(dataset: StereoDataset) -> None:
    data = LabelledPairs.of(dataset, "train", crop_px=(32, 24), seed=3)
    cut, ended = 0, 0
    for epoch in range(12):
        data.epoch = epoch
        for k, d in enumerate((-6, 3, 9)):
            left, right, disparity = data[k]
            assert left.shape == (1, 32, 24)
            known = torch.isfinite(disparity)
            assert known.any() and (disparity[known] == d).all()
            labelled = known.any(dim=1)  # rows
            cols = torch.arange(24) - d
            inside = (cols >= 0) & (cols < 24)
            assert known[labelled][:, inside].all()
            # the pixels correspond, so the same window was cut of both (each has its own scale)
            a, b = left[0][:, inside], right[0][:, cols[inside]]
            assert torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1] > 0.999
            whole = scaled(read_image(data.pairs[k].left), data.model, None)[0]
            first = next(
                c
                for c in range(SIZE - 23)
                if any(np.array_equal(whole[r : r + 32, c : c + 24], left[0]) for r in range(33))
            )
            in_tile = (first + cols >= 0) & (first + cols < SIZE)
            assert not known[:, in_tile & ~inside].any()
            assert known[labelled][:, ~in_tile].all()
            cut, ended = cut + int((in_tile & ~inside).sum()), ended + int((~in_tile).sum())
    assert cut and ended


def test_windows_follow_from_seed_epoch_and_number(dataset: StereoDataset) -> None:
    augmentation = Augmentation(flip_rows=True, contrast=0.2, brightness=0.2, noise=0.1)
    settings = {"crop_px": (16, 16), "augmentation": augmentation}
    data = LabelledPairs.of(dataset, "train", crops_per_pair=2, **settings)
    assert len(data) == 6
    first = [t.numpy() for t in data[4]]
    for again, same in (
        (data, True),
        (replace(data, epoch=1), False),
        (replace(data, seed=1), False),
    ):
        found = [t.numpy() for t in again[4]]
        assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, found)) == same
    one, two = (
        [
            [t.numpy() for t in batch]
            for batch in DataLoader(data, 2, num_workers=n, multiprocessing_context=c)
        ]
        for n, c in ((0, None), (1, "forkserver"))
    )
    for a, b in zip(one, two):
        assert all(np.array_equal(x, y, equal_nan=True) for x, y in zip(a, b))


def test_faults_of_images_are_planted_before_they_are_scaled(dataset: StereoDataset) -> None:
    plain = LabelledPairs.of(dataset, "train", seed=4)
    faulty = LabelledPairs.of(dataset, "train", augmentation=Augmentation(haze=1.0), seed=4)
    for k in range(3):
        first, second, third = plain[k], faulty[k], faulty[k]
        assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(second, third))
        changed = [not torch.equal(a, b) for a, b in zip(first[:2], second[:2])]
        assert sum(changed) == 1
        image = second[changed.index(True)]
        assert abs(float(image.mean())) < 1e-4  # by the statistics of the changed image
        torch.testing.assert_close(first[2], second[2], equal_nan=True)
    faulty.epoch = 1
    assert not torch.equal(faulty[0][0], second[0]) or not torch.equal(faulty[0][1], second[1])
