from __future__ import annotations

import csv
import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import rasterio
import zarr
from rasterio.errors import NotGeoreferencedWarning

from stereotruth import grid_store
from stereotruth.epipolar import EpipolarModel, fit_epipolar
from stereotruth.errors import InputError
from stereotruth.evaluation import checkpoints, truth, warping
from stereotruth.evaluation.statistics import ErrorSum, median_and_nmad
from stereotruth.rpc import SensorModel

from .test_alignment import LAT, LON, linear_rpc

SIZE = {"left": (420, 380), "right": (380, 420)}
ROOF = (slice(150, 230), slice(180, 290))  # raw rows, cols
GROUND, ROOF_CLASS, WATER = 1, 2, 5


class Scene(NamedTuple):
    model: EpipolarModel
    truth: Path
    folder: Path


def sensor(view: str, shift: tuple[float, float] = (0.0, 0.0)) -> SensorModel:
    gsd, angle = {"left": (0.65, -5.0), "right": (0.80, 26.0)}[view]
    affine = np.column_stack([np.eye(2), shift])
    return SensorModel(linear_rpc(gsd, angle, SIZE[view]), affine)


def surface_height(col, row):
    """Height in m as a function of the raw left position: a slope with a roof on it."""
    return 60.0 + 0.05 * col - 0.03 * row + 0.0001 * row * col


def on_roof(col, row):
    r, c = ROOF
    return (
        (row >= r.start - 0.5)
        & (row < r.stop - 0.5)
        & (col >= c.start - 0.5)
        & (col < c.stop - 0.5)
    )


def ground_at(left: SensorModel, col, row):
    height = surface_height(col, row) + np.where(on_roof(col, row), 20.0, 0.0)
    return (*left.localize(col, row, height), height)


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    folder = tmp_path_factory.mktemp("scene")
    left, right = sensor("left"), sensor("right")
    model = fit_epipolar(left, right, SIZE["left"], SIZE["right"], 65.0)
    cols, rows = SIZE["left"]
    row, col = np.mgrid[0:rows, 0:cols].astype(float)
    lon, lat, height = ground_at(left, col, row)
    right_col, right_row = right.project(lon, lat, height)
    surface = np.where(on_roof(col, row), ROOF_CLASS, GROUND).astype("uint8")
    surface[300:330, 60:120] = WATER
    surface[0:20, 0:30] = 0
    visible = (
        (np.abs(right_col - 189.5) <= 190) & (np.abs(right_row - 209.5) <= 210) & (surface > 0)
    )
    visible[230:250, 180:290] = False  # behind the roof
    changed, covered = np.zeros_like(surface), np.ones_like(surface)
    changed[60:90, 60:90] = 1
    covered[:, 340:] = 0
    for array in (lon, lat, height, right_col, right_row):
        array[surface == 0] = np.nan
    layers = {
        "lon": lon,
        "lat": lat,
        "height": height,
        "right_col": right_col,
        "right_row": right_row,
        "visible_right": visible.astype("uint8"),
        "surface": surface,
        "changed": changed,
        "covered": covered,
    }
    with grid_store.building(folder / "truth.zarr") as scratch:
        group = zarr.open_group(scratch, mode="w", zarr_format=3)
        for name, values in layers.items():
            group.create_array(name, data=values, chunks=(100, 100))
    return Scene(model, folder / "truth.zarr", folder)


def perfect_labels(scene: Scene, model: EpipolarModel | None = None) -> np.ndarray:
    """The disparity at every epipolar pixel's centre, by the analytic surface."""
    model = model or scene.model
    y, x = np.mgrid[0 : model.shape[0], 0 : model.shape[1]].astype(float)
    col, row = scene.model.epipolar_to_left(x, y)
    lon, lat, height = ground_at(scene.model.left, col, row)
    found = model.ground_to_epipolar(lon, lat, height)
    labels = (found[0] - found[2]).reshape(x.shape)
    labels[(col < -0.5) | (col > 419.5) | (row < -0.5) | (row > 379.5)] = np.nan
    return labels


def write_disparity(scene: Scene, path: Path, labels: np.ndarray) -> Path:
    layer = grid_store.Layer("float32", np.nan, {"units": "px", "long_name": "disparity"})
    with grid_store.building(path) as scratch:
        arrays = grid_store.create_grid(
            scratch,
            scene.model.shape,
            {"disparity": layer},
            chunk=128,
            shard=256,
            attrs={"epipolar": scene.model.to_dict()},
        )
        arrays["disparity"][:] = labels.astype("float32")
    return path


# --------------------------------------------------------------------------------- statistics


