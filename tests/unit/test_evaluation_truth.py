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

from stereotruth.dataset import warped_tile
from stereotruth.epipolar import warping
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rpc import SensorModel
from stereotruth.error_statistics import Calibration, ErrorSum, median_and_nmad
from stereotruth.errors import InputError
from stereotruth.evaluation import checkpoints, geometry_errors, labels_against_truth, scene_warping
from stereotruth.products import grids

from .test_alignment import LAT, LON, linear_rpc

SIZE = {"left": (420, 380), "right": (380, 420)}
ROOF = (slice(150, 230), slice(180, 290))  # raw rows, cols
GROUND, ROOF_CLASS, WATER = 1, 2, 5


STATUSES = "no_points labelled hidden_in_left hidden_in_right"


class Scene(NamedTuple):
    model: EpipolarModel
    truth: Path
    raw_truth: Path
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


def write_store(path: Path, layers: dict[str, np.ndarray], **attrs) -> Path:
    with grids.building(path) as scratch:
        group = zarr.open_group(scratch, mode="w", zarr_format=3)
        group.attrs.update(attrs)
        for name, values in layers.items():
            group.create_array(name, data=values, chunks=(100, 100), dimension_names=("y", "x"))
    return path


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Scene:
    folder = tmp_path_factory.mktemp("scene")
    left, right = sensor("left"), sensor("right")
    model = fit_epipolar(left, right, SIZE["left"], SIZE["right"], 65.0)
    row, col = np.mgrid[0:380, 0:420].astype(float)
    lon, lat, height = ground_at(left, col, row)
    right_col, right_row = right.project(lon, lat, height)
    visible = (np.abs(right_col - 189.5) <= 190) & (np.abs(right_row - 209.5) <= 210)
    raw = {"lon": lon, "lat": lat, "height": height, "right_col": right_col}
    raw |= {"right_row": right_row, "visible_right": visible.astype("uint8")}
    write_store(folder / "raw.zarr", raw)

    y, x = np.mgrid[0 : model.shape[0], 0 : model.shape[1]].astype(float)
    col, row = model.epipolar_to_left(x, y)
    shown = (np.abs(col - 209.5) <= 210) & (np.abs(row - 189.5) <= 190)
    lon, lat, height = ground_at(left, col, row)
    right_col, right_row = right.project(lon, lat, height)
    right_x, right_y = model.right_to_epipolar(right_col, right_row)
    surface = np.where(on_roof(col, row), ROOF_CLASS, GROUND)
    surface[300:330, 60:120] = WATER
    surface[~shown] = 0
    behind = np.zeros(shown.shape, bool)
    behind[230:250, 180:290] = True
    inside = (np.abs(right_col - 189.5) <= 190) & (np.abs(right_row - 209.5) <= 210)
    changed, edge, covered = (np.zeros(shown.shape, "uint8") for _ in range(3))
    changed[60:90, 60:90], changed[60:90, 100:120] = 1, 2
    edge[140:160], edge[100:110] = 1, 2
    covered[:, :340] = 1
    changed_right = np.zeros(shown.shape, "uint8")
    changed_right[200:260, 200:240] = 1
    layers = {
        "disparity": np.where(shown, x - right_x, np.nan).astype("float32"),
        "y_parallax": np.where(shown, right_y - y, np.nan).astype("float32"),
        "visible": (shown & inside & ~behind).astype("uint8"),
        "hidden": (shown & inside & behind).astype("uint8"),
        "changed": np.where(shown, changed, 0).astype("uint8"),
        "changed_right": np.where(shown & (changed == 0), changed_right, 0).astype("uint8"),
        "covered": np.where(shown, covered, 0).astype("uint8"),
        "surface": surface.astype("uint8"),
        "edge": edge,
    }
    write_store(folder / "truth.zarr", layers, kind="truth", epipolar=model.to_dict())
    return Scene(model, folder / "truth.zarr", folder / "raw.zarr", folder)


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


