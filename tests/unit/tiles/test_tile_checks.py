"""Tiles against their images: planted errors are flagged, and the evaluation of a city."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stereotruth.core.config.configuration import Limits
from stereotruth.core.errors import InputError
from stereotruth.evaluate import labels_against_images
from stereotruth.tiles import label_doubts
from stereotruth.tiles.summary import summary_lines
from stereotruth.tiles.verify import defects

from ...synthetic.pictures import colours_in, read_picture
from ...synthetic.tiled_scene import (
    LAT,
    LON,
    METRE_LAT,
    METRE_LON,
    NO_LIMITS,
    make_scene,
    rows_of,
    run,
)

SIZE = 96
LIMITS = Limits(min_warp_correlation=0.9)


def rough(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """A texture that SIFT likes: waves of 3 to 8 m of all directions."""
    east, north = (lon - LON) / METRE_LON, (lat - LAT) / METRE_LAT
    rng = np.random.default_rng(11)
    grey = np.full(lon.shape, 2000.0)
    for _ in range(40):
        angle, length, phase = rng.uniform((0, 3, 0), (np.pi, 8, 2 * np.pi))
        grey += 70 * np.sin(
            2 * np.pi / length * (np.cos(angle) * east + np.sin(angle) * north) + phase
        )
    return grey


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Exported once each: a clean scene, labels 1 px off, right rows 1.5 px off."""
    found = {}
    for name, planted in (
        ("clean", {}),
        ("labels", {"label_offset": 1.0}),
        ("rows", {"row_shift": 1.5}),
    ):
        folder = tmp_path_factory.mktemp(name)
        scene = make_scene(folder / "s1", bare_from=240, texture=rough, **planted)
        alignment = folder / "alignment.json"
        rms = {"left": {"rms": {"after": 0.3}}, "right": {"rms": {"after": 0.4}}}
        alignment.write_text(json.dumps({**rms, "warnings": []}))
        scene = scene._replace(alignment=alignment)
        out, matches = folder / "Town", folder / "matches.csv"
        summary = run([scene], out, size=SIZE, quality=LIMITS, matches=matches, workers=2)
        found[name] = SimpleNamespace(scene=scene, out=out, matches=matches, summary=summary)
    return found


def labelled(folder: Path) -> list[dict[str, str]]:
    return [row for row in rows_of(folder) if row["complete"] == "yes"]


def column(folder: Path, name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in labelled(folder)])


def test_clean_tiles_pass_and_their_figures_are_true(made):
    clean = made["clean"]
    rows = labelled(clean.out)
    assert len(rows) >= 4
    assert {row["quality"] for row in rows} == {"ok"}
    assert column(clean.out, "sift_matches").min() >= 10
    assert np.abs(column(clean.out, "sift_median_error_px")).max() < 0.1
    assert np.abs(column(clean.out, "y_parallax_median_px")).max() < 0.1
    assert column(clean.out, "warp_correlation").min() > 0.99
    quality = clean.summary["quality"]
    assert quality["flagged_tiles"] == {}
    assert quality["scenes"]["s1"]["quality"] == "ok"
    assert quality["scenes"]["s1"]["gcp_rms_px"] == 0.4
    assert any("within the limits" in line for line in summary_lines(clean.summary, "out"))
    assert {row["quality"] for row in rows_of(clean.out) if row["complete"] == "no"} == {""}
    assert defects(clean.out) == []


def test_labels_that_are_off_are_flagged(made):
    wrong = made["labels"]
    assert column(wrong.out, "sift_median_error_px") == pytest.approx(-1.0, abs=0.1)
    assert all("max_sift_error_px" in row["quality"] for row in labelled(wrong.out))
    assert not any("max_y_parallax_px" in row["quality"] for row in labelled(wrong.out))
    assert "max_sift_error_px" in wrong.summary["quality"]["scenes"]["s1"]["quality"]
    assert any("TN_0 (max_sift_error_px" in line for line in summary_lines(wrong.summary, "out"))


@pytest.mark.parametrize("planted", [0.0, 0.15])
def test_a_small_bias_is_a_doubt_that_names_its_amount(tmp_path, monkeypatch, caplog, planted):
    monkeypatch.setattr(label_doubts, "CELL_PX", 48)  # a scene so small has few of the usual size
    scene = make_scene(tmp_path / "s1", texture=rough, label_offset=-planted)
    summary = run([scene], tmp_path / "Town", size=SIZE, quality=LIMITS)
    lines, quality = summary_lines(summary, "out"), summary["quality"]
    ground = quality["surfaces"]["s1"]["open_ground"]
    assert ground["bias_px"] == pytest.approx(planted, abs=0.03)
    assert ground["standard_error_px"] < 0.03
    told = [row["doubt"] for row in labelled(tmp_path / "Town")]
    assert column(tmp_path / "Town", "sift_median_error_px").max() < 0.3  # no limit in px is missed
    assert any("All labelled pairs are within" in line for line in lines) == (not planted)
    if not planted:
        assert (quality["doubts"], set(told)) == ({}, {""})
        return
    text = quality["doubts"]["s1"][0]["text"]
    assert text.startswith("images say +0.1")
    assert lines[-2] == f"Doubt about s1: {text}"
    assert set(told) == {text}
    assert text in caplog.text
    assert quality["scenes"]["s1"]["quality"] == "min_agreement"


