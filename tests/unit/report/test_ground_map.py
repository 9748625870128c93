"""The map of tiles on the ground: north up, true distances, pictures where they belong."""

from __future__ import annotations

import json

import numpy as np
import pyproj
import pytest
import rasterio

from stereotruth.report.ground_map import MARGIN, SIDE, ground_map

CORNER, STEP = (500_000.0, 3_400_000.0), 300.0  # m in UTM 50N
TO_DEGREES = pyproj.Transformer.from_crs(32650, 4326, always_xy=True)


def ring(col: int, row: int) -> list[list[float]]:
    """A square of ``STEP`` m, the row-th to the north."""
    x = CORNER[0] + STEP * (col + np.array([0, 1, 1, 0, 0]))
    y = CORNER[1] + STEP * (row + np.array([0, 0, 1, 1, 0]))
    return np.stack(TO_DEGREES.transform(x, y), axis=1).tolist()


@pytest.fixture
def folder(tmp_path):
    """Three tiles: one to the east of the first, one to its north; no footprint of a fourth."""
    features = [
        {"id": name, "geometry": {"coordinates": [ring(*at)]}}
        for name, at in (("first", (0, 0)), ("east", (1, 0)), ("north", (0, 1)))
    ]
    (tmp_path / "footprints.geojson").write_text(json.dumps({"features": features}))
    return tmp_path


ROWS = [
    {"tile": name, "number": str(k), "split": "train", "complete": "yes", "quality": "ok"}
    for k, name in enumerate(("first", "east", "north", "nowhere"))
]


def look(path, *, epsg=32650):
    """A picture of the whole ground, 10 m a pixel: white, but black over the first tile."""
    bands = np.full((4, 60, 60), 255, np.uint8)
    bands[:3, 30:, :30] = 0
    place = rasterio.Affine(10, 0, CORNER[0], 0, -10, CORNER[1] + 600)
    profile = {"driver": "GTiff", "width": 60, "height": 60, "count": 4, "dtype": "uint8"}
    with rasterio.open(path, "w", crs=f"EPSG:{epsg}", transform=place, **profile) as file:
        file.write(bands)
    return path


def test_north_is_up_and_distances_are_true(folder):
    found = ground_map(folder, ROWS, [], 10**5)
    tiles = {tile.tile: tile for tile in found.tiles}
    assert set(tiles) == {"first", "east", "north"}
    scale = SIDE / (600 * (1 + 2 * MARGIN))  # units a metre
    first = tiles["first"]
    # a degree of UTM's own scale, 0.9996, is 0.1 units over this ground
    assert tiles["east"].x - first.x == pytest.approx(STEP * scale, abs=0.5)
    assert tiles["east"].y == pytest.approx(first.y, abs=0.5)
    assert first.y - tiles["north"].y == pytest.approx(STEP * scale, abs=0.5)
    assert found.bar / found.bar_m == pytest.approx(scale, rel=1e-3)
    assert found.bar_m in (100, 200)


def test_a_picture_lies_under_its_tiles(folder):
    look(folder / "look.tif")
    found = ground_map(folder, ROWS, [folder / "look.tif"], 10**5)
    (picture,) = found.pictures
    first = next(tile for tile in found.tiles if tile.tile == "first")
    # the first tile has the lower left quarter of the picture
    assert first.x == pytest.approx(picture.x + 0.25 * picture.width, abs=0.3)
    assert first.y == pytest.approx(picture.y + 0.75 * picture.height, abs=0.3)


def test_a_picture_in_another_zone_is_left_out(folder):
    looks = [look(folder / "a.tif"), look(folder / "b.tif", epsg=32649)]
    assert len(ground_map(folder, ROWS, looks, 10**5).pictures) == 1


def test_without_footprints_there_is_no_map(tmp_path):
    assert ground_map(tmp_path, ROWS, [], 10**5) is None
