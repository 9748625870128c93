"""A scene with its exact truth, made once."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.fit import fit_epipolar

from ...synthetic.truth_scene import (
    GROUND,
    ROOF_CLASS,
    SIZE,
    WATER,
    Scene,
    ground_at,
    on_roof,
    sensor,
    write_store,
)


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Scene:
    folder = tmp_path_factory.mktemp("scene")
    left, right = sensor("left"), sensor("right")
    model = fit_epipolar(left, right, SIZE["left"], SIZE["right"], 65.0)
    row, col = np.mgrid[0:380, 0:420].astype(float)
    lon, lat, height = ground_at(left, col, row)
    right_col, right_row = right.project(lon, lat, height)
    visible = (np.abs(right_col - 189.5) <= 190) & (np.abs(right_row - 209.5) <= 210)
    raw = {"lon": lon, "lat": lat, "height": height, "right_col": right_col}
    raw |= {"right_row": right_row, "visible_right": visible.astype("uint8")}
    write_store(folder / "raw.zarr", raw)

    y, x = np.mgrid[0 : model.shape[0], 0 : model.shape[1]].astype(float)
    col, row = model.epipolar_to_left(x, y)
    shown = (np.abs(col - 209.5) <= 210) & (np.abs(row - 189.5) <= 190)
    lon, lat, height = ground_at(left, col, row)
    right_col, right_row = right.project(lon, lat, height)
    right_x, right_y = model.right_to_epipolar(right_col, right_row)
    surface = np.where(on_roof(col, row), ROOF_CLASS, GROUND)
    surface[300:330, 60:120] = WATER
    surface[~shown] = 0
    behind = np.zeros(shown.shape, bool)
    behind[230:250, 180:290] = True
    inside = (np.abs(right_col - 189.5) <= 190) & (np.abs(right_row - 209.5) <= 210)
    changed, edge, covered = (np.zeros(shown.shape, "uint8") for _ in range(3))
    changed[60:90, 60:90], changed[60:90, 100:120] = 1, 2
    edge[140:160], edge[100:110] = 1, 2
    covered[:, :340] = 1
    changed_right = np.zeros(shown.shape, "uint8")
    changed_right[200:260, 200:240] = 1
    layers = {
        "disparity": np.where(shown, x - right_x, np.nan).astype("float32"),
        "y_parallax": np.where(shown, right_y - y, np.nan).astype("float32"),
        "visible": (shown & inside & ~behind).astype("uint8"),
        "hidden": (shown & inside & behind).astype("uint8"),
        "changed": np.where(shown, changed, 0).astype("uint8"),
        "changed_right": np.where(shown & (changed == 0), changed_right, 0).astype("uint8"),
        "covered": np.where(shown, covered, 0).astype("uint8"),
        "surface": surface.astype("uint8"),
        "edge": edge,
    }
    write_store(folder / "truth.zarr", layers, kind="truth", epipolar=model.to_dict())
    return Scene(model, folder / "truth.zarr", folder / "raw.zarr", folder)
