"""Any number of cities by number and seed, to train on: none of them is one that a test shows.

Ground, buildings, trees, season's sun, orbit and place are drawn; like the six of :mod:`.cities`
they are plain values.
"""

from __future__ import annotations

import math

import numpy as np

from .cities import CITIES, LEFT_GSD_M, Character, CitySpec, SceneSpec

TILES_A_CITY = 4  # two by two
# least and most of each, in metres, degrees and shares; relief is drawn by its logarithm
RELIEF_M = (4.0, 420.0)
TOWERS_M = (22.0, 105.0)
LON, LAT = (75.0, 122.0), (20.0, 38.0)
APART_DEG = 0.2  # from the cities that tests show
FIRST_SEED = 1 << 20  # of worlds; the others' are below
GREATEST_LEAN = 0.35  # relief over wavelength at most
FLAT = {"towers": 3, "slabs": 4, "lowrise": 3, "industry": 2, "park": 1.5, "fields": 2}
STEEP = {"towers": 1, "slabs": 1, "lowrise": 2, "village": 3, "fields": 2, "forest": 3, "bare": 0.5}


def training_city(number: int, seed: int, side_px: int) -> CitySpec:
    """City ``number`` of ``seed``, whose one scene has a left image of ``side_px`` squared.

    The same numbers give the same city everywhere.
    """
    rng = np.random.default_rng([seed, number, 0x7261696E])
    relief = math.exp(rng.uniform(*np.log(RELIEF_M)))
    steep = relief > 100.0
    base = STEEP if steep else FLAT
    zones = {name: weight * float(rng.uniform(0.2, 1.8)) for name, weight in base.items()}
    highest = float(rng.uniform(TOWERS_M[0] + 15.0, TOWERS_M[1]))
    lon, lat = _place(rng)
    side = side_px * LEFT_GSD_M
    wavelength = float(np.clip(rng.uniform(0.5, 1.6) * side, relief / GREATEST_LEAN, 3000.0))
    character = Character(
        relief_m=relief,
        valley=float(rng.uniform(0.2, 0.55)),
        wavelength_m=wavelength,
        max_slope_deg=float(rng.uniform(25, 42) if steep else rng.uniform(8, 22)),
        river_m=float(rng.choice([0.0, rng.uniform(40, 160)])),
        lakes=float(rng.choice([0.0, 1.0])),
        zones=zones,
        towers_m=(float(rng.uniform(TOWERS_M[0], highest - 10.0)), highest),
        trees=float(rng.uniform(0.3, 1.3)),
        zone_m=float(rng.uniform(180, 380)),
    )
    name = f"Training-{number}"
    scene = SceneSpec(
        name, (0.0, 0.0), side_px, side_px, int(rng.integers(FIRST_SEED, 2**31)),
        ascending=bool(rng.random() < 0.5), ragged_m=(0.0, 0.0),
    )  # fmt: skip
    return CitySpec(
        name,
        lon=lon,
        lat=lat,
        epsg=32601 + int((lon + 180.0) // 6.0),
        base_height_m=float(rng.uniform(5, 1900)),
        world_seed=int(rng.integers(FIRST_SEED, 2**31)),
        character=character,
        scenes=(scene,),
        sun_azimuth_deg=float(rng.uniform(115, 190)),
        sun_elevation_deg=float(rng.uniform(32, 66)),
    )


def _place(rng: np.random.Generator) -> tuple[float, float]:
    """Longitude and latitude away from the cities that tests show."""
    while True:
        lon, lat = float(rng.uniform(*LON)), float(rng.uniform(*LAT))
        if all(max(abs(lon - c.lon), abs(lat - c.lat)) > APART_DEG for c in CITIES.values()):
            return lon, lat


def cities_for(count: int) -> tuple[list[int], list[int]]:
    """Numbers of the cities that ``count`` training tiles come from, and of those to validate by.

    A tenth as many tiles validate, of one city at least; sets of more tiles hold those of fewer.
    """
    training = -(-count // TILES_A_CITY)
    validation = max(1, round(count / (10 * TILES_A_CITY)))
    return [2 * k + 1 for k in range(training)], [2 * k for k in range(validation)]