def test_what_the_alignment_doubts_stands_at_the_end(made, tmp_path):
    """In the last lines, the summary and the manifest; and nothing says then that all is well."""
    rms = {view: {"rms": {"after": None}} for view in ("left", "right")}
    alignment = tmp_path / "alignment.json"
    alignment.write_text(json.dumps({**rms, "warnings": ["RPCs may belong to other pixels"]}))
    scene = made["clean"].scene._replace(alignment=alignment)
    summary = run([scene], tmp_path / "Town", size=SIZE, quality=LIMITS, strict=False)
    lines = summary_lines(summary, "out")
    assert lines[-2] == "Doubt about s1: RPCs may belong to other pixels"
    assert not any("within the limits" in line for line in lines)
    assert summary["quality"]["doubts"]["s1"][0]["of"] == "alignment"
    assert {row["doubt"] for row in labelled(tmp_path / "Town")} == {
        "RPCs may belong to other pixels"
    }


def test_rows_that_are_off_are_flagged(made):
    wrong = made["rows"]
    rows = labelled(wrong.out)
    assert column(wrong.out, "y_parallax_median_px") == pytest.approx(1.5, abs=0.1)
    assert all(row["quality"].startswith("max_y_parallax_px;min_sift_matches") for row in rows)


@pytest.mark.slow
def test_a_strict_run_ends_with_scene_tile_gate_value_and_limit(made, tmp_path):
    settings = {"size": SIZE, "quality": LIMITS, "strict": True}
    with pytest.raises(InputError) as caught:
        run([made["labels"].scene], tmp_path / "T", **settings)
    text = str(caught.value)
    for word in ("scene s1", "tile TN_0", "sift_median_error_px -1", "max_sift_error_px 0.5"):
        assert word in text
    strict = NO_LIMITS.model_copy(update={"max_gcp_rms_px": 0.1})
    with pytest.raises(InputError, match=r"gcp_rms_px 0\.4 is above max_gcp_rms_px 0\.1"):
        run([made["clean"].scene], tmp_path / "T", size=SIZE, quality=strict, strict=True)
    assert not (tmp_path / "T").exists()


def test_same_figures_and_matches_with_any_number_of_workers(made, tmp_path):
    clean = made["clean"]
    out, matches = tmp_path / "Town", tmp_path / "matches.csv"
    run([clean.scene], out, size=SIZE, quality=LIMITS, strict=True, matches=matches, workers=1)
    assert matches.read_bytes() == clean.matches.read_bytes()
    assert (out / "manifest.csv").read_bytes() == (clean.out / "manifest.csv").read_bytes()


@pytest.mark.slow
def test_evaluation_of_a_city(made, tmp_path):
    clean = made["clean"]
    scene = clean.scene
    files = {name: tmp_path / f"{name}.csv" for name in ("table4", "sift", "warping")}
    files |= {f"{name}_figure": tmp_path / f"{name}.png" for name in ("sift", "warping")}
    stores = {"s1": (scene.left, scene.right, scene.disparity)}
    table = labels_against_images.evaluate_city("Town", clean.out, clean.matches, stores, **files)

    def read(name: str) -> list[dict[str, str]]:
        with files[name].open(newline="") as stream:
            return list(csv.DictReader(stream))

    assert [row["city"] for row in read("table4")] == [row["city"] for row in table]
    tiles = labelled(clean.out)
    assert sum(row["pair_number"] for row in table) == len(tiles)
    assert sum(row["matches_number"] for row in table) == column(clean.out, "sift_matches").sum()
    for row in table:
        kind = row["city"].removeprefix("Town (").rstrip(")")
        mine = [float(t["sift_mean_absolute_error_px"]) for t in tiles if t["class"] == kind]
        found = row["mean_of_mean_absolute_disparity_errors_px"]
        assert found == pytest.approx(np.mean(mine), abs=2e-4)
    by_scope = {(row["scope"], row["name"]): row for row in read("sift")}
    assert by_scope["city", "Town"]["matches"] == by_scope["scene", "s1"]["matches"]
    for tile in tiles:
        row = by_scope["tile", tile["tile"]]
        assert row["matches"] == tile["sift_matches"]
        assert float(row["mean_error_px"]) == pytest.approx(
            float(tile["sift_mean_error_px"]), abs=2e-4
        )
    warped = {(row["scope"], row["name"]): row for row in read("warping")}
    assert float(warped["city", "Town"]["correlation"]) > 0.999
    assert warped["scene", "s1"]["pixels"] == warped["city", "Town"]["pixels"]
    assert 0.3 < float(warped["scene", "s1"]["labelled_share"]) < 0.8
    sift = read_picture(files["sift_figure"])
    assert sift.shape[:2] == pytest.approx((2 * 4.2 * 110, 13.0 * 110), rel=0.1)
    red, _, blue = np.moveaxis(sift[: sift.shape[0] // 2].astype(int), 2, 0)
    kinds = {tile["class"] for tile in tiles}
    curves = {"building": blue - red > 40, "vegetation": red - blue > 40}
    for kind, curve in curves.items():
        assert (curve.mean() > 1e-3) == (kind in kinds)
    assert colours_in(sift[sift.shape[0] // 2 :]) > 1e-3  # maps and their colour bars
    warping = read_picture(files["warping_figure"])
    assert warping.shape[:2] == pytest.approx((3 * 3.7 * 90, 16.0 * 90), rel=0.1)
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
