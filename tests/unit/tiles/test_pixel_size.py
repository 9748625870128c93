"""What a pixel is in metres, by orientation files of known geometry."""

from __future__ import annotations

import json

import pytest

from stereotruth.tiles.pixel_size import PixelSize

from ...synthetic.flat_orientation import GSD, RATIO, orientation


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
