"""What leaves the workflow: masks that reach the tiles, the dataset in all its forms."""

from __future__ import annotations

import csv
import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml

from stereotruth.tiles.stereo_dataset import StereoDataset

from ..synthetic.project import SIZE, row_of

CATALOGS = {"stac": "pystac", "croissant": "mlcroissant"}
FORMS = {
    "layouts": ["whu", "kitti", "us3d", "webdataset", *["parquet"] * bool(find_spec("pyarrow"))],
    "catalogs": [name for name, module in CATALOGS.items() if find_spec(module)],
    "originals": True,
}
RANGE = (-64, 128)


@pytest.fixture(scope="module")
def complete(made, tmp_path_factory):
    project = made.copy(tmp_path_factory.mktemp("forms") / "project")
    (project.folder / "forms.yaml").write_text(yaml.safe_dump({"dataset": FORMS}))
    run = project.snakemake("dataset", "--configfile", "tiny.yaml", "forms.yaml")
    assert run.status == 0, run.text[-4000:]
    return project


@pytest.mark.slow
def test_the_dataset_has_the_forms_that_are_asked_for(complete):
    tiles = StereoDataset("t", complete.folder / "dataset", "stereotruth", RANGE)
    names = {pair.name for pair in tiles.pairs(labelled=True)}
    for layout in ("kitti", "us3d"):
        found = StereoDataset("d", complete.folder / f"dataset_{layout}", layout, RANGE)
        assert {pair.name for pair in found.pairs(labelled=True)} == names
    for layout in set(FORMS["layouts"]) & {"webdataset", "parquet"}:
        with (complete.folder / f"dataset_{layout}/manifest.csv").open() as table:
            assert {row["tile"] for row in csv.DictReader(table)} == names
    crops = {p.stem for p in (complete.folder / "originals/Tiny/left").glob("*.tif")}
    assert crops >= names
    footprints = json.loads((complete.folder / "dataset/footprints.geojson").read_text())
    assert {one["id"] for one in footprints["features"]} >= names
    for file, catalog in (("stac/collection.json", "stac"), ("croissant.json", "croissant")):
        assert (complete.folder / "dataset" / file).is_file() == (catalog in FORMS["catalogs"])
    with rasterio.open(complete.folder / "results/export/Tiny/quick_looks/Tiny-1_left.tif") as look:
        assert look.crs.is_projected and look.count == 4
    root = complete.folder / "dataset"
    assert len(list(root.glob("with ground truth/*/disp/*.tiff"))) == len(names)
    assert (root / "without ground truth/left").is_dir()
    assert complete.plan("dataset", "--configfile", "tiny.yaml", "forms.yaml") == {}


def test_a_mask_makes_again_what_looks_at_the_image(made, tmp_path):
    other = made.copy(tmp_path / "masked")
    with rasterio.open(other.folder / "in/left.tif") as image:
        profile = {"width": image.width, "height": image.height, "count": 1, "dtype": "uint8"}
    with rasterio.open(other.folder / "in/cloud.tif", "w", driver="GTiff", **profile) as mask:
        mask.write(np.zeros(mask.shape, np.uint8), 1)
    row = row_of(Path("in"), left_mask="in/cloud.tif")
    config = other.add_scene("tiny", [row], **SIZE)
    jobs = other.plan("tiles/Tiny", "--configfile", config)
    assert jobs == {"refine": 1, "rectify": 1, "project": 1, "export": 1}
