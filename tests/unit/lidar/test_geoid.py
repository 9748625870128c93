"""Geoid grids against PROJ, and the geoids that PROJ's register has of a place."""

from __future__ import annotations

import sqlite3

import numpy as np
import pyproj
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar import geoid
from stereotruth.lidar.geoid import candidates_at, fits, grid_of, named

from ...synthetic.las import write_gtx


def undulations(west: float, south: float, step: float, shape: tuple[int, int]) -> np.ndarray:
    lat = south + step * np.arange(shape[0])[:, None]
    lon = west + step * np.arange(shape[1])
    return 20 + 8 * np.sin(np.radians(7 * lon)) * np.cos(np.radians(5 * lat))


@pytest.mark.parametrize("west", [-124.0, 236.0])
def test_geoid_is_bilinear_as_in_proj(tmp_path, west) -> None:
    """Against PROJ's own vgridshift; grids from −180 and from 0 (VDatum writes both)."""
    values = undulations(west, 43.0, 0.05, (41, 61))
    grid = write_gtx(tmp_path / "g.gtx", values, west, 43.0, 0.05)
    rng = np.random.default_rng(1)
    lon, lat = rng.uniform(-124, -121, 5000), rng.uniform(43, 45, 5000)
    lon[:4], lat[:4] = [-124, -121, -124, -121], [43, 43, 45, 45]  # the outermost nodes
    ours = geoid.GeoidGrid(grid)(lon, lat)
    proj = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=vgridshift +grids={grid} +multiplier=1 "
        "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    _, _, theirs = proj.transform(lon[4:], lat[4:], np.zeros(4996))
    np.testing.assert_allclose(ours[4:], theirs, rtol=0, atol=2e-6)
    corners = values[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(ours[:4], corners, rtol=0, atol=2e-6)


def test_global_geoid_has_no_seam(tmp_path) -> None:
    step = 0.5
    values = 30 * np.sin(np.radians(np.arange(720) * step)) * np.ones((361, 1))
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "g.gtx", values, 0.0, -90.0, step))
    lon = np.array([-0.25, 0.25, 359.75, 180.0, -180.0, 179.75, -179.75])
    expected = 30 * np.sin(np.radians(lon))
    np.testing.assert_allclose(grid(lon, np.zeros(7)), expected, atol=2e-3)  # chord of 0.5°
    assert np.isfinite(grid(np.array([10.0, 10.0]), np.array([-90.0, 90.0]))).all()


def test_geoid_reads_more_rows_as_chunks_ask(tmp_path) -> None:
    values = undulations(0.0, 40.0, 0.1, (101, 51))
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "g.gtx", values, 0.0, 40.0, 0.1))
    lon, lat = np.full(200, 1.23), np.linspace(40, 50, 200)
    order = np.random.default_rng(0).permutation(200)
    one_by_one = np.array([grid(lon[k : k + 1], lat[k : k + 1])[0] for k in order])
    np.testing.assert_array_equal(one_by_one, geoid.GeoidGrid(grid.path)(lon, lat)[order])


@pytest.mark.parametrize("lon", [11.2, 10.51])  # outside, beside a node without a value
def test_points_without_undulation_are_refused(tmp_path, lon) -> None:
    values = undulations(10.0, 40.0, 0.1, (11, 11))
    values[5, 5] = np.nan
    grid = geoid.GeoidGrid(write_gtx(tmp_path / "small.gtx", values, 10.0, 40.0, 0.1))
    with pytest.raises(InputError) as error:
        grid(np.array([10.1, lon]), np.array([40.1, 40.51]))
    assert "small.gtx" in str(error.value) and "1 points" in str(error.value)


def test_missing_or_broken_grid_is_named(tmp_path) -> None:
    (tmp_path / "bad.gtx").write_bytes(b"not a grid")
    for name in ("none.gtx", "bad.gtx"):
        with pytest.raises(InputError, match=name):
            geoid.GeoidGrid(tmp_path / name)


@pytest.mark.parametrize(
    ("place", "surface", "grid"),
    [
        ((5.4, 43.3), "NGF-IGN69 height", "fr_ign_RAF20.tif"),
        ((8.5, 47.4), "LN02 height", "ch_swisstopo_chgeo2004_ETRS89_LN02.tif"),
        ((179.9, -17.0), "EGM2008 height", "us_nga_egm08_25.tif"),
    ],
)
def test_the_geoids_of_a_place(place, surface, grid):
    candidates = candidates_at(*place)
    assert (surface, grid) in {(one.surface, one.grid) for one in candidates}
    assert len(candidates) <= 4
    assert f"{surface} ({grid}, not on this machine)" in named(candidates)


def test_grids_that_are_not_here_are_named_only():
    text = fits(-48.0, 5.4, 43.3)
    assert "by 48.0 m if they are ellipsoidal; of the place as well: NGF-IGN69 height" in text
    assert "fr_ign_RAF20.tif" in text


def test_a_register_that_cannot_be_read_gives_no_names(monkeypatch):
    def damaged(*_, **__):
        raise sqlite3.DatabaseError

    monkeypatch.setattr(geoid.sqlite3, "connect", damaged)
    assert candidates_at(5.4, 43.3) == [] and fits(1.0, 5.4, 43.3) == ""


@pytest.mark.parametrize(
    ("datum", "place", "grid"),
    [
        ("NAVD88 height (ftUS)", (-122.6, 45.5), "us_noaa_g2018u0.tif"),
        ("IGN69", (5.4, 43.3), "fr_ign_RAF20.tif"),
        ("NAVD88 height", (5.4, 43.3), None),  # of another continent
        ("height", (5.4, 43.3), None),
    ],
)
def test_the_grid_of_a_datum_that_is_declared(datum, place, grid):
    found = grid_of(datum, *place)
    assert (None if found is None else found.grid) == grid