def write_disparity(
    scene: Scene, path: Path, labels: np.ndarray, sigma: float = 0.1, lost: int = 0
) -> Path:
    """A disparity store; pixels without a label have the status ``lost``."""
    status = np.where(np.isfinite(labels), 1, lost)
    layers = {
        "disparity": ("float32", np.nan, labels),
        "uncertainty": ("float32", np.nan, np.where(np.isfinite(labels), sigma, np.nan)),
        "status": ("uint8", 0, status),
    }
    attrs = {"units": "px", "long_name": "see the name"}
    flags = {"flag_values": [0, 1, 2, 3], "flag_meanings": STATUSES}
    with grids.building(path) as scratch:
        arrays = grids.create_grid(
            scratch,
            scene.model.shape,
            {n: grids.Layer(d, f, attrs | flags) for n, (d, f, _) in layers.items()},
            chunk=128,
            shard=256,
            attrs={"epipolar": scene.model.to_dict()},
        )
        for name, (dtype, _, values) in layers.items():
            arrays[name][:] = values.astype(dtype)
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
    nmad = median_and_nmad(errors)[1]
    assert figures["nmad"] == pytest.approx(nmad, abs=0.004)
    assert ErrorSum().figures()["mean_absolute"] is None


def test_nmad_of_a_normal_distribution_is_its_deviation():
    errors = np.random.default_rng(2).normal(0.3, 0.5, 40000)
    assert median_and_nmad(errors) == pytest.approx((0.3, 0.5), abs=0.02)


def test_calibration_of_a_normal_distribution_and_of_another_by_decile():
    rng = np.random.default_rng(3)
    sigma = rng.uniform(0.05, 0.5, 200_000)
    calibration, part = Calibration(), Calibration()
    calibration.add(rng.normal(0, sigma[:50_000]), sigma[:50_000])
    part.add(rng.normal(0, sigma[50_000:]), sigma[50_000:])
    calibration.merge(part)
    figures = calibration.figures()
    assert figures["count"] == 200_000
    assert figures["share_below_1"] == pytest.approx(0.6827, abs=0.005)
    assert figures["share_below_2"] == pytest.approx(0.9545, abs=0.003)
    assert figures["mean_uncertainty"] == pytest.approx(0.275, abs=0.002)
    for k, decile in enumerate(figures["deciles"]):
        assert decile["count"] == pytest.approx(20_000, rel=0.1)
        assert decile["mean_uncertainty"] == pytest.approx(0.0725 + 0.045 * k, rel=0.02)
        assert decile["rms_error"] == pytest.approx(decile["mean_uncertainty"], rel=0.04)
        assert decile["share_below_1"] == pytest.approx(0.6827, abs=0.02)
    assert sum(d["count"] for d in figures["deciles"]) == 200_000

    # half of the uncertainties, the small ones, are too small by a factor of two
    wrong = Calibration()
    wrong.add(rng.normal(0, np.where(sigma < 0.275, 2 * sigma, sigma)), sigma)
    deciles = wrong.figures()["deciles"]
    assert deciles[0]["share_below_1"] == pytest.approx(0.3829, abs=0.02)
    assert deciles[0]["share_below_2"] == pytest.approx(0.6827, abs=0.02)
    assert deciles[-1]["share_below_1"] == pytest.approx(0.6827, abs=0.02)
    assert Calibration().figures() == {
        "count": 0, "share_below_1": None, "share_below_2": None, "deciles": []
    }  # fmt: skip


# -------------------------------------------------------------------------------------- truth


def compared(scene: Scene, store: Path, workers: int = 2) -> labels_against_truth.SceneComparison:
    return labels_against_truth.compare_scene(
        store, scene.truth, None, scene="S-1", workers=workers
    )


def test_perfect_labels_have_no_error(scene, tmp_path):
    store = write_disparity(scene, tmp_path / "d.zarr", perfect_labels(scene))
    figures = compared(scene, store).whole.figures()
    assert figures["errors"]["count"] > 60_000
    assert figures["errors"]["max"] < 1e-4
    assert figures["y_parallax"]["max"] < 1e-3
    assert figures["calibration"]["share_below_1"] == 1.0
    assert figures["share_of_visible_labelled"] == 1.0
    assert figures["share_of_hidden_labelled"] == 1.0


def test_errors_are_those_of_the_alignment(scene, tmp_path):
    """Labels by a right sensor that is off by (0.3, -0.4) px: parallax runs along raw rows."""
    off = sensor("right", (0.3, -0.4))
    wrong = replace(scene.model, right=off)
    store = write_disparity(scene, tmp_path / "d.zarr", perfect_labels(scene, wrong))
    at = np.array([189.0, 209.0])
    before = np.array(scene.model.right_to_epipolar(*at))
    moved = np.array(scene.model.right_to_epipolar(*(at + np.array([0.3, -0.4])))) - before
    errors = compared(scene, store).whole.figures()["errors"]
    assert errors["bias"] == pytest.approx(-moved[0], abs=0.003)
    disparity, parallax = geometry_errors.geometry_errors(wrong, scene.raw_truth, step=5)
    assert disparity.figures()["bias"] == pytest.approx(-moved[0], abs=0.003)
    assert parallax.figures()["rms"] < 1e-3  # measured in the images, whatever the sensor says
    disparity, parallax = geometry_errors.geometry_errors(scene.model, scene.raw_truth, step=5)
    assert disparity.figures()["max"] < 1e-6
    assert disparity.count > 4000


