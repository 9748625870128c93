"""Quick looks on a map: their pixels show the ground that their coordinates name."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
import rasterio

from stereotruth.tiles.ground_looks import write_ground_looks
from stereotruth.tiles.scene_stores import open_stores

from ...synthetic.other_programs import PROGRAMS
from ...synthetic.tiled_scene import make_scene, terrain, texture


@pytest.mark.parametrize("colour", [False, True])
def test_a_quick_look_shows_what_is_there(tmp_path, colour) -> None:
    """The texture of the ground is known: a metre off would leave a correlation of 0.9."""
    scene = make_scene(tmp_path / "s1", colour=colour)
    source = open_stores(scene)
    left, disparity = write_ground_looks(tmp_path, source)
    assert (left.name, disparity.name) == ("s1_left.tif", "s1_disparity.tif")
    with rasterio.open(left) as dataset:
        bands, to_map = dataset.read(), dataset.transform
        assert dataset.crs.to_epsg() == 32650
        assert [c.name for c in dataset.colorinterp] == ["red", "green", "blue", "alpha"]
        assert 0.5 < to_map.a == -to_map.e < 1.5
    for name, program in PROGRAMS.items():
        found = program(left)
        if name == "OpenCV":  # alpha came last
            found = np.roll(found, -1, axis=-1)
        np.testing.assert_array_equal(found, np.moveaxis(bands, 0, -1), err_msg=name)
    shown = bands[3] > 0
    assert shown.mean() > 0.5
    rows, cols = np.nonzero(shown)
    back = pyproj.Transformer.from_crs(32650, 4326, always_xy=True)
    lon, lat = back.transform(*(to_map * (cols + 0.5, rows + 0.5)))
    for band in bands[:3]:
        assert np.corrcoef(band[shown], texture(lon, lat))[0, 1] > 0.97
    with rasterio.open(disparity) as dataset:
        assert dataset.transform == to_map
        known = dataset.read(4) > 0
        assert known.mean() == pytest.approx(0.9 * shown.mean(), abs=0.05)
        green = dataset.read(2)[known].astype(float)  # of viridis it grows throughout
    rows, cols = np.nonzero(known)
    height = terrain(*back.transform(*(to_map * (cols + 0.5, rows + 0.5))))
    assert np.corrcoef(green, height)[0, 1] > 0.8
