"""The accessor of a labelled pair, and the name by which Python has it."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

import stereotruth
from stereotruth.core.products.provenance import source_modules
from stereotruth.project.label_pair import label_pair


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 500 + 100 * np.sin(x / 7) * np.cos(y / 9)


def pair(disparity: np.ndarray) -> xr.Dataset:
    """Left and right image of a smooth texture, the right one ``disparity`` to the left."""
    y, x = np.indices(disparity.shape).astype(float)
    right_y, right_x = np.indices((len(disparity), 300)).astype(float)
    # one disparity a row, so that the right image is known exactly
    right = scene(right_x + disparity[:, :1], right_y)
    return xr.Dataset(
        {
            "disparity": (("y", "x"), disparity.astype("f4")),
            "left": (("y", "x"), scene(x, y).astype("f4"), {"units": "1"}),
            "right": (("y", "x_right"), right.astype("f4")),
        },
        coords={"x": np.arange(disparity.shape[1]), "y": np.arange(len(disparity)),
                "x_right": np.arange(300)},
    )  # fmt: skip


def test_the_right_image_warped_is_the_left_one_where_there_is_a_label() -> None:
    disparity = np.repeat(np.linspace(-20.3, 17.8, 80)[:, None], 240, axis=1)
    disparity[:, 100:110] = np.nan
    whole = pair(disparity)
    warped = whole.stereotruth.warp()
    assert warped.dims == ("y", "x") and warped.attrs["units"] == "1"
    assert warped[:, 100:110].isnull().all()
    at = whole["x"].values - disparity
    inside = (at > 2) & (at < 297)
    np.testing.assert_allclose(warped.values[inside], whole["left"].values[inside], atol=0.1)
    assert inside.mean() > 0.8
    part = {"y": slice(10, 40), "x": slice(50, 90)}
    np.testing.assert_array_equal(
        whole.isel(part).stereotruth.warp().values, warped.isel(part).values
    )


def test_the_package_has_the_function_by_name_and_no_digest_has_it() -> None:
    assert stereotruth.label_pair is label_pair
    with pytest.raises(AttributeError):
        stereotruth.nothing  # noqa: B018
    assert "stereotruth.project.label_pair" not in source_modules("stereotruth.tiles.originals")