def test_counts_are_those_of_a_plain_loop(scene, tmp_path, monkeypatch):
    rng = np.random.default_rng(4)
    labels = perfect_labels(scene) + rng.normal(0, 0.8, scene.model.shape)
    labels[rng.random(labels.shape) < 0.4] = np.nan
    store = write_disparity(scene, tmp_path / "disparity.zarr", labels, sigma=0.8, lost=3)
    labels = labels.astype("float32")
    t = {n: a[:] for n, a in zarr.open_group(scene.truth, mode="r").arrays()}
    groups = ("visible", "hidden", "in_lidar_only", "in_images_only", "visible_lost",
              "hidden_bared")  # fmt: skip
    counts = {
        (c, g, s): 0 for c in labels_against_truth.CLASSES for g in groups for s in (True, False)
    }
    errors = dict.fromkeys(labels_against_truth.CLASSES, 0)
    for y, x in np.ndindex(labels.shape):
        surface, edge = t["surface"][y, x], t["edge"][y, x]
        if not surface or not t["covered"][y, x]:
            continue
        name = labels_against_truth.CLASSES[surface]
        if edge == 1 and name in ("ground", "roof"):
            name = "roof_edge"
        elif edge == 2 and name == "ground":
            name = "tree_edge"
        labelled = bool(np.isfinite(labels[y, x]))
        if t["changed"][y, x]:
            counts[name, ("in_lidar_only", "in_images_only")[t["changed"][y, x] - 1], labelled] += 1
            continue
        for group, extra in (("visible", "visible_lost"), ("hidden", "hidden_bared")):
            if t[group][y, x]:
                counts[name, group, labelled] += 1
                counts[name, extra, labelled] += bool(t["changed_right"][y, x])
                errors[name] += labelled and group == "visible"

    for block in (1024, 96):
        monkeypatch.setattr(labels_against_truth, "BLOCK", block)
        result = compared(scene, store)
        classes = result.whole.figures()["surfaces"]
        assert classes.keys() == {"ground", "roof", "water", "roof_edge", "tree_edge"}
        for name, figures in classes.items():
            for group in groups:
                with_label, without = (counts[name, group, flag] for flag in (True, False))
                assert figures["pixels"][group] == with_label + without
                assert figures["labelled"][group] == with_label
                assert figures["status"][group].get("hidden_in_right", 0) == without
            assert figures["errors"]["count"] == figures["calibration"]["count"] == errors[name]
        whole = result.whole.figures()
        for group in groups:
            expected = [
                sum(counts[c, group, flag] for c in labels_against_truth.CLASSES if c != "water")
                for flag in (True, False)
            ]
            assert min(expected) > 100
            assert whole["pixels"][group] == sum(expected)
            assert whole["labelled"][group] == expected[0]
        assert whole["errors"]["count"] == sum(errors.values()) - errors["water"]
        assert whole["errors"]["mean_absolute"] == pytest.approx(0.638, abs=0.01)
        assert whole["calibration"]["share_below_1"] == pytest.approx(0.6827, abs=0.01)
        assert whole["labels"] == np.isfinite(labels[t["surface"] != WATER]).sum()


