"""Tiles of a small scene with analytic cameras, terrain and texture; size 64."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
import zarr

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import seal
from stereotruth.tiles.quick_looks import SPLIT_COLOURS
from stereotruth.tiles.scene_stores import SceneFiles
from stereotruth.tiles.splits import shared_ground
from stereotruth.tiles.tile_checks import summary_lines

from ...synthetic.pictures import colours_in, read_picture, share_of
from ...synthetic.tiled_scene import SIZE, alignment_notes, labels, make_scene, read, rows_of, run

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_folder_is_as_the_contract_says(exported: tuple[Path, dict]) -> None:
    folder, summary = exported
    rows = rows_of(folder)
    assert summary["labelled_pairs"] >= 12 and summary["unlabelled_pairs"] >= 4
    assert [int(row["number"]) for row in rows] == list(range(len(rows)))
    for row in rows:
        n, complete = row["number"], row["complete"] == "yes"
        group = "" if complete else "unlabelled/"
        assert row["left"] == f"{group}left/TN_left_{n}.tiff"
        assert row["right"] == f"{group}right/TN_right_{n}.tiff"
        assert row["disp"] == (f"disp/TN_disparity_{n}.tiff" if complete else "")
        assert row["status"] == (f"status/TN_status_{n}.tiff" if complete else "")
        assert row["orientation"] == f"orientation/TN_{n}.json"
        assert (row["split"] == "none") != complete
        with rasterio.open(folder / row["left"]) as left:
            assert (left.dtypes, left.shape, left.nodata) == (("uint16",), (SIZE, SIZE), 0)
            assert left.read(1).min() > 0
        share = float(row["labelled_share"])
        assert (share >= 0.6) == complete
        assert int(row["count_labelled"]) == round(share * SIZE**2)
        assert (row["quality"] == "ok") == (row["warp_correlation"] != "") == complete
        if complete:
            assert float(row["warp_correlation"]) > 0.999
            disparity = labels(folder / row["disp"])
            assert np.isfinite(disparity).mean() == pytest.approx(share, abs=1e-6)
            assert float(row["disparity_mean_px"]) == pytest.approx(np.nanmean(disparity), abs=1e-3)
            assert abs(np.nanmean(disparity)) < 0.51  # less than the offset's rounding
            assert np.array_equal(np.isfinite(disparity), read(folder / row["status"]) == 1)
    coverage = read_picture(folder.parent / "coverage.png")
    assert (coverage[0, 0] == 255).all()
    blue = coverage[..., 2].astype(int) - coverage[..., 0] > 20
    assert 0.05 < blue.mean() < 0.8  # labelled ground; bare from row 240 on
    for split in ("train", "val", "test"):
        assert share_of(coverage, SPLIT_COLOURS[split]) > 1e-4
    contact = read_picture(folder.parent / "contact.png")
    assert contact.shape[1] == pytest.approx(13.0 * 110, rel=0.1)
    assert contact.shape[0] > 2.2 * 110 * summary["labelled_pairs"] / 2 * 0.8
    assert 0.05 < colours_in(contact) < 0.5  # a third of it shows disparities
    assert not list(folder.parent.glob("*.partial"))
    assert any("labelled pairs" in line for line in summary_lines(summary, folder))


@pytest.mark.parametrize("right_offset", ["tile", "scene"])
def test_offset_is_whole_and_of_tile_or_scene(
    scene: SceneFiles, tmp_path: Path, right_offset: str
) -> None:
    run([scene], tmp_path / "T", right_offset=right_offset)
    rows = [row for row in rows_of(tmp_path / "T") if row["complete"] == "yes"]
    offsets = {int(row["right_offset_px"]) for row in rows}
    assert (len(offsets) == 1) == (right_offset == "scene")
    # Per tile and per scene, the scene's own disparity is the same.
    row = rows[0]
    with rasterio.open(tmp_path / "T" / row["disp"]) as dataset:
        assert dataset.nodata == -999 and dataset.dtypes == ("float32",)
    window = np.s_[int(row["row0"]) :, int(row["col0"]) :]
    original = zarr.open_group(scene.disparity)["disparity"][window][:SIZE, :SIZE]
    back = labels(tmp_path / "T" / row["disp"]) + int(row["right_offset_px"])
    assert np.nanmax(np.abs(back - original)) <= 1 / 2048


@pytest.mark.slow
def test_overlapping_tiles_share_no_ground_across_splits(scene: SceneFiles, tmp_path: Path) -> None:
    summary = run([scene], tmp_path / "T", stride=SIZE * 3 // 4)
    assert summary["splits"]["realised"]["none"] > 0
    assert all(summary["splits"]["realised"][s] > 0 for s in ("train", "val", "test"))
    assert shared_ground(tmp_path / "T" / "manifest.csv") == []
    with pytest.raises(InputError, match="share ground"):
        run([scene], tmp_path / "S", stride=SIZE * 3 // 4, strict=True)
    assert not (tmp_path / "S").exists()


@pytest.mark.slow
def test_two_scenes_of_one_city(scene: SceneFiles, tmp_path: Path) -> None:
    """A second pair over the same ground: its tiles count on, and share no ground across splits."""
    other = make_scene(tmp_path / "s2", turn=0.3)
    summary = run([scene, other], tmp_path / "T", workers=2)
    rows = rows_of(tmp_path / "T")
    assert {row["scene"] for row in rows} == {"s1", "s2"} == set(summary["scenes"])
    assert len({row["tile"] for row in rows}) == len(rows)
    assert shared_ground(tmp_path / "T" / "manifest.csv") == []
    realised = summary["splits"]["realised"]
    assert sum(realised.values()) == summary["labelled_pairs"] and realised["none"] > 0
    assert all(realised[name] for name in ("train", "val", "test"))


def test_nothing_to_export_is_refused(scene: SceneFiles, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Town: not one labelled .*labels incomplete") as caught:
        run([scene], tmp_path / "T", min_labelled=0.99)
    assert "tiles.min_labelled" in caught.value.remedy
    assert "project.recipe" not in caught.value.remedy
    grid = zarr.open_group(scene.disparity, mode="r+")
    grid.attrs["points_per_px"] = 0.42
    seal(scene.disparity)
    with pytest.raises(InputError, match="not one labelled") as caught:
        run([scene], tmp_path / "T", min_labelled=0.99)
    assert "s1 0.42" in caught.value.remedy and "project.recipe: surface" in caught.value.remedy
    del grid.attrs["points_per_px"]
    seal(scene.disparity)
    refusal = "not refined: the tie points contradict each other (0.61 px, 40 % blunders)"
    notes = alignment_notes(0.2, 0.2, warnings=[refusal])
    with pytest.raises(InputError, match="not one labelled") as caught:
        run([scene._replace(notes=notes)], tmp_path / "T", min_labelled=0.99)
    assert f"alignment of scene s1 is in doubt: {refusal}" in caught.value.problem
    assert caught.value.remedy.startswith("first what the alignment's doubts say")


@pytest.mark.parametrize(
    "settings",
    [
        {"size": 1024},
        {"size": 512, "stride": 511},
        {"nodata": -9999, "disparity_dtype": "float16"},
        {"nodata": 1},  # a true disparity
    ],
)
def test_settings_that_cannot_work_are_refused(scene: SceneFiles, tmp_path: Path, settings) -> None:
    with pytest.raises(InputError):
        run([scene], tmp_path / "T", **settings)
    assert not (tmp_path / "T").exists()
