"""Masks of the images: what they hide has a status of its own, and enters no comparison."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

from stereotruth.core.products.grids import Layer, atomic_store, create_grid, open_grid
from stereotruth.core.status import Status, is_labelled

from ...synthetic.box_scene import Scene, dilated, project_with

CLOUD = np.s_[120:150, 150:190]  # of the left grid
SHADOW = np.s_[170:190, 100:130]  # of the right grid


@pytest.fixture(scope="module")
def plane(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("plane"), box=False)


@pytest.fixture(scope="module")
def masked(plane, tmp_path_factory) -> list[Path]:
    """The images, in which a mask hides what is wrong: bright noise, other in each."""
    folder, rng = tmp_path_factory.mktemp("masked"), np.random.default_rng(5)
    layers = {n: Layer(t, 0, {"units": "1"}) for n, t in (("image", "uint16"), ("mask", "uint8"))}
    stores = []
    for source, where in zip(plane.images, (CLOUD, SHADOW)):
        given = zarr.open_group(source)
        pixels, mask = given["image"][:], np.zeros(given["image"].shape, np.uint8)
        pixels[where] = rng.integers(3000, 60000, pixels[where].shape)
        mask[where] = 1
        attrs = {k: given.attrs[k] for k in ("epipolar", "provenance")}
        with atomic_store(folder / source.name) as scratch:
            grid = create_grid(scratch, pixels.shape, layers, chunk=256, shard=1024, attrs=attrs)
            grid["image"][:], grid["mask"][:] = pixels, mask
        stores.append(folder / source.name)
    return stores


def hidden(shape: tuple[int, int], where: tuple[slice, slice]) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[where] = True
    return mask


@pytest.mark.parametrize(("view", "recipe"), [("left", "surface"), ("right", "paper")])
def test_masked_pixels_of_either_view_have_a_status_and_no_label(
    plane, masked, tmp_path, view, recipe
) -> None:
    """Those of the other view too, where the pixel's match is masked; and no others."""
    summary = project_with(*masked, [plane.store], tmp_path / "out.zarr", view=view, recipe=recipe)
    grid = open_grid(tmp_path / "out.zarr")
    status, disparity = grid["status"].values, grid["disparity"].values
    assert grid["status"].attrs["flag_values"][-1] == Status.MASKED == 11
    assert grid["status"].attrs["flag_meanings"].split()[-1] == "masked"
    assert summary["pixels"]["masked"] == (status == Status.MASKED).sum()
    own, other = (CLOUD, SHADOW) if view == "left" else (SHADOW, CLOUD)
    own, other = hidden(status.shape, own), hidden(status.shape, other)
    clear = project_with(
        *plane.images, [plane.store], tmp_path / "clear.zarr", view=view, recipe=recipe
    )
    assert "masked" not in clear["pixels"]
    before = open_grid(tmp_path / "clear.zarr")
    known = is_labelled(before["status"].values)
    y, x = np.indices(status.shape)
    shift = before["disparity"].values * (-1 if view == "left" else 1)
    match = np.where(known, np.rint(x + shift), 0).astype(int)
    there = known & other[y, match.clip(0, other.shape[1] - 1)]
    assert there.sum() > 300
    assert (status[own] == Status.MASKED).all()
    assert (status[there] == Status.MASKED).all()
    for name in ("disparity", "height", "correlation", "uncertainty"):
        assert np.isnan(grid[name].values[status == Status.MASKED]).all()
    assert (grid["point_count"].values[status == Status.MASKED] == 0).all()
    # what is no nearer than half a window and a step is as without masks
    far = ~dilated(own | there, 7)
    np.testing.assert_array_equal(status[far], before["status"].values[far])
    np.testing.assert_array_equal(disparity[far], before["disparity"].values[far])
    assert (is_labelled(status) == np.isfinite(disparity)).all()


def test_nothing_of_a_masked_image_enters_the_labels(plane, masked, tmp_path) -> None:
    """Whatever is under the mask, the store has the same bytes."""
    other = tmp_path / "left.zarr"
    shutil.copytree(masked[0], other)
    image = zarr.open_group(other)["image"]
    image[CLOUD] = np.full_like(image[CLOUD], 7)
    found = []
    for left in (masked[0], other):
        project_with(left, masked[1], [plane.store], tmp_path / "out.zarr")
        found.append(open_grid(tmp_path / "out.zarr").load())
    for name, array in found[0].items():
        np.testing.assert_array_equal(array, found[1][name])