def write_tile(folder: Path, scene: Scene, labels: np.ndarray) -> None:
    size, row0, col0, offset = 128, 100, 120, 7
    part = labels[row0 : row0 + size, col0 : col0 + size] - offset
    known = np.isfinite(part)
    images = {
        "disp": np.where(known, part, -999).astype("float32"),
        "status": np.where(known, 1, 3).astype("uint8"),
    }
    for kind, image in images.items():
        (folder / kind).mkdir(parents=True)
        profile = {"driver": "GTiff", "width": size, "height": size, "count": 1}
        profile |= {"dtype": image.dtype, "nodata": -999 if kind == "disp" else 0}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(folder / kind / f"T_{kind}_1.tiff", "w", **profile) as dataset:
                dataset.write(image, 1)
    rows = [
        {
            "tile": "T_1",
            "scene": scene_id,
            "city": "S",
            "split": "test",
            "row0": row0,
            "col0": col0,
            "size": size,
            "right_offset_px": offset,
            "complete": complete,
            "disp": "disp/T_disp_1.tiff",
            "status": "status/T_status_1.tiff",
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
    made = labels_against_truth.MadeScene("S-1", store, scene.truth, tmp_path / "tiles")
    labels_against_truth.evaluate_truth("S-1", [made], *files, workers=2)
    figures = json.loads(files[0].read_text())
    assert figures["whole_scene"]["errors"]["mean_absolute"] < 1e-3
    assert figures["exported_tiles"]["labels"] == 128 * 118
    assert figures["exported_tiles"]["errors"]["max"] < 1e-4
    assert figures["exported_tiles"]["status"]["visible"]["hidden_in_right"] > 500
    assert list(figures["tiles"]) == ["T_1"]
    table = list(csv.DictReader(files[1].open()))
    assert [row["scope"] for row in table] == [
        *(f"scene{c}" for c in ("", ": ground", ": roof", ": water", ": roof_edge", ": tree_edge")),
        *(f"tiles{c}" for c in ("", ": ground", ": roof", ": roof_edge", ": tree_edge")),
        "tile T_1",
    ]
    assert sorted(p.name for p in files[0].parent.iterdir()) == ["truth.csv", "truth.json"]

    # a city of two scenes: their figures together
    (tmp_path / "other").mkdir()
    shifted = write_disparity(scene, tmp_path / "other" / "d.zarr", perfect_labels(scene) + 0.5)
    both = [made, replace(made, name="S-2", disparity=shifted)]
    city = labels_against_truth.evaluate_truth("S", both, *files).whole.figures()
    one = figures["whole_scene"]
    assert city["pixels"] == {group: 2 * n for group, n in one["pixels"].items()}
    two = city["errors"]["count"] - one["errors"]["count"]
    assert city["errors"]["bias"] == pytest.approx(0.5 * two / city["errors"]["count"], abs=1e-4)


def test_missing_and_unlike_stores_are_refused(scene, tmp_path):
    store = write_disparity(scene, tmp_path / "disparity.zarr", perfect_labels(scene))
    with pytest.raises(InputError, match="no such Zarr store"):
        labels_against_truth.compare_scene(store, tmp_path / "none.zarr", None, scene="S-1")
    with pytest.raises(InputError, match="no truth store"):
        labels_against_truth.compare_scene(store, store, None, scene="S-1")
    with pytest.raises(InputError, match="no manifest"):
        labels_against_truth.compare_scene(store, scene.truth, tmp_path, scene="S-1")
    moved = replace(scene.model, left_image=scene.model.left_image.shifted(0.1, 0.0))
    other = scene._replace(model=moved)
    store = write_disparity(other, tmp_path / "moved.zarr", perfect_labels(scene))
    with pytest.raises(InputError, match="another epipolar model"):
        labels_against_truth.compare_scene(store, scene.truth, None, scene="S-1")


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
    layer = grids.Layer("uint16", 0, {"units": "DN", "long_name": "image"})
    stores = []
    for name, image in (("left", texture(x, y)), ("right", right)):
        with grids.building(tmp_path / f"{name}.zarr") as scratch:
            arrays = grids.create_grid(
                scratch, shape, {"image": layer}, chunk=128, shard=256, attrs={}
            )
            arrays["image"][:] = np.rint(image).astype("uint16")
        stores.append(tmp_path / f"{name}.zarr")
    right_way = write_disparity(scene, tmp_path / "d.zarr", disparity)
    figures = scene_warping.evaluate_warping(*stores, right_way)
    assert figures["correlation"] > 0.9999
    assert figures["pixels"] > 0.9 * disparity.size * (shape[1] - 20) / shape[1]
    wrong_way = write_disparity(scene, tmp_path / "e.zarr", -disparity)
    assert scene_warping.evaluate_warping(*stores, wrong_way)["correlation"] < 0.9

    values = np.rint(texture(x, y))[:64, :64]
    tile = warped_tile.WarpedTile(
        "T_1",
        values,
        warping.warp_rows(np.rint(right)[:64], (x - disparity)[:64, :64]),
        disparity[:64, :64],
    )
    assert tile.correlation > 0.9999
    scene_warping.draw_panels(tile, tmp_path / "panels" / "T_1.png")
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
