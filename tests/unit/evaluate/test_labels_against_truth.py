"""Labels against the exact truth of a scene."""

from __future__ import annotations

import csv
import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import zarr
from rasterio.errors import NotGeoreferencedWarning

from stereotruth.core.errors import InputError
from stereotruth.evaluate import labels_against_truth

from ...synthetic.truth_scene import WATER, Scene, perfect_labels, write_disparity

# -------------------------------------------------------------------------------------- truth


def compared(scene: Scene, store: Path, workers: int = 2) -> labels_against_truth.SceneComparison:
    return labels_against_truth.compare_scene(
        store, scene.truth, None, scene="S-1", workers=workers
    )


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
