"""What a pixel is in metres, by orientation files of known geometry."""

from __future__ import annotations

import json

import numpy as np
import pytest

from stereotruth.dataset.orientation import GROUND_TOLERANCE
from stereotruth.dataset.pixel_size import DEGREE_M, PixelSize
from stereotruth.dataset.polynomials import fit

GSD, RATIO, LAT = 0.7, 0.62, 30.0  # m, base to height, degrees


def orientation(gsd: float = GSD) -> dict:
    """A tile of 100 px on flat ground: columns to the north-east, a height as its disparity."""
    side, depth = np.linspace(0, 100, 6), np.linspace(-5, 20, 6)
    x, y, d = (v.ravel() for v in np.meshgrid(side, side, depth))
    height = 40 + d * gsd / RATIO
    east, north = (gsd * (x * c + y * s) for c, s in ((0.8, 0.6), (0.6, -0.8)))
    lon = 114 + east / (DEGREE_M * np.cos(np.radians(LAT)))
    ground = {"lon": lon, "lat": LAT + north / DEGREE_M, "height": height}
    inputs = {"x": x, "y": y, "d": d}
    record = fit(inputs, ground, tuple(inputs.values()), tuple(ground.values()), GROUND_TOLERANCE)
    return {"window": {"size": 100}, "ground": record | {"disparity_range_px": [-5.0, 20.0]}}


def test_a_pixel_has_the_metres_of_its_geometry():
    size = PixelSize.of(orientation())
    assert size.ground_m == pytest.approx(GSD, rel=1e-4)
    assert size.height_m == pytest.approx(GSD / RATIO, rel=1e-6)
    assert size.base_to_height == pytest.approx(RATIO, rel=1e-4)


def test_the_mean_is_that_of_the_files_that_are_there(tmp_path):
    for name, gsd in (("a", 0.5), ("b", 1.5)):
        (tmp_path / f"{name}.json").write_text(json.dumps(orientation(gsd)))
    size = PixelSize.mean(tmp_path / f"{name}.json" for name in "abc")
    assert size.ground_m == pytest.approx(1.0, rel=1e-4)
    assert size.height_m == pytest.approx(1.0 / RATIO, rel=1e-6)
    assert PixelSize.mean([tmp_path / "c.json"]) is None