def test_error_sum_agrees_with_numpy():
    rng = np.random.default_rng(1)
    errors = np.concatenate([rng.normal(0.05, 0.3, 20001), rng.uniform(-40, 40, 300)])
    total, part = ErrorSum(), ErrorSum()
    total.add(errors[:7000])
    part.add(errors[7000:])
    total.merge(part)
    figures = total.figures()
    assert figures["count"] == errors.size
    assert figures["mean_absolute"] == pytest.approx(np.abs(errors).mean(), abs=1e-6)
    assert figures["rms"] == pytest.approx(np.sqrt((errors**2).mean()), abs=1e-6)
    assert figures["bias"] == pytest.approx(errors.mean(), abs=1e-6)
    assert figures["max"] == pytest.approx(np.abs(errors).max(), abs=1e-6)
    assert figures["median"] == pytest.approx(np.median(errors), abs=0.0021)
    assert figures["median_absolute"] == pytest.approx(np.median(np.abs(errors)), abs=0.0021)
    assert figures["share_over_1_px"] == pytest.approx((np.abs(errors) > 1).mean(), abs=1e-6)
    assert ErrorSum().figures()["mean_absolute"] is None


def test_nmad_of_a_normal_distribution_is_its_deviation():
    errors = np.random.default_rng(2).normal(0.3, 0.5, 40000)
    assert median_and_nmad(errors) == pytest.approx((0.3, 0.5), abs=0.02)


# -------------------------------------------------------------------------------------- truth


def test_perfect_labels_have_no_error(scene):
    labels = perfect_labels(scene)
    true = truth.true_labels(
        scene.model,
        truth.open_truth(scene.truth),
        slice(0, labels.shape[0]),
        slice(0, labels.shape[1]),
    )
    errors = (labels - true.disparity)[true.smooth]
    assert errors.size > 100_000
    assert np.abs(errors).max() < 1e-4  # of bilinear interpolation on the curved slope
    edge = np.isfinite(true.disparity) & np.isfinite(labels) & ~true.smooth
    # The nearest raw pixel is half a pixel away at most, on a slope of 0.02 px per px.
    assert np.abs((labels - true.disparity)[edge]).max() < 0.05
    assert np.nanmax(np.abs(true.y_parallax)) < 1e-3
    either = truth.compare(labels, true).either.figures()
    assert either["max"] < 0.05
    assert not true.visible[true.surface == 0].any()
    assert not (true.visible & true.hidden).any()


def test_errors_are_those_of_the_alignment(scene):
    """Labels by a right sensor that is off by (0.3, -0.4) px: parallax runs along raw rows."""
    off = sensor("right", (0.3, -0.4))
    wrong = replace(scene.model, right=off)
    labels = perfect_labels(scene, wrong)
    true = truth.true_labels(
        scene.model,
        truth.open_truth(scene.truth),
        slice(0, labels.shape[0]),
        slice(0, labels.shape[1]),
    )
    at = np.array([189.0, 209.0])
    before = np.array(scene.model.right_to_epipolar(*at))
    moved = np.array(scene.model.right_to_epipolar(*(at + np.array([0.3, -0.4])))) - before
    errors = (labels - true.disparity)[true.smooth]
    assert np.median(errors) == pytest.approx(-moved[0], abs=0.003)
    disparity, parallax = truth.geometry_errors(wrong, scene.truth, step=5)
    assert disparity.figures()["bias"] == pytest.approx(-moved[0], abs=0.003)
    assert parallax.figures()["rms"] < 1e-3  # measured in the images, whatever the sensor says
    disparity, parallax = truth.geometry_errors(scene.model, scene.truth, step=5)
    assert disparity.figures()["max"] < 1e-6
    assert disparity.count > 4000


def test_counts_are_those_of_a_plain_loop(scene, tmp_path, monkeypatch):
    rng = np.random.default_rng(4)
    labels = perfect_labels(scene) + rng.normal(0, 0.8, scene.model.shape)
    labels[rng.random(labels.shape) < 0.4] = np.nan
    store = write_disparity(scene, tmp_path / "disparity.zarr", labels)
    labels = labels.astype("float32")
    t = {n: a[:] for n, a in zarr.open_group(scene.truth, mode="r").arrays()}
    keys = (
        "visible",
        "visible labelled",
        "hidden",
        "hidden labelled",
        "changed",
        "changed labelled",
    )
    expected, errors = dict.fromkeys(keys, 0), 0
    for y in range(0, labels.shape[0]):
        col, row = scene.model.epipolar_to_left(np.arange(labels.shape[1]), y)
        for x in range(labels.shape[1]):
            r, c = round(float(row[x])), round(float(col[x]))
            if not (0 <= r < 380 and 0 <= c < 420) or not t["surface"][r, c]:
                continue
            labelled = bool(np.isfinite(labels[y, x]))
            errors += labelled and bool(t["visible_right"][r, c]) and not t["changed"][r, c]
            if not t["covered"][r, c]:
                continue
            if t["changed"][r, c]:
                kind = "changed"
            elif t["surface"][r, c] == WATER:
                continue
            elif t["visible_right"][r, c]:
                kind = "visible"
            elif (
                abs(t["right_col"][r, c] - 189.5) <= 190
                and abs(t["right_row"][r, c] - 209.5) <= 210
            ):
                kind = "hidden"
            else:
                continue
            expected[kind] += 1
            expected[kind + " labelled"] += labelled
    assert min(expected.values()) > 300

    for block in (1024, 96):
        monkeypatch.setattr(truth, "BLOCK", block)
        result = truth.compare_scene(store, scene.truth, None, scene="S-1", workers=2)
        for kind in ("visible", "hidden", "changed"):
            assert result.whole.pixels[kind] == expected[kind]
            assert result.whole.labelled[kind] == expected[kind + " labelled"]
        assert result.whole.errors.count == errors
        assert result.surfaces.keys() == {"ground", "roof", "water"}
        assert sum(c.errors.count for c in result.surfaces.values()) == errors
        assert result.whole.errors.figures()["mean_absolute"] == pytest.approx(0.638, abs=0.01)


