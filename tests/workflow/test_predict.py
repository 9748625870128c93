"""Whole scenes by the workflow: disparities and surface model."""

from __future__ import annotations

import json

import numpy as np
import rasterio

from stereobench.methods.surface_model import Raster
from stereotruth.core.products.grids import open_grid
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate.epipolar_truth import truth_window

from ..synthetic.project import TINY

TARGET = "results/predict/Tiny/Tiny-1/sgm_dsm.tif"
ARGUMENTS = ["--configfile", "tiny.yaml", "later.yaml"]


def test_a_scene_becomes_disparities_and_a_surface_model(later):
    project = later
    folder = project.folder / "results"
    found = open_grid(folder / "predict/Tiny/Tiny-1/sgm.zarr")
    model = EpipolarModel.load(folder / "rectify/Tiny/Tiny-1/epipolar.json")
    window = (slice(0, model.shape[0]), slice(0, model.shape[1]))
    truth = truth_window(model, TINY, TINY.scenes[0], *window)
    error = found["disparity"].values - truth["disparity"]
    known = np.isfinite(error) & (truth["visible"] == 1)
    assert known.mean() > 0.6
    assert np.median(np.abs(error[known])) < 0.25
    with rasterio.open(project.folder / TARGET) as dataset:
        heights = dataset.read(1, masked=True)
        assert dataset.crs.to_epsg() == TINY.epsg
        t = dataset.transform
        raster = Raster(TINY.epsg, t.c, t.f, t.a, dataset.shape)
        assert dataset.tags()["vertical_datum"] == "WGS 84 ellipsoid"
    assert raster.resolution == 0.8
    place = (np.array([dataset.width / 2.0]), np.array([dataset.height / 2.0]))
    lon, lat = raster.ground(*place)
    assert abs(lon[0] - TINY.lon) < 0.002 and abs(lat[0] - TINY.lat) < 0.002
    assert TINY.base_height_m - 5 < np.ma.median(heights) < TINY.base_height_m + 30


def test_the_surface_model_is_judged(later):
    (later.folder / "coarse.yaml").write_text("predict: {dsm: {resolution_m: 2.0}}\n")
    assert later.plan(TARGET, *ARGUMENTS, "coarse.yaml") == {"dsm": 1}
    folder = later.folder / "score_dsm/Tiny/Tiny-1/sgm"
    found = json.loads((folder / "scores.json").read_text())
    assert abs(found["registration"]["up_m"]) < 1.0
    assert found["errors"]["ground, off steps"]["known_share"] > 0.5
    assert (folder / "index.html").is_file()
