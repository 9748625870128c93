"""Surfaces that undeclared heights may count from: named for a place, and held against a shift."""

from __future__ import annotations

import sqlite3

import pytest

from stereotruth.lidar import geoid as geoid_candidates
from stereotruth.lidar.geoid import candidates_at, fits, grid_of, named


@pytest.mark.parametrize(
    ("place", "surface", "grid"),
    [
        ((5.4, 43.3), "NGF-IGN69 height", "fr_ign_RAF20.tif"),
        ((-122.6, 45.5), "NAVD88 height", "us_noaa_g2018u0.tif"),
        ((8.5, 47.4), "LN02 height", "ch_swisstopo_chgeo2004_ETRS89_LN02.tif"),
        ((5.0, 52.0), "NAP height", "nl_nsgi_nlgeo2018.tif"),
        ((-1.0, 52.0), "ODN height", "uk_os_OSGM15_GB.tif"),
        ((115.4, 30.2), "EGM2008 height", "us_nga_egm08_25.tif"),
        ((179.9, -17.0), "EGM2008 height", "us_nga_egm08_25.tif"),
    ],
)
def test_the_geoids_of_a_place(place, surface, grid):
    found = candidates_at(*place)
    assert (surface, grid) in {(one.surface, one.grid) for one in found}
    assert len(found) <= 4
    assert f"{surface} ({grid}, not on this machine)" in named(found)


def test_grids_that_are_not_here_are_named_only():
    text = fits(-48.0, 5.4, 43.3)
    assert "ellipsoidal 48.0 m; of the place as well: NGF-IGN69 height (fr_ign_RAF20.tif" in text


def test_a_register_that_cannot_be_read_gives_no_names(monkeypatch):
    def damaged(*_, **__):
        raise sqlite3.DatabaseError

    monkeypatch.setattr(geoid_candidates.sqlite3, "connect", damaged)
    assert candidates_at(5.4, 43.3) == [] and fits(1.0, 5.4, 43.3) == ""


@pytest.mark.parametrize(
    ("datum", "place", "grid"),
    [
        ("NAVD88 height (ftUS)", (-122.6, 45.5), "us_noaa_g2018u0.tif"),
        ("IGN69", (5.4, 43.3), "fr_ign_RAF20.tif"),
        ("NN2000 height", (10.0, 60.0), "no_kv_HREF2018B_NN2000_EUREF89.tif"),
        ("NAVD88 height", (5.4, 43.3), None),  # of another continent
        ("height", (5.4, 43.3), None),
        ("EGM96 height", (float("inf"), float("nan")), None),
    ],
)
def test_the_grid_of_a_datum_that_is_declared(datum, place, grid):
    found = grid_of(datum, *place)
    assert (None if found is None else found.grid) == grid
