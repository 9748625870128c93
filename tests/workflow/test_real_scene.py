"""A real Pléiades pair through the workflow, against its check points."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import rasterio
import yaml
from figures import evaluate_checkpoints
from rasterio.windows import Window

from stereotruth.evaluate.labels_against_images import warp_scene

from ..synthetic.project import ROOT

SCENE = ROOT.parent / "shared" / "real" / "marseille"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning"),
    pytest.mark.skipif(not SCENE.is_dir(), reason="the real scene is not beside the project"),
]


def test_marseille_agrees_with_its_check_points(project):
    row = {
        "scene": "marseille-1",
        "city": "Marseille",
        "left_image": str(SCENE / "left.tif"),
        "right_image": str(SCENE / "right.tif"),
        "lidar": str(SCENE / "lidar"),
        "gcps": str(SCENE / "gcps.csv"),
    }
    config = project.add_scene("marseille", [row], tiles={"size": 512})
    run = project.snakemake("tiles/Marseille", "--configfile", config)
    assert run.status == 0, run.text[-4000:]
    results = project.folder / "results"
    grid = results / "project/Marseille/marseille-1.zarr"
    figures = evaluate_checkpoints(grid, SCENE / "checkpoints.csv")
    assert figures["count"] > 3000
    assert abs(figures["median"]) <= 0.08
    assert figures["nmad"] <= 0.40
    assert figures["y_parallax_rms"] <= 0.25
    rectified = results / "rectify/Marseille/marseille-1"
    warped = warp_scene(rectified / "left.zarr", rectified / "right.zarr", grid)
    assert warped.sums.coefficient >= 0.98


CROP = Window(150, 120, 760, 780)  # of the left image: column, row, width, height


def crop_left(path: Path) -> None:
    """Write a part of the left image, its RPC cropped alike."""
    with rasterio.open(SCENE / "left.tif") as image:
        rpc = image.rpcs
        rpc.samp_off, rpc.line_off = rpc.samp_off - CROP.col_off, rpc.line_off - CROP.row_off
        size = {"width": CROP.width, "height": CROP.height, "count": 1, "dtype": image.dtypes[0]}
        with rasterio.open(path, "w", driver="GTiff", **size) as crop:
            crop.write(image.read(window=CROP))
            crop.rpcs = rpc


def long_control_points() -> list[str]:
    """Those of the pair, by image: L, R, and C of the crop."""
    lines = ["id,lon,lat,height,image,col,row"]
    with (SCENE / "gcps.csv").open(encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            point = ",".join(row[key] for key in ("id", "lon", "lat", "height"))
            lines.append(f"{point},L,{row['left_col']},{row['left_row']}")
            lines.append(f"{point},R,{row['right_col']},{row['right_row']}")
            col, line = float(row["left_col"]) - CROP.col_off, float(row["left_row"]) - CROP.row_off
            if 0 <= col < CROP.width and 0 <= line < CROP.height:
                lines.append(f"{point},C,{col:.3f},{line:.3f}")
    return lines


def test_marseille_both_ways_and_a_crop_are_one_site(project):
    crop_left(project.folder / "crop.tif")
    (project.folder / "gcps.csv").write_text("\n".join(long_control_points()) + "\n")
    files = {"L": SCENE / "left.tif", "R": SCENE / "right.tif", "C": "crop.tif"}
    rows = [f"{name}\tMarseille\t{file}\t2013-04-17" for name, file in files.items()]
    sheet = "\n".join(["image\tcity\tfile\tacquired", *rows]) + "\n"
    (project.folder / "images.tsv").write_text(sheet)
    scenes = [
        {
            "scene": one + other,
            "city": "Marseille",
            "left_image": one,
            "right_image": other,
            "lidar": str(SCENE / "lidar"),
            "gcps": "gcps.csv",
        }
        for one, other in ("LR", "RL", "CR")
    ]
    config = project.add_scene("site", scenes, images="images.tsv", tiles={"size": 256})
    assert yaml.safe_load((project.folder / config).read_text())["images"] == "images.tsv"
    stores = [f"results/project/Marseille/{scene['scene']}.zarr" for scene in scenes]
    run = project.snakemake(*stores, "--configfile", config)
    assert run.status == 0, run.text[-4000:]
    adjusted = json.loads((project.folder / "results/adjust/Marseille.json").read_text())
    middle = {name: image["correction"] for name, image in adjusted["images"].items()}
    assert not any(image["doubts"] for image in adjusted["images"].values())
    for axis in ("col", "row"):  # the crop is the left image
        assert abs(middle["L"][axis] - middle["C"][axis]) < 0.05
    assert abs(middle["R"]["col"] + 1.192) < 0.05 and abs(middle["R"]["row"] - 0.051) < 0.05
    assert all(pair["matched"] > 0.9 for pair in adjusted["pairs"].values())
    figures = evaluate_checkpoints(project.folder / stores[0], SCENE / "checkpoints.csv")
    assert figures["count"] > 3000
    assert abs(figures["median"]) <= 0.08 and figures["nmad"] <= 0.40
    assert len(list((project.folder / "results/ingest").rglob("*.points"))) == 2  # read once
