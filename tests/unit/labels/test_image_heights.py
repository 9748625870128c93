"""Heights of an original image against the simulator's exact truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereocities.cities import Canopy, lidar_files
from stereocities.lidar import simulate_lidar_tile
from stereocities.sites import drawn_site, image_truth
from stereocities.surfaces import TREE
from stereotruth.align.alignment import ViewFit
from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import open_grid
from stereotruth.labels.image_heights import (
    CROWN,
    LAYERS,
    MEASURED,
    NO_POINTS,
    UNDECIDED,
    heights_of_block,
    open_inputs,
    write_image_heights,
)
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import open_stores
from stereotruth.sensor.pair_geometry import GroundOfImages
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import ground_cell

from ...synthetic.site_sensors import exact_image

SITE = drawn_site(5, 2026, images=2, side_px=200, seasons=False)


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    folder, area = tmp_path_factory.mktemp("lidar"), SITE.area
    found = []
    for name in lidar_files(SITE.city, area):
        simulate_lidar_tile(SITE.city, area, name, folder / name, spacing_m=0.3, seed=1)
        ingest(folder / name, folder / f"{name}.points")
        found.append(folder / f"{name}.points")
    return found


def inputs_of(site, stores):
    image = exact_image(site, site.images[0])
    ground = GroundOfImages([image.sensor], [image.size])
    surface = stores[0].parent / "site.surface"
    cell = ground_cell(ground.pixel_deg)
    make_surface(open_stores(stores), surface, cell=cell, ground=ground)
    return open_inputs(image.sensor, image.size, stores, surface)


@pytest.fixture(scope="module")
def inputs(stores):
    return inputs_of(SITE, stores)


@pytest.fixture(scope="module")
def whole(inputs):
    return heights_of_block(inputs, slice(0, inputs.size[1]), slice(0, inputs.size[0]))


@pytest.fixture(scope="module")
def truth():
    image = SITE.images[0]
    row, col = np.mgrid[: image.rows, : image.cols].astype(float)
    return image_truth(SITE, image, col, row)


def test_heights_are_those_that_the_image_shows(whole, truth):
    usable = (truth["covered"] > 0) & (truth["changed"] == 0) & (truth["surface"] > 0)
    measured = usable & (whole["status"] == MEASURED)
    assert measured.sum() > 0.8 * usable.sum()
    error = np.abs(whole["height"] - truth["height"])[measured]
    assert np.median(error) < 0.02
    assert (error > 1.0).mean() < 0.005  # walls and edges have none, or the right one


def test_positions_lie_on_the_ray(whole, truth, inputs):
    measured = (whole["status"] == MEASURED) & (truth["surface"] > 0)
    close = measured & (np.abs(whole["height"] - truth["height"]) < 0.05)
    assert np.abs(whole["lon"] - truth["lon"])[close].max() < 1e-6  # 0.1 m
    row, col = np.nonzero(measured)
    there = inputs.sensor.project(*(whole[k][measured] for k in ("lon", "lat", "height")))
    np.testing.assert_allclose(there, [col, row], atol=2e-3)  # heights are float32


def test_undecided_pixels_are_those_beside_steps(whole, truth):
    """What has no height is where heights change by metres within two pixels."""
    step = np.zeros(truth["height"].shape, bool)
    for axis in (0, 1):
        for shift in (-2, -1, 1, 2):
            step |= np.abs(truth["height"] - np.roll(truth["height"], shift, axis)) > 1.0
    undecided = (whole["status"] == UNDECIDED) & (truth["covered"] > 0)
    assert undecided.any() and step[undecided].mean() > 3 * step.mean()
    for name in ("height", "lon", "lat", "sigma"):
        assert np.isnan(whole[name][~np.isin(whole["status"], (MEASURED, CROWN))]).all()


@pytest.fixture(scope="module")
def wooded(tmp_path_factory):
    """Inputs of an image of a wooded city at 2 points/m², and what it shows."""
    character = replace(SITE.city.character, canopy=Canopy(ground_m2=100.0))
    site = replace(SITE, city=replace(SITE.city, character=character))
    folder, image = tmp_path_factory.mktemp("wooded"), site.images[0]
    stores = []
    for name in lidar_files(site.city, site.area):
        simulate_lidar_tile(site.city, site.area, name, folder / name, spacing_m=0.7, seed=1)
        ingest(folder / name, folder / f"{name}.points")
        stores.append(folder / f"{name}.points")
    row, col = np.mgrid[: image.rows, : image.cols].astype(float)
    return inputs_of(site, stores), image_truth(site, image, col, row)


def test_crowns_have_heights_and_the_roughness_in_their_sigma(wooded):
    inputs, truth = wooded
    cols, rows = inputs.size
    found = heights_of_block(inputs, slice(0, rows), slice(0, cols))
    usable = (truth["covered"] > 0) & (truth["changed"] == 0)
    crown = usable & (truth["surface"] == TREE)
    known = crown & np.isin(found["status"], (MEASURED, CROWN))
    assert known.sum() > 0.5 * crown.sum() > 2000
    assert (found["status"][crown] == CROWN).mean() > 0.3
    error = np.abs(found["height"] - truth["height"])
    assert (error <= 2.0 * found["sigma"])[known].mean() > 0.9
    assert np.median(found["sigma"][found["status"] == CROWN]) < 0.5
    part = heights_of_block(inputs, slice(60, 110), slice(40, 120))
    for name in LAYERS:
        np.testing.assert_array_equal(part[name], found[name][60:110, 40:120])


def test_an_uncertain_correction_tells_on_slopes(inputs, whole):
    cols, rows = inputs.size
    fit = ViewFit(
        "left", "", inputs.size, np.eye(2, 3), (), 0.3, 10, (cols / 2, rows / 2), cols / 2,
        np.diag([0, 0, 0.25, 0, 0, 0.25]),
    )  # fmt: skip
    block = slice(60, 110), slice(40, 120)
    found = heights_of_block(replace(inputs, fit=fit), *block)
    before = whole["sigma"][block]
    np.testing.assert_array_equal(found["height"], whole["height"][block])
    gain = found["sigma"] - before
    assert np.nanmin(gain) >= 0 and np.nanmax(gain) > 0.1


def test_a_store_is_written_whole_and_tells_its_shares(inputs, whole, tmp_path):
    shares = write_image_heights(inputs, tmp_path / "h.zarr", image="A", workers=2)
    assert shares["measured"] == pytest.approx((whole["status"] == MEASURED).mean())
    grid = open_grid(tmp_path / "h.zarr")
    np.testing.assert_array_equal(grid["height"], whole["height"])
    assert "original image" in grid.attrs["conventions"]
    assert grid["x"].attrs["long_name"] == "column of the original image"


def test_an_image_elsewhere_is_refused(inputs, tmp_path):
    rpc = inputs.sensor.rpc
    sensor = replace(inputs.sensor, rpc=replace(rpc, long_off=rpc.long_off + 0.1))
    away = replace(inputs, sensor=sensor)
    assert heights_of_block(away, slice(0, 50), slice(0, 50)) is None
    with pytest.raises(InputError, match="no pixel of image A has a height"):
        write_image_heights(away, tmp_path / "h.zarr", image="A")
    assert NO_POINTS == 0 and not (tmp_path / "h.zarr").exists()