def write_tile(folder: Path, scene: Scene, labels: np.ndarray) -> None:
    size, row0, col0, offset = 128, 100, 120, 7
    part = labels[row0 : row0 + size, col0 : col0 + size] - offset
    (folder / "disp").mkdir(parents=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(
            folder / "disp/T_disparity_1.tiff",
            "w",
            driver="GTiff",
            width=size,
            height=size,
            count=1,
            dtype="float32",
            nodata=-999,
        ) as dataset:
            dataset.write(np.where(np.isfinite(part), part, -999).astype("float32"), 1)
    rows = [
        {
            "tile": "T_1",
            "scene": scene_id,
            "row0": row0,
            "col0": col0,
            "size": size,
            "right_offset_px": offset,
            "complete": complete,
            "disp": "disp/T_disparity_1.tiff",
        }
        for scene_id, complete in (("S-1", "yes"), ("S-1", "no"), ("S-2", "yes"))
    ]
    with (folder / "manifest.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def test_rule_writes_figures_of_scene_and_tiles(scene, tmp_path):
    labels = perfect_labels(scene)
    labels[:, 200:210] = np.nan
    store = write_disparity(scene, tmp_path / "disparity.zarr", labels)
    write_tile(tmp_path / "tiles", scene, labels)
    files = tmp_path / "out" / "truth.json", tmp_path / "out" / "truth.csv"
    truth.evaluate_truth(store, scene.truth, tmp_path / "tiles", *files, scene="S-1", workers=2)
    figures = json.loads(files[0].read_text())
    assert figures["whole_scene"]["errors"]["mean_absolute"] < 1e-3
    assert figures["exported_tiles"]["pixels"]["labels"] == 128 * 118
    assert figures["exported_tiles"]["errors"]["max"] < 0.05
    assert list(figures["tiles"]) == ["T_1"]
    table = list(csv.DictReader(files[1].open()))
    assert [row["scope"] for row in table] == [
        "scene",
        "surface ground",
        "surface roof",
        "surface water",
        "tiles",
        "tile T_1",
    ]
    assert sorted(p.name for p in files[0].parent.iterdir()) == ["truth.csv", "truth.json"]


def test_missing_stores_are_refused(scene, tmp_path):
    store = write_disparity(scene, tmp_path / "disparity.zarr", perfect_labels(scene))
    with pytest.raises(InputError, match="no such Zarr store"):
        truth.compare_scene(store, tmp_path / "none.zarr", None, scene="S-1")
    with pytest.raises(InputError, match="no truth store"):
        truth.compare_scene(store, store, None, scene="S-1")
    with pytest.raises(InputError, match="no manifest"):
        truth.compare_scene(store, scene.truth, tmp_path, scene="S-1")


# ------------------------------------------------------------------------------- check points


def test_labels_are_sampled_bilinearly_and_not_across_edges():
    y, x = np.mgrid[0:40, 0:50].astype(float)
    grid = 0.1 * x - 0.07 * y
    grid[:, 30:] += 12.0
    grid[20:, :10] = np.nan
    px = np.array([3.25, 29.4, 29.6, 5.0, 5.0, 5.0, -0.4, 49.4, 60.0])
    py = np.array([7.75, 11.0, 11.0, 19.3, 19.6, 25.0, 0.0, 39.4, 1.0])
    got, inner = checkpoints.sample_labels(grid, px, py)
    assert np.flatnonzero(inner).tolist() == [0, 6, 7]
    smooth = 0.1 * px - 0.07 * py
    assert got[0] == pytest.approx(smooth[0])
    assert got[1] == pytest.approx(0.1 * 29 - 0.77)
    assert got[2] == pytest.approx(0.1 * 30 - 0.77 + 12)
    assert got[3] == pytest.approx(0.1 * 5 - 0.07 * 19)  # the labelled neighbour, the nearest
    assert np.isnan(got[[4, 5, 8]]).all()  # the nearest is not labelled, or there is none
    assert got[6] == pytest.approx(0.0)
    assert got[7] == pytest.approx(0.1 * 49 - 0.07 * 39 + 12)


def test_check_points_of_perfect_labels(scene, tmp_path):
    store = write_disparity(scene, tmp_path / "disparity.zarr", perfect_labels(scene))
    rng = np.random.default_rng(6)
    col, row = rng.uniform(20, 330, 200), rng.uniform(30, 140, 200)
    lon, lat, height = ground_at(scene.model.left, col, row)
    right_col, right_row = scene.model.right.project(lon, lat, height)
    lines = ["id,lon,lat,height,left_col,left_row,right_col,right_row"]
    for k in range(200):
        values = (lon[k], lat[k], height[k], col[k], row[k], right_col[k] + 0.2, right_row[k] - 0.1)
        lines.append(f"C{k:03d}," + ",".join(f"{v:.10f}" for v in values))
    lines.append(f"C900,{LON},{LAT},60,100,100,,")
    (tmp_path / "c.csv").write_text("\n".join(lines))
    figures = checkpoints.evaluate_checkpoints(store, tmp_path / "c.csv", scene="S-1")
    before = np.array(scene.model.right_to_epipolar(189.0, 209.0))
    moved = np.array(scene.model.right_to_epipolar(189.2, 208.9)) - before
    assert figures["points"] == figures["labelled"] == 200
    assert figures["median"] == pytest.approx(moved[0], abs=0.003)
    assert figures["nmad"] < 0.003
    assert figures["inner"]["count"] > 150
    assert figures["y_parallax_median"] == pytest.approx(moved[1], abs=0.003)


# ------------------------------------------------------------------------------------ warping


def texture(x, y):
    return 1000 + 200 * np.sin(x / 5.0 + 0.02 * y) + 150 * np.cos(y / 7.0 - x / 11.0)


def test_warping_finds_the_left_image_again(scene, tmp_path):
    shape = scene.model.shape
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    disparity = 3.3 + 0.02 * x
    disparity[:, 50:60] = np.nan
    right_x = x  # right(x_r) = texture at the left position x with x − d(x) = x_r
    right = texture((right_x + 3.3) / 0.98, y)
    layer = grid_store.Layer("uint16", 0, {"units": "DN", "long_name": "image"})
    stores = []
    for name, image in (("left", texture(x, y)), ("right", right)):
        with grid_store.building(tmp_path / f"{name}.zarr") as scratch:
            arrays = grid_store.create_grid(
                scratch, shape, {"image": layer}, chunk=128, shard=256, attrs={}
            )
            arrays["image"][:] = np.rint(image).astype("uint16")
        stores.append(tmp_path / f"{name}.zarr")
    right_way = write_disparity(scene, tmp_path / "d.zarr", disparity)
    figures = warping.evaluate_warping(*stores, right_way)
    assert figures["correlation"] > 0.9999
    assert figures["pixels"] > 0.9 * disparity.size * (shape[1] - 20) / shape[1]
    wrong_way = write_disparity(scene, tmp_path / "e.zarr", -disparity)
    assert warping.evaluate_warping(*stores, wrong_way)["correlation"] < 0.9

    values = np.rint(texture(x, y))[:64, :64]
    tile = warping.WarpedTile(
        "T_1",
        values,
        warping.warp_rows(np.rint(right)[:64], (x - disparity)[:64, :64]),
        disparity[:64, :64],
    )
    assert tile.correlation > 0.9999
    warping.draw_panels(tile, tmp_path / "panels" / "T_1.png")
    assert [p.name for p in (tmp_path / "panels").iterdir()] == ["T_1.png"]


def test_warping_is_exact_on_quadratics_and_skips_nodata():
    x = np.arange(30.0)
    image = np.vstack([2 * x**2 - 3 * x + 500, np.where(x == 12, 0, 700)])
    at = np.vstack([np.linspace(1, 27, 14), np.linspace(5, 20, 14)])
    warped = warping.warp_rows(image, at)
    assert np.allclose(warped[0], 2 * at[0] ** 2 - 3 * at[0] + 500)
    spoilt = (np.floor(at[1]) >= 10) & (np.floor(at[1]) <= 13)
    assert np.array_equal(np.isnan(warped[1]), spoilt)
    assert np.isnan(warping.warp_rows(image, np.array([[0.5, np.nan], [27.5, 40.0]]))).all()
