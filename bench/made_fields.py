"""Made images that the trees of changes are fitted to: fields of texture, and cities in 8 bits.

Simulated cities and real scenes never show images without any noise, roofs of the ground's own
brightness, huts of a few pixels or ground without texture. A field is level ground on which
rectangles stand apart from each other. Each is of one kind: new in both images at another
disparity (built), in the LiDAR alone (gone, as a building or a crown), moved up or down (raised),
in one image alone (passing), or as it was (kept). Under two lights the right image has another
gain, and patches of it are darker.

Images of 8 bits have a tone curve, and noise whose neighbours correlate and which is five times as
great in shadow as in the light.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter

from stereotruth.labels.change_evidence import LabelledWindow
from stereotruth.labels.pair_window import Labels, PairWindow, read_patch
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.sensor.image_noise import NoiseCurve, pair_noise

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SIDE_PX, BORDER_PX = 240, 70  # of the window; of what the images show around it
LEVEL_PX = 4  # disparity of the ground
KINDS = "built", "gone", "felled", "raised", "passing", "kept"
TRIES, APART_PX = 120, 14  # of a place for something; px between two
GROUND, TREE, ROOF = 2, 5, 6  # ASPRS
# Share of the fields that have no texture at all, or noise alone; what share of these has changed
BLANK, OF_BLANK = 0.15, 0.05
TOLD = 4.0  # times the noise, a contrast that tells a new roof from new asphalt
SHADE_DN, LIGHT_DN = 3.5, 0.7  # noise of images of 8 bits at the darkest and at the brightest
BLUR_PX = 0.55  # of that noise: neighbours correlate by 0.4
BLEEDS = 0.3, 0.03  # what the optics bring over from a roof to the pixels beside it, by turns


class Field(NamedTuple):
    """A window, and which of its pixels [h, w] have ``changed`` (or are hidden by what has) and
    which are the ``same``."""

    compared: LabelledWindow
    changed: Bools
    same: Bools


class _Images(NamedTuple):
    """Both images [h, w], as they are painted, and the LiDAR's disparity and class [h, w] with
    what is true there."""

    left: Floats
    right: Floats
    disparity: Floats
    surface_class: NDArray[np.uint8]
    changed: Bools
    same: Bools


def made_field(number: int, apart: bool) -> Field:
    """The field of a number; ``apart``: whether its images share no light."""
    rng = np.random.default_rng([number, apart, 51])
    side = SIDE_PX + 2 * BORDER_PX
    level = rng.uniform(300.0, 1500.0)
    noise = level * np.exp(rng.uniform(np.log(0.003), np.log(0.04)))  # as it is stated
    contrast = min(noise * np.exp(rng.uniform(np.log(0.3), np.log(60.0))), 0.4 * level)
    has_texture = rng.random() > BLANK
    blur = rng.choice([0.0, rng.uniform(0.6, 2.0), rng.uniform(2.0, 6.0)])
    ground = np.full((side, side), level)
    if has_texture:
        ground += contrast * _texture(rng, side, blur)
    images = _Images(
        ground, np.roll(ground, -LEVEL_PX, axis=1),
        np.full((side, side), float(LEVEL_PX)), np.full((side, side), GROUND, np.uint8),
        np.zeros((side, side), np.bool_), np.ones((side, side), np.bool_),
    )  # fmt: skip
    if not has_texture:
        _change_unseen(images, rng)
    else:
        _paint(images, rng, (level, contrast, blur, noise), apart)
    if apart:
        _other_light(images.right, rng)
    optics, truly = rng.choice([0.0, 0.6]), rng.choice([0.0, 0.5, 1.0, 1.0, 1.0])
    left, right = (
        np.round(
            gaussian_filter(image, optics) + truly * noise * rng.normal(size=image.shape)
        ).clip(1.0)  # 0 is nodata
        for image in (images.left, images.right)
    )
    inner = slice(BORDER_PX, BORDER_PX + SIDE_PX)
    window = PairWindow(
        inner, inner, 0, read_patch(left, inner, inner, 1),
        read_patch(right, inner, slice(0, side), 1),
    )  # fmt: skip
    disparity, surface_class, changed, same = (values[inner, inner] for values in images[2:])
    labels = Labels(disparity, np.zeros((2, *disparity.shape)), np.zeros_like(disparity))
    labelled = np.isfinite(disparity)
    compared = LabelledWindow(window, labels, labelled, surface_class, (noise**2, noise**2))
    return Field(compared, changed & labelled, same & labelled)


def _texture(rng: np.random.Generator, side: int, blur: float) -> Floats:
    """White texture behind optics, of a standard deviation of 1."""
    field = gaussian_filter(rng.normal(size=(side, side)), blur)
    return field / field.std()


def _change_unseen(images: _Images, rng: np.random.Generator) -> None:
    """Parts of blank ground have changed, of which the images show nothing."""
    side = len(images.left)
    while images.changed.mean() < OF_BLANK:
        rows, cols = rng.integers(10, 40, 2)
        top, first = (rng.integers(0, side - size) for size in (rows, cols))
        images.changed[top : top + rows, first : first + cols] = True
    images.same[images.changed] = False


def _paint(
    images: _Images, rng: np.random.Generator, look: tuple[float, float, float, float], apart: bool
) -> None:
    """Things of all kinds, as many as find a place; ``look``: brightness, contrast, blur and noise.
    Under two lights nothing tells what is in one image alone from a shadow where it is small, and
    from a new surface of the street where it has little contrast: left out."""
    level, contrast, blur, noise = look
    side = len(images.left)
    taken = np.zeros((side, side), np.bool_)
    for _ in range(TRIES):
        kind = str(rng.choice(KINDS))
        small = kind == "felled" or rng.random() < 0.5
        if kind == "passing":
            if apart and contrast < TOLD * noise:
                continue
            small = not apart and rng.random() < 0.8
        low, high = (5, 16) if small else (12, 60)
        rows, cols = rng.integers(low, high, 2)
        top, first = (rng.integers(30, side - 30 - size) for size in (rows, cols))
        margin = APART_PX + 15
        around = np.s_[max(top - APART_PX, 0) : top + rows + APART_PX,
                       max(first - margin, 0) : first + cols + margin]  # fmt: skip
        if taken[around].any():
            continue
        taken[top : top + rows, first : first + cols] = True
        likeness = 1.0 if rng.random() < 0.4 else np.exp(rng.uniform(-1.5, 1.5))
        own = contrast * np.exp(rng.uniform(-1.0, 0.7)) * _texture(rng, 64, blur)
        pixels = likeness * (level + own)[:rows, :cols]
        _place(images, kind, np.s_[top : top + rows, first : first + cols], pixels, rng)


def _place(
    images: _Images,
    kind: str,
    there: tuple[slice, slice],
    pixels: Floats,
    rng: np.random.Generator,
) -> None:
    """One thing, which shows ``pixels``; its rims and what it hides have no label."""
    left, right, disparity, surface_class, changed, same = images
    rows, cols = there
    if kind == "passing":
        if rng.random() < 0.5:
            left[there] = pixels
        else:
            right[rows, cols.start - LEVEL_PX : cols.stop - LEVEL_PX] = pixels
        changed[there], same[there] = True, False
        return
    rise = int(rng.integers(2, 16))
    if kind in ("built", "raised", "kept"):
        moved = rise + (int(rng.choice([-1, 1]) * rng.integers(2, 7)) if kind == "raised" else 0)
        moved = max(moved, 0)
        if kind == "raised" and moved == rise:
            moved += 3
        left[there] = pixels
        shown = LEVEL_PX + moved
        right[rows, cols.start - shown : cols.stop - shown] = pixels
    else:
        moved = 0
    hidden = np.zeros_like(changed)
    hidden[rows, cols.start - max(moved, rise) : cols.start] = True
    if kind == "built":
        changed[there] = True
        changed |= hidden
        same[there] = False
        same &= ~hidden
        return
    rim = np.zeros_like(changed)
    rim[there] = True
    rim = binary_dilation(rim) & ~rim
    disparity[there] = LEVEL_PX + rise
    surface_class[there] = TREE if kind == "felled" else ROOF
    disparity[rim | hidden] = np.nan
    if kind != "kept":
        changed[there], same[there] = True, False
        return
    image, end = (left, cols.stop) if rng.random() < 0.5 else (right, cols.stop - shown)
    for px, share in enumerate(BLEEDS):
        image[rows, end + px] += share * (pixels.mean() - image[rows, end + px])


def _other_light(image: Floats, rng: np.random.Generator) -> None:
    """Another gain, and patches in shadow."""
    image *= rng.uniform(0.6, 1.6)
    for _ in range(rng.integers(0, 7)):
        rows, cols = rng.integers(8, 60, 2)
        top, first = (rng.integers(0, len(image) - size) for size in (rows, cols))
        image[top : top + rows, first : first + cols] *= rng.uniform(0.2, 0.7)


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
    return window, pair_noise(*images, inputs.pair.model.disparities())
