"""A stack of images from its sheet to tiles and heights, by the program alone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stereotruth.command.example_city import SITE
from stereotruth.dataset.verify import defects
from stereotruth.products.grids import open_grid
from stereotruth.simulate.site_images import image_truth

COMMAND = [sys.executable, "-m", "stereotruth.command.main"]


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


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The example, two pairs of it, made."""
    empty = tmp_path_factory.mktemp("empty")
    call(empty, "init", "--example", "site")
    folder = empty / "site"
    given = "--lidar", "data/lidar", "--gcps", "gcps/Stack.csv"
    call(folder, "pairs", "Stack", "--most", "2", *given)
    assert "0 errors, 0 doubts" in call(folder, "check")
    call(folder, "run", "heights", "tiles/Stack", "--cores", "2")
    return folder


@pytest.mark.slow
def test_the_tiles_of_both_pairs_are_made_and_each_lidar_file_is_read_once(site):
    check_tiles(site)


@pytest.mark.slow
def test_heights_are_the_truth_and_their_uncertainty_explains_their_errors(site):
    check_heights(site)


@pytest.mark.slow
def test_an_image_has_one_correction_in_both_of_its_pairs(site):
    check_corrections(site)


def check_corrections(site: Path) -> None:
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


def check_tiles(site: Path) -> None:
    assert defects(site / "tiles/Stack") == []
    assert len(list((site / "results/project/Stack").glob("*.zarr"))) == 2
    stores = [path.name for path in (site / "results/ingest").rglob("*.points")]
    assert sorted(stores) == ["Stack_0_0.points", "Stack_0_1.points"]


def check_heights(site: Path) -> None:
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
