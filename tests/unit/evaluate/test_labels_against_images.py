"""Tiles of a city held against their images: tables and figures."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from stereotruth.evaluate import labels_against_images

from ...synthetic.pictures import colours_in, read_picture
from ...synthetic.tiled_scene import make_scene, rough, rows_of, run


@pytest.mark.slow
def test_evaluation_of_a_city(tmp_path: Path) -> None:
    scene = make_scene(tmp_path / "s1", bare_from=240, texture=rough)
    out, matches = tmp_path / "Town", tmp_path / "matches.csv"
    run([scene], out, size=96, matches=matches)
    files = {name: tmp_path / f"{name}.csv" for name in ("table4", "sift", "warping")}
    files |= {f"{name}_figure": tmp_path / f"{name}.png" for name in ("sift", "warping")}
    stores = {"s1": (scene.left, scene.right, scene.disparity)}
    table = labels_against_images.evaluate_city("Town", out, matches, stores, **files)

    def read(name: str) -> list[dict[str, str]]:
        with files[name].open(newline="") as stream:
            return list(csv.DictReader(stream))

    assert [row["city"] for row in read("table4")] == [row["city"] for row in table]
    tiles = [row for row in rows_of(out) if row["complete"] == "yes"]
    assert sum(row["pair_number"] for row in table) == len(tiles)
    found = sum(int(tile["sift_matches"]) for tile in tiles)
    assert sum(row["matches_number"] for row in table) == found
    for row in table:
        kind = row["city"].removeprefix("Town (").rstrip(")")
        mine = [float(t["sift_mean_absolute_error_px"]) for t in tiles if t["class"] == kind]
        mean = row["mean_of_mean_absolute_disparity_errors_px"]
        assert mean == pytest.approx(np.mean(mine), abs=2e-4)
    by_scope = {(row["scope"], row["name"]): row for row in read("sift")}
    assert by_scope["city", "Town"]["matches"] == by_scope["scene", "s1"]["matches"]
    for tile in tiles:
        row = by_scope["tile", tile["tile"]]
        assert row["matches"] == tile["sift_matches"]
        mean = float(tile["sift_mean_error_px"])
        assert float(row["mean_error_px"]) == pytest.approx(mean, abs=2e-4)
    warped = {(row["scope"], row["name"]): row for row in read("warping")}
    assert float(warped["city", "Town"]["correlation"]) > 0.999
    assert warped["scene", "s1"]["pixels"] == warped["city", "Town"]["pixels"]
    assert 0.3 < float(warped["scene", "s1"]["labelled_share"]) < 0.8
    sift = read_picture(files["sift_figure"])
    red, _, blue = np.moveaxis(sift[: sift.shape[0] // 2].astype(int), 2, 0)
    kinds = {tile["class"] for tile in tiles}
    curves = {"building": blue - red > 40, "vegetation": red - blue > 40}
    for kind, curve in curves.items():
        assert (curve.mean() > 1e-3) == (kind in kinds)
    warping = read_picture(files["warping_figure"])
    middle = warping[len(warping) // 2 - 90 : len(warping) // 2 + 90]
    for part in np.split(middle[:, : warping.shape[1] // 5 * 5], 5, axis=1):
        assert part.std() > 30
    assert colours_in(warping[:, :150]) == 0 and colours_in(warping) > 0.05  # grey at the left


def test_a_line_of_table_4_by_hand():
    tiles = [np.array([0.1, -0.3, 0.2, 8.2]), np.array([-1.0]), np.array([])]
    row = labels_against_images.table4_row("Town (building)", tiles)
    assert (row["pair_number"], row["matches_number"]) == (2, 5)
    assert row["mean_of_mean_disparity_errors_px"] == pytest.approx((2.05 - 1.0) / 2)
    assert row["mean_of_mean_absolute_disparity_errors_px"] == pytest.approx((2.2 + 1.0) / 2)
    assert row["gross_mismatches_share"] == pytest.approx(0.2)
    assert row["without_gross_mean_of_mean_absolute_disparity_errors_px"] == pytest.approx(0.6)
    empty = labels_against_images.table4_row("Town (vegetation)", [np.array([])])
    assert (empty["pair_number"], empty["mean_of_mean_disparity_errors_px"]) == (0, "")
