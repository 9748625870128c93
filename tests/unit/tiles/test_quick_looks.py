"""Footprints and quick looks as a GIS reads them."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.features import rasterize
from rasterio.transform import from_bounds

from stereotruth.tiles.manifest import STYLE
from stereotruth.tiles.orientation import evaluate
from stereotruth.tiles.quick_looks import (
    SPLIT_COLOURS,
    draw_contact_sheet,
    read_footprints,
    write_ground_looks,
)
from stereotruth.tiles.scene_stores import open_stores

from ...synthetic.images import write
from ...synthetic.other_programs import PROGRAMS
from ...synthetic.tiled_scene import labels, make_scene, rows_of, terrain, texture


def test_a_footprint_holds_the_ground_of_its_labels(exported: tuple[Path, dict]) -> None:
    """By the way back that the tile's orientation file gives."""
    folder, _ = exported
    found, rows = read_footprints(folder), rows_of(folder)
    assert list(found) == [row["tile"] for row in rows]
    for row in rows[::4]:
        said, ring = found[row["tile"]]["properties"], found[row["tile"]]["geometry"]
        x, y = np.array(ring["coordinates"][0]).T
        assert np.sum(x[:-1] * y[1:] - y[:-1] * x[1:]) > 0  # counter-clockwise, as RFC 7946 asks
        for name in ("tile", "city", "split", "complete", "quality", "left", "disp"):
            assert (said[name] or "") == row[name]
        assert said["labelled_share"] == float(row["labelled_share"])
        if row["complete"] != "yes":
            continue
        record = json.loads((folder / row["orientation"]).read_text())
        y, x = np.nonzero(np.isfinite(d := labels(folder / row["disp"])))
        ground = evaluate(record["ground"], x, y, d[y, x])
        ring = np.array(found[row["tile"]]["geometry"]["coordinates"][0])
        bounds = *ring.min(axis=0), *ring.max(axis=0)
        shape = (256, 256)
        to_map = from_bounds(*bounds, *shape)
        inside = rasterize([found[row["tile"]]["geometry"]], shape, transform=to_map)
        col, line = ~to_map * (ground["lon"], ground["lat"])
        at = np.clip(np.floor([line, col]).astype(int), 0, 255)
        # labels lie higher and lower than the border's: some px at the border stick out
        assert inside[tuple(at)].mean() > 0.97
        # and there is no more of it than of ground: a pixel of a label is 1 / SIZE² of the tile
        assert len(set(zip(*(at // 8)))) > 0.9 * inside[::8, ::8].sum()


def test_the_style_draws_each_split_in_its_colour(exported: tuple[Path, dict]) -> None:
    tree = ElementTree.parse(exported[0] / STYLE).getroot()
    rules = {rule.get("label"): rule for rule in tree.iter("rule")}
    symbols = {symbol.get("name"): symbol for symbol in tree.iter("symbol")}
    assert set(SPLIT_COLOURS) < set(rules)
    assert {rule.get("symbol") for rule in rules.values()} == set(symbols)
    for split, colour in SPLIT_COLOURS.items():
        assert f"\"split\" = '{split}'" in rules[split].get("filter")
        options = {
            o.get("name"): o.get("value")
            for o in symbols[rules[split].get("symbol")].iter("Option")
        }
        assert options["outline_color"].split(",")[:3] == [
            str(v) for v in bytes.fromhex(colour[1:])
        ]


# ------------------------------------------------------------------ on a map


@pytest.mark.parametrize("size", [100, 288, 576])
def test_a_contact_sheet_is_drawn_of_tiles_of_any_size(tmp_path, size) -> None:
    for kind, dtype in (("left", "uint16"), ("right", "uint16"), ("disp", "float32")):
        write(tmp_path / f"{kind}.tif", np.arange(size * size, dtype=dtype).reshape(size, size))
    row = {"tile": "a", "complete": "yes", "size": size}
    rows = [row | {kind: f"{kind}.tif" for kind in ("left", "right", "disp")}]
    draw_contact_sheet(tmp_path / "sheet.png", "A", rows, tmp_path, -999.0)
    assert (tmp_path / "sheet.png").stat().st_size > 10_000


def test_a_quick_look_shows_what_is_there(tmp_path) -> None:
    """The texture of the ground is known: a metre off would leave a correlation of 0.9."""
    scene = make_scene(tmp_path / "s1", colour=True)
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
