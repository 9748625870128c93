"""Where tiles lie, as a GIS reads it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from rasterio.features import rasterize
from rasterio.transform import from_bounds

from stereotruth.tiles.footprints import FOOTPRINTS, STYLE, read_footprints
from stereotruth.tiles.polynomials import evaluate
from stereotruth.tiles.quick_looks import SPLIT_COLOURS
from stereotruth.tiles.verify import defects

from ...synthetic.tiled_scene import labels, rows_of


def test_a_footprint_holds_the_ground_of_its_labels(exported: tuple[Path, dict]) -> None:
    """By the way back that the tile's orientation file gives."""
    folder, _ = exported
    found, rows = read_footprints(folder), rows_of(folder)
    assert list(found) == [row["tile"] for row in rows]
    for row in rows[::4]:
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


def test_properties_are_those_of_the_manifest(exported: tuple[Path, dict]) -> None:
    folder, _ = exported
    text = json.loads((folder / FOOTPRINTS).read_text())
    assert text["type"] == "FeatureCollection"
    for one, row in zip(text["features"], rows_of(folder)):
        said, ring = one["properties"], np.array(one["geometry"]["coordinates"][0])
        assert (ring[0] == ring[-1]).all()
        x, y = ring.T
        assert np.sum(x[:-1] * y[1:] - y[:-1] * x[1:]) > 0  # counter-clockwise, as RFC 7946 asks
        for name in ("tile", "city", "scene", "split", "complete", "quality", "left", "class"):
            assert (said[name] or "") == row[name]
        assert said["labelled_share"] == float(row["labelled_share"])
        assert (said["disp"] is None) == (row["complete"] == "no")


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


def test_footprints_that_were_edited_are_found(exported: tuple[Path, dict], tmp_path) -> None:
    folder = tmp_path / "Town"
    shutil.copytree(exported[0], folder)
    assert defects(folder) == []
    (folder / STYLE).write_text("<qgis/>")  # whoever likes other colours
    assert defects(folder) == []
    (folder / FOOTPRINTS).write_text("{}")
    assert defects(folder) == [f"{FOOTPRINTS}: changed"]
    (folder / FOOTPRINTS).unlink()
    assert defects(folder) == [f"{FOOTPRINTS}: missing"]
