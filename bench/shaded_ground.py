"""Shaded ground in images of 8 bits, whose noise is greatest in shadow: before and after.

python bench/shaded_ground.py [--figure docs/shade.png] [--folder results/changes]

A simulated city in which nothing has changed. Its images get a tone curve, 8 bits, and noise whose
neighbours correlate and which is five times as great in shadow as in the light. The labels that
images contradict where noise counts as one number, as second differences see it in one image, and
by brightness as both images tell it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from changes import CONDITIONS, Case, inputs_of
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from stereotruth.disparity.change_evidence import LabelledWindow
from stereotruth.disparity.change_probability import change_probability
from stereotruth.disparity.crowns import with_crowns
from stereotruth.disparity.image_agreement import least_probability
from stereotruth.disparity.pair_window import PairWindow
from stereotruth.disparity.recipe import lidar_labels
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.disparity.window_points import read_window
from stereotruth.epipolar.image_noise import EQUAL, ROUNDING, NoiseCurve, pair_noise
from stereotruth.pages.pictures import save_figure
from stereotruth.status import is_labelled

SHADE_DN, LIGHT_DN = 3.5, 0.7  # noise at the darkest and at the brightest
BLUR_PX = 0.55  # of the noise: neighbours correlate by 0.4
SIDE_PX = 200  # of the block that is drawn
SEED = 61


def toned(image: NDArray[np.floating], seed: int) -> NDArray[np.float32]:
    """An image of 8 bits; 0 stays 0."""
    known = image > 0
    low, high = np.quantile(image[known], [0.001, 0.995])
    grey = 20.0 + 230.0 * np.sqrt(np.clip((image - low) / (high - low), 0.0, 1.0))
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=image.shape), BLUR_PX)
    sigma = SHADE_DN * (LIGHT_DN / SHADE_DN) ** ((grey - 20.0) / 230.0)
    noisy = np.clip(np.rint(grey + sigma * noise / noise.std()), 1, 255)
    return np.where(known, noisy, 0).astype(np.float32)


def in_eight_bits(
    inputs: SceneInputs, window: PairWindow
) -> tuple[PairWindow, tuple[NoiseCurve, NoiseCurve]]:
    """A window with such images in place of its own, and their noise."""
    images = [toned(image[:, :].astype(float), n) for n, image in enumerate(inputs.pair.images)]
    patches = []
    for patch, image in zip((window.left, window.right), images):
        pixels = np.zeros_like(patch.pixels)
        top, side = max(patch.row, 0), max(patch.col, 0)
        here = image[top : patch.row + pixels.shape[0], side : patch.col + pixels.shape[1]]
        pixels[top - patch.row :, side - patch.col :][: here.shape[0], : here.shape[1]] = here
        patches.append(replace(patch, pixels=pixels))
    window = replace(window, left=patches[0], right=patches[1])
    return window, pair_noise(*images, inputs.pair.model)


def main() -> None:
    """Draw the figure, and print what is lost by brightness."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--figure", type=Path, default=Path("docs/shade.png"))
    parser.add_argument("--folder", type=Path, default=Path("results/changes"))
    given = parser.parse_args()
    inputs = inputs_of(Case("nothing", CONDITIONS[0], SEED, 4.0), given.folder)
    rows, cols = (slice(0, side) for side in inputs.pair.model.shape)
    found = lidar_labels(inputs, *read_window(inputs, rows, cols))
    labels = with_crowns(found.labels, found.rough, found.window)
    labelled = is_labelled(labels.status)
    window, curves = in_eight_bits(inputs, found.window)
    flat = NoiseCurve((0.0,), (max(min(curves[0].deviation) / 2.2, ROUNDING**0.5),))
    lost = []
    for noise in ((flat, flat), curves):
        compared = LabelledWindow(
            window.of_equal_noise(noise), labels.labels, labelled, labels.surface_class, EQUAL
        )
        limit = least_probability(compared)
        lost.append(labelled & (change_probability(compared, diachronic=False).probability > limit))
    left, warped = window.images_at(labels.labels.disparity)
    for low, high in ((1, 60), (60, 100), (100, 150), (150, 256)):
        chosen = labelled & (left >= low) & (left < high)
        shares = (f"{100.0 * part[chosen].mean():.1f}" for part in lost)
        print(f"| {low} to {high} DN | {' | '.join(shares)} | {chosen.sum()} px |")
    block = darkest(left, labelled)
    figure = Figure(figsize=(12.0, 3.5))
    axes = figure.subplots(1, 4)
    figure.subplots_adjust(left=0.005, right=0.995, top=0.9, bottom=0.01, wspace=0.03)
    grey = np.clip(left / 150.0, 0.0, 1.0)
    for axis, title, part in (
        (axes[0], "left image", None), (axes[1], "right image, warped", None),
        (axes[2], "changed, by one noise", lost[0]), (axes[3], "by noise where it is", lost[1]),
    ):  # fmt: skip
        shown = np.clip(np.nan_to_num(warped) / 150.0, 0.0, 1.0) if axis is axes[1] else grey
        picture = np.repeat(shown[..., None], 3, axis=2)
        if part is not None:
            picture[part] = (0.76, 0.07, 0.12)
        axis.imshow(picture[block], interpolation="nearest")
        axis.set(xticks=[], yticks=[], title=title)
    save_figure(given.figure, figure, dpi=80)


def darkest(image: NDArray[np.floating], labelled: NDArray[np.bool_]) -> tuple[slice, slice]:
    """The block with most labelled pixels in shadow."""
    in_shade = labelled & (image < np.quantile(image[labelled], 0.08))
    blocks = [
        np.s_[row : row + SIDE_PX, col : col + SIDE_PX]
        for row in range(0, image.shape[0] - SIDE_PX, 20)
        for col in range(0, image.shape[1] - SIDE_PX, 20)
    ]
    return max(blocks, key=lambda block: int(in_shade[block].sum()))


if __name__ == "__main__":
    main()
