"""Synthetic cities as plain values, and which files each of them is made of.

Six are built in. Others are drawn by number and seed, to train on: ground, buildings, trees,
season's sun, orbit and place, and none of them is one that a test shows. A project has more, each
in a file ``data/synthetic/<City>/city.json``, which holds what differs from the defaults of
:class:`CitySpec` by the names of its fields. A workflow plans with these values: nothing is built
here, and only such a file is read.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import atomic_file

LEFT_GSD_M = 0.65
RIGHT_GSD_M = 0.80

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

FOLDER = Path("data/synthetic")  # of the working directory


@dataclass(frozen=True)
class SceneSpec:
    """One stereo pair of a city.

    ``centre_m``: ground position of the scene's middle, east and north of the city's centre.
    ``cols``, ``rows``: size of the left image. ``pose_seed`` draws orbit offset, attitude and the
    bias of the RPCs. ``lidar_grid``: LiDAR tiles (east, north). ``ragged_m``: how far the
    coverage's edge stays inside the left image at its last columns and its first rows, on average;
    ``gap_m``: size of the block without LiDAR in the corner between these two sides.
    """

    name: str
    centre_m: tuple[float, float]
    cols: int
    rows: int
    pose_seed: int
    ascending: bool = False
    lidar_grid: tuple[int, int] = (2, 2)
    ragged_m: tuple[float, float] = (40.0, 40.0)
    gap_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Jitter:
    """Roll and pitch that swing while an image is taken; no RPC follows.

    ``rms_px``: of the image's movement by either; ``periods`` of its waves, in an image.
    """

    rms_px: float
    periods: tuple[float, ...] = (1.3, 2.1, 3.0)


@dataclass(frozen=True)
class ViewSpec:
    """What one image of a pair has of its own.

    ``sun_deg``: azimuth and elevation of the sun, degrees; None is the city's. ``bare``: the crowns
    of the canopy have no leaves, so that most rays pass them. ``jitter`` of the attitude.
    ``psf_px``: standard deviation of the point spread, px. ``saturates``: the reflectance that has
    the greatest of 8 bits; None: 11 bits, which nothing saturates.
    """

    sun_deg: tuple[float, float] | None = None
    bare: bool = False
    jitter: Jitter | None = None
    psf_px: float = 0.42
    saturates: float | None = None


@dataclass(frozen=True)
class Dates:
    """When both images and the LiDAR were taken, and what changed from the first to the last date.

    ``left``, ``right``, ``lidar``: days. Shares in [0, 1] of what changes, each thing at a moment
    of its own: ``built``, ``demolished``, ``raised`` of the buildings; ``felled``, ``grown`` of the
    trees; ``crops`` of the blocks of fields, to another height; ``resurfaced`` of the streets,
    which changes their texture alone. ``water_m``: rise of the water, m.
    """

    left: float
    right: float
    lidar: float
    built: float = 0.0
    demolished: float = 0.0
    raised: float = 0.0
    felled: float = 0.0
    grown: float = 0.0
    crops: float = 0.0
    resurfaced: float = 0.0
    water_m: float = 0.0

    def passed(self, world: str) -> float:
        """Share of the time that has passed in a ``world``: left, right or lidar."""
        days = self.left, self.right, self.lidar
        first, last = min(days), max(days)
        return (getattr(self, world) - first) / (last - first) if last > first else 0.0


@dataclass(frozen=True)
class FlightStrip:
    """One strip of an airborne LiDAR that flies north.

    ``offset_m``: east, north, up that all of its points are off by; ``roll_deg``: the points turn
    about the strip's middle line besides, the east down. ``spacing_m`` of its pulses.
    """

    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spacing_m: float = 0.4
    roll_deg: float = 0.0


@dataclass(frozen=True)
class Canopy:
    """Crowns with rough tops, besides the trees that the land use has.

    ``arrangement``: "single" (anywhere), "rows" or "forest". ``ground_m2``: ground per crown.
    ``radius_m``: least and greatest radius. ``lobes``: ellipsoids that stand out of a crown's top.
    ``brightness``: factor on the reflectance of leaves. ``porosity``: share of the LiDAR pulses
    that the top of a crown lets pass. ``trunk_m``: least and greatest height of a crown's lower
    end; ``slimness``: of its height over its width.
    """

    arrangement: str = "single"
    ground_m2: float = 250.0
    radius_m: tuple[float, float] = (1.5, 4.5)
    lobes: int = 8
    brightness: float = 0.4
    porosity: float = 0.35
    trunk_m: tuple[float, float] = (0.4, 2.2)
    slimness: tuple[float, float] = (0.75, 1.1)


@dataclass(frozen=True)
class Character:
    """What a city looks like.

    ``relief_m``: height range aimed at over the world; ``valley``: share of it that is plain;
    ``wavelength_m``: that of the largest relief; ``max_slope_deg``: nothing is steeper.
    ``river_m``: width of the river, 0 for none; ``lakes``: depth of depressions below the water
    level, 0 for none. ``zones``: weight of each land use, see :data:`.layout.ZONE_KINDS`.
    ``towers_m``: range of heights of high buildings. ``trees``: factor on the number of trees.
    ``zone_m``: mean distance between the centres of zones. ``canopy``: crowns besides these trees.
    ``ground_look``: factors on the ground's reflectance and on its contrast. ``buildings``: share
    of the buildings that are built; ``flat_roofs``: none has a gable. ``vehicles``: per hectare,
    which move between the views and are others in the LiDAR.
    """

    relief_m: float
    valley: float
    wavelength_m: float
    max_slope_deg: float
    river_m: float
    lakes: float
    zones: dict[str, float] = field(hash=False)
    towers_m: tuple[float, float]
    trees: float
    zone_m: float = 330.0
    canopy: Canopy | None = None
    ground_look: tuple[float, float] = (1.0, 1.0)
    buildings: float = 1.0
    flat_roofs: bool = False
    vehicles: float = 0.0


@dataclass(frozen=True)
class Twin:
    """The real place that a city is the twin of.

    ``file``: LAS or LAZ; ``crs``: of its points, if it declares none. ``half_m``: half the ground
    that the file covers, along its axes east and north; ``turned_rad``: counter-clockwise turn of
    these axes in the city's frame. ``rpcs``: files of RPCs by which left and right image see the
    place, over it or moved there; None: GaoFen-7's camera takes them.
    """

    file: str
    crs: str
    half_m: tuple[float, float]
    turned_rad: float
    rpcs: tuple[str, str] | None = None

    @property
    def files(self) -> list[str]:
        """The files of the place."""
        return [self.file, *(self.rpcs or ())]


@dataclass(frozen=True)
class CitySpec:
    """A synthetic city: where it lies, what it looks like, and its scenes.

    ``lon``, ``lat`` in degrees; ``epsg``: the UTM zone of its LiDAR; ``base_height_m``: ellipsoidal
    height of its lowest ground; ``world_seed`` draws everything that is built.
    ``margin_m``: ground built around the scenes, more than any ray leans. ``left``, ``right``: what
    the images have of their own. ``dates``: of images and LiDAR, each of which has a world of its
    own then; None: a few buildings of each scene stand in the images or in the LiDAR alone, but in
    a twin. ``strips`` of the LiDAR, from west to east over each scene; none: two crossed sets of
    flight lines that agree. ``twin``: the real place whose ground, roofs and crowns the city has;
    None: it is drawn.
    """

    name: str
    lon: float
    lat: float
    epsg: int
    base_height_m: float
    world_seed: int
    character: Character
    scenes: tuple[SceneSpec, ...]
    las_format: str = "laz-1.4-6"
    sun_azimuth_deg: float = 148.0
    sun_elevation_deg: float = 54.0
    margin_m: float = 160.0
    single_box: tuple[float, float, float, float, float] | None = field(default=None)
    left: ViewSpec = ViewSpec()
    right: ViewSpec = ViewSpec()
    dates: Dates | None = None
    strips: tuple[FlightStrip, ...] = ()
    twin: Twin | None = None

    def scene(self, name: str) -> SceneSpec:
        """The scene of that name; KeyError if there is none."""
        for scene in self.scenes:
            if scene.name == name:
                return scene
        raise KeyError(f"{self.name} has no scene {name}")


def _one(city: str, pose_seed: int, *, ascending: bool = False) -> tuple[SceneSpec, ...]:
    """The single scene of most cities: 2 by 3 tiles of 1024 px, one of them without its LiDAR."""
    return (
        SceneSpec(f"{city}-1", (0.0, 0.0), 2500, 3400, pose_seed, ascending, gap_m=(845.0, 748.0)),
    )


# fmt: off
CITIES: dict[str, CitySpec] = {
    city.name: city
    for city in (
        CitySpec(
            "Wuhan", lon=114.305, lat=30.593, epsg=32650, base_height_m=12.0, world_seed=11,
            character=Character(
                relief_m=6, valley=0.2, wavelength_m=1500, max_slope_deg=8, river_m=150, lakes=1.5,
                zones={"towers": 5, "slabs": 4, "lowrise": 2, "industry": 1, "park": 1.2},
                towers_m=(45, 98), trees=0.8,
            ),
            scenes=_one("Wuhan", 101),
        ),
        CitySpec(
            "Hengyang", lon=112.572, lat=26.893, epsg=32649, base_height_m=48.0, world_seed=12,
            character=Character(
                relief_m=18, valley=0.3, wavelength_m=1300, max_slope_deg=12, river_m=190, lakes=0,
                zones={"towers": 1, "slabs": 2, "lowrise": 2, "village": 2, "fields": 5, "park": 1},
                towers_m=(30, 60), trees=0.8,
            ),
            scenes=_one("Hengyang", 102),
            las_format="las-1.2-1",
        ),
        CitySpec(
            "Shaoguan", lon=113.597, lat=24.811, epsg=32649, base_height_m=72.0, world_seed=13,
            character=Character(
                relief_m=360, valley=0.42, wavelength_m=2300, max_slope_deg=40, river_m=90, lakes=0,
                zones={"towers": 1, "slabs": 2, "lowrise": 2, "village": 1, "fields": 1,
                       "forest": 3},
                towers_m=(28, 55), trees=1.0,
            ),
            scenes=_one("Shaoguan", 103),
        ),
        CitySpec(
            "Kunming", lon=102.712, lat=25.041, epsg=32648, base_height_m=1858.0, world_seed=14,
            character=Character(
                relief_m=60, valley=0.25, wavelength_m=1500, max_slope_deg=20, river_m=0, lakes=1.5,
                zones={"towers": 1.5, "slabs": 3, "lowrise": 2, "industry": 2, "park": 1.5,
                       "fields": 1.5, "forest": 1},
                towers_m=(40, 75), trees=1.0,
            ),
            scenes=_one("Kunming", 104),
            sun_elevation_deg=58.0,
        ),
        CitySpec(
            "Yingde", lon=113.405, lat=24.186, epsg=32649, base_height_m=36.0, world_seed=15,
            character=Character(
                relief_m=400, valley=0.5, wavelength_m=2500, max_slope_deg=42, river_m=80, lakes=0,
                zones={"slabs": 1, "lowrise": 1.5, "village": 4, "fields": 4, "forest": 2,
                       "bare": 0.6},
                towers_m=(20, 40), trees=1.1,
            ),
            scenes=_one("Yingde", 105, ascending=True),
        ),
        CitySpec(
            "Qichun", lon=115.433, lat=30.232, epsg=32650, base_height_m=18.0, world_seed=16,
            character=Character(
                relief_m=70, valley=0.3, wavelength_m=1500, max_slope_deg=24, river_m=110,
                lakes=1.0,
                zones={"towers": 0.6, "slabs": 2, "lowrise": 2, "village": 3, "industry": 1,
                       "fields": 4.5, "forest": 2, "park": 1},
                towers_m=(26, 55), trees=0.9,
            ),
            scenes=(
                SceneSpec("Qichun-1", (-1080.0, 170.0), 3650, 3650, 106, lidar_grid=(3, 2),
                          gap_m=(845.0, 812.0)),
                SceneSpec("Qichun-2", (1080.0, -170.0), 3650, 3650, 107, lidar_grid=(3, 2),
                          gap_m=(845.0, 812.0)),
            ),
        ),
    )
}


# fmt: on
def _spec(city: CitySpec | str) -> CitySpec:
    return CITIES[city] if isinstance(city, str) else city


def lidar_files(city: CitySpec | str, scene: SceneSpec | str) -> list[str]:
    """Names of a scene's LiDAR files, in the order south to north, west to east."""
    city = _spec(city)
    scene = city.scene(scene) if isinstance(scene, str) else scene
    suffix = city.las_format.split("-")[0]
    east, north = scene.lidar_grid
    return [f"{scene.name}_{j}_{i}.{suffix}" for j in range(north) for i in range(east)]


