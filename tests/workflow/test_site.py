"""A stack of images from its sheet to tiles and heights."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from datetime import date
from pathlib import Path

import numpy as np
import pytest
import rasterio

from stereocities.sites import image_truth
from stereotruth.core.products.grids import open_grid
from stereotruth.lidar.catalogue_list import ListedTile, TileList, write_list
from stereotruth.lidar.lattice import Footprint
from stereotruth.project.simulated_project import SITE
from stereotruth.tiles.verify import defects

from ..synthetic.project import ROOT, Project

pytestmark = pytest.mark.slow
COMMAND = [sys.executable, "-m", "stereotruth.project.main"]


def call(folder: Path, *arguments: str) -> str:
    done = subprocess.run(
        [*COMMAND, *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=1800,
    )
    assert done.returncode == 0, done.stdout[-4000:]
    return done.stdout


DAYS = "2019-03-01", "2019-03-05"  # of the LiDAR, by a catalogue


def list_of_tiles(folder: Path) -> None:
    """As `stereotruth lidar` writes it from a catalogue that knows days."""
    place = np.array([[SITE.city.lon], [SITE.city.lat]])
    ground = place + 0.03 * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
    tiles = tuple(
        ListedTile(str(file.relative_to(folder)), file.stat().st_size, "", -1, *DAYS)
        for file in sorted((folder / "data/lidar").iterdir())
    )
    listed = TileList(
        catalogue="https://example.org/tiles.vpc",
        sha256="0" * 64,
        bytes=1,
        hosts=(),
        ground=tuple(map(tuple, Footprint.around([ground], 0.0).runs)),
        footprint_m2=1e6,
        hole_m2=0.0,
        crs="",
        tiles=tiles,
    )
    write_list(listed, folder / "lidar.tsv")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The example, two pairs of it, made: the tiles by forks, the rest by programs."""
    empty = tmp_path_factory.mktemp("empty")
    call(empty, "init", "--example", "site")
    folder = empty / "site"
    list_of_tiles(folder)
    given = "--lidar", "lidar.tsv", "--gcps", "gcps/Stack.csv"
    call(folder, "pairs", "Stack", "--most", "2", *given)
    assert "0 errors, 0 doubts" in call(folder, "check")
    with (folder / "config.yaml").open("a", encoding="utf-8") as config:
        config.write("dataset: {original_heights: true}\n")
    settings = ("--snakefile", str(ROOT / "Snakefile"), "--configfile", "config.yaml")
    made = Project(folder).snakemake("tiles/Stack", *settings)
    assert made.status == 0, made.text[-4000:]
    call(folder, "run", "heights", "originals/Stack", "report", "--cores", "2")
    return folder


def test_an_image_has_one_correction_in_both_of_its_pairs(site: Path) -> None:
    adjusted = json.loads((site / "results/adjust/Stack.json").read_text())["images"]
    assert len(adjusted) == 3 and not any(image["doubts"] for image in adjusted.values())
    affines: dict[str, list] = {}
    for pair in (site / "results/adjust/Stack").iterdir():
        alignment = json.loads((pair / "alignment.json").read_text())
        for view in ("left", "right"):
            name = Path(alignment[view]["image"]).stem
            affines.setdefault(name, []).append(alignment[view]["affine"])
    assert sorted(map(len, affines.values())) == [1, 1, 2]
    for name, found in affines.items():
        assert all(affine == adjusted[name]["affine"] for affine in found)


def test_the_tiles_of_both_pairs_are_made_and_each_lidar_file_is_read_once(site: Path) -> None:
    assert defects(site / "tiles/Stack") == []
    assert len(list((site / "results/project/Stack").glob("*.zarr"))) == 2
    stores = [path.name for path in (site / "results/ingest").rglob("*.points")]
    assert sorted(stores) == ["Stack_0_0.points", "Stack_0_1.points"]


