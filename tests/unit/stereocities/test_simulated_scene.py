"""A simulated scene as a whole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio

from stereocities import built_city
from stereocities.cities import lidar_files
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import prepare, simulate_image
from stereotruth.core.products.provenance import source_modules

from ...synthetic.small_cities import TOWN


def test_same_spec_gives_the_same_files(town: Path, tmp_path: Path) -> None:
    built_city.surfaces_of.__globals__["_surfaces_of"].cache_clear()
    prepare.__globals__["_prepare"].cache_clear()
    scene = TOWN.scenes[0]
    name = lidar_files(TOWN, scene)[1]
    simulate_image(TOWN, scene, "right", tmp_path / "right.tif", seed=1)
    simulate_lidar_tile(TOWN, scene, name, tmp_path / name, seed=1)
    assert (tmp_path / "right.tif").read_bytes() == (town / "right.tif").read_bytes()
    assert (tmp_path / name).read_bytes() == (town / "lidar" / name).read_bytes()
    simulate_image(TOWN, scene, "right", tmp_path / "other.tif", seed=2)
    with rasterio.open(tmp_path / "other.tif") as a, rasterio.open(town / "right.tif") as b:
        difference = a.read(1).astype(float) - b.read(1)
    assert 2 < difference.std() < 12  # only the sensor's noise is drawn again


def test_a_built_city_in_a_file_gives_the_same_files(town: Path, tmp_path: Path) -> None:
    scene = TOWN.scenes[0]
    name = lidar_files(TOWN, scene)[1]
    built = tmp_path / "surfaces.npz"
    built_city.write_surfaces(TOWN, built)
    simulate_image(TOWN, scene, "left", tmp_path / "left.tif", seed=1, built=built)
    simulate_lidar_tile(TOWN, scene, name, tmp_path / name, seed=1, built=built)
    assert (tmp_path / "left.tif").read_bytes() == (town / "left.tif").read_bytes()
    assert (tmp_path / name).read_bytes() == (town / "lidar" / name).read_bytes()
    built_city.write_surfaces(TOWN, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == built.read_bytes()
    flooded = tmp_path / "flooded.npz"  # the file is what is looked at
    with flooded.open("wb") as stream:
        np.savez(stream, **built_city.surfaces_of(TOWN)._replace(water=1e4)._asdict())
    simulate_image(TOWN, scene, "left", tmp_path / "sea.tif", seed=1, built=flooded)
    assert (tmp_path / "sea.tif").read_bytes() != (town / "left.tif").read_bytes()


def test_shares_no_code_with_the_pipeline() -> None:
    modules = source_modules(
        "stereocities.render",
        "stereocities.lidar",
        "stereocities.truth",
        "stereocities.control_points",
    )
    others = {m for m in modules if not m.startswith("stereocities")}
    assert others <= {
        "stereotruth",
        "stereotruth.core",
        "stereotruth.core.errors",
        "stereotruth.core.job",
        "stereotruth.core.kernels",
        "stereotruth.core.products",
        "stereotruth.core.products.grids",
        "stereotruth.core.products.files",
        "stereotruth.core.products.making",
        "stereotruth.core.products.provenance",
        "stereotruth.core.products.remote_files",
        "stereotruth.core.products.web_files",
    }