def tile_index(scene: SceneSpec, file_name: str) -> tuple[int, int]:
    """(east, north) index of a LiDAR file within its scene."""
    north, east = file_name.rsplit(".", 1)[0].removeprefix(f"{scene.name}_").split("_")
    return int(east), int(north)


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


def file_of(name: str) -> Path:
    """The file of a city that is none of the six."""
    return FOLDER / name / "city.json"


def synthetic_city(name: str) -> CitySpec | None:
    """The city of a name, one of the six or of the project's own; None if there is none.

    Raises InputError for a file that holds no city.
    """
    if name in CITIES:
        return CITIES[name]
    file = file_of(name).absolute()
    if not file.is_file():
        return None
    return _read(file, file.stat().st_mtime_ns)


def city_of(name: str) -> CitySpec:
    """As :func:`synthetic_city`; raises InputError if there is none."""
    city = synthetic_city(name)
    if city is None:
        raise InputError(
            f"{name!r} is no synthetic city", file=file_of(name), remedy="write its file again"
        )
    return city


def read_city(file: str | Path) -> CitySpec:
    """The city of a file. Raises InputError that names the field that is wrong."""
    from pydantic import TypeAdapter, ValidationError  # slow to import, and few cities have a file

    try:
        given = json.loads(Path(file).read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(
            f"cannot be read as JSON: {error}", file=file, remedy="correct it, or make it again"
        ) from None
    try:
        return TypeAdapter(CitySpec).validate_python(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{where}: {first['msg']}", file=file, remedy="correct it, or make it again"
        ) from None


@lru_cache(maxsize=8)
def _read(file: Path, changed_ns: int) -> CitySpec:
    del changed_ns  # another time of the file is another city
    return read_city(file)


def write_city(city: CitySpec, file: str | Path) -> None:
    """Write what a city has other than the defaults."""
    from pydantic import TypeAdapter

    values = TypeAdapter(CitySpec).dump_python(city, mode="json", exclude_defaults=True)
    with atomic_file(file) as scratch:
        scratch.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