def test_heights_are_the_truth_and_their_uncertainty_explains_their_errors(site: Path) -> None:
    stores = sorted((site / "results/heights/Stack").glob("*.zarr"))
    assert len(stores) == 3  # two pairs of one pass share an image
    for store in stores:
        image, grid = SITE.image(store.stem), open_grid(store)
        row, col = np.mgrid[: image.rows, : image.cols].astype(float)
        truth = image_truth(SITE, image, col, row)
        usable = (truth["surface"] > 0) & (truth["covered"] > 0) & (truth["changed"] == 0)
        measured = usable & (grid["status"].values == 1)
        assert measured.sum() > 0.9 * usable.sum()
        error = np.abs(grid["height"].values - truth["height"])[measured]
        sigma = grid["sigma"].values[measured]
        assert np.median(error) < 0.02 and (error > 1.0).mean() < 0.001
        assert 0.6 < (error < sigma).mean() < 0.78
        assert 0.9 < (error < 2 * sigma).mean() < 0.98


def test_tiles_say_how_old_the_lidar_was(site: Path) -> None:
    """From the middle of the catalogue's days to those of the images sheet."""
    with (site / "tiles/Stack/manifest.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    found = {(row["scene"], row["lidar_days_left"], row["lidar_days_right"]) for row in rows}
    expected = set()
    for file in (site / "results/adjust/Stack").glob("*/alignment.json"):
        record = json.loads(file.read_text())
        images = [SITE.image(Path(record[view]["image"]).stem) for view in ("left", "right")]
        days = [str((image.acquired.date() - date(2019, 3, 3)).days) for image in images]
        expected.add((file.parent.name, *days))
    assert len(expected) == 2 and found == expected
    page = (site / "results/report/Stack/index.html").read_text(encoding="utf-8")
    assert "2019-03-01 to 2019-03-05" in page and re.search(r"images [\d–]+ days later", page)


def test_crops_of_originals_have_the_heights_beside_them(site: Path) -> None:
    folder = site / "originals/Stack"
    assert defects(folder) == []
    names = [path.parent.name for path in (site / "results/adjust/Stack").glob("*/alignment.json")]
    with (folder / "manifest.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["scene"] for row in rows} == set(names)
    for row in rows:
        alignment = json.loads(
            (site / f"results/adjust/Stack/{row['scene']}/alignment.json").read_text()
        )
        for view in ("left", "right"):
            image = SITE.image(Path(alignment[view]["image"]).stem)
            with rasterio.open(folder / row[f"{view}_height"]) as crop:
                height = crop.read(1, masked=True)
            first = int(row[f"{view}_row0"]), int(row[f"{view}_col0"])
            at = (axis + start for axis, start in zip(np.indices(height.shape), first))
            line, col = (axis.astype(float) for axis in at)
            truth = image_truth(SITE, image, col, line)
            usable = (truth["surface"] > 0) & (truth["covered"] > 0) & (truth["changed"] == 0)
            measured = usable & ~np.ma.getmaskarray(height)
            assert measured.sum() > 0.9 * usable.sum()
            error = np.abs(height.filled(np.nan) - truth["height"])[measured]
            assert np.median(error) < 0.02 and (error > 1.0).mean() < 0.001
            with rasterio.open(folder / row[f"{view}_visibility"]) as crop:
                seen = crop.read(1)
            assert (seen[np.ma.getmaskarray(height)] == 0).all()
            assert (seen[measured] == 1).mean() > 0.7 and 0 < (seen[measured] == 2).mean() < 0.1


def test_the_site_has_a_page_that_leads_to_its_pairs(site: Path) -> None:
    text = (site / "results/site/Stack/index.html").read_text(encoding="utf-8")
    assert all(f"<title>{image.name} " in text for image in SITE.images)  # in the map
    assert re.findall(r'<section id="(\w+)"', text) == ["map", "images", "pairs", "residuals"]
    links = set(re.findall(r'href="\.\./\.\./report/Stack/index\.html#(scene-[^"]+)"', text))
    tiles = (site / "results/report/Stack/index.html").read_text(encoding="utf-8")
    assert len(links) == 2 and all(f'id="{link}"' in tiles for link in links)
    assert "site/Stack/index.html" in (site / "results/report/index.html").read_text()
