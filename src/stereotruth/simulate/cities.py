"""The six synthetic cities as plain values, and which files each of them is made of.

Nothing here computes or reads anything, so that a workflow can plan with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

LEFT_GSD_M = 0.65
RIGHT_GSD_M = 0.80


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
class Character:
    """What a city looks like.

    ``relief_m``: height range aimed at over the world; ``valley``: share of it that is plain;
    ``wavelength_m``: that of the largest relief; ``max_slope_deg``: nothing is steeper.
    ``river_m``: width of the river, 0 for none; ``lakes``: depth of depressions below the water
    level, 0 for none. ``zones``: weight of each land use, see ``world.ZONE_KINDS``. ``towers_m``:
    range of heights of high buildings. ``trees``: factor on the number of trees. ``zone_m``: mean
    distance between the centres of zones.
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


@dataclass(frozen=True)
class CitySpec:
    """A synthetic city: where it lies, what it looks like, and its scenes.

    ``lon``, ``lat`` in degrees; ``epsg``: the UTM zone of its LiDAR; ``base_height_m``: ellipsoidal
    height of its lowest ground; ``world_seed`` draws everything that is built.
    ``margin_m``: ground built around the scenes, more than any ray leans.
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

    def scene(self, name: str) -> SceneSpec:
        """The scene of that name; KeyError if there is none."""
        for scene in self.scenes:
            if scene.name == name:
                return scene
        raise KeyError(f"{self.name} has no scene {name}")


def _one(name: str, cols: int, rows: int, seed: int, **more) -> tuple[SceneSpec, ...]:
    return (
        SceneSpec(f"{name}-1", (0.0, 0.0), cols, rows, seed, gap_m=(845.0, 748.0), **more),
    )


CITIES: dict[str, CitySpec] = {
    city.name: city
    for city in (
        CitySpec(
            "Wuhan",
            114.305,
            30.593,
            32650,
            12.0,
            11,
            Character(
                6,
                0.2,
                1500,
                8,
                150,
                1.5,
                {"towers": 5, "slabs": 4, "lowrise": 2, "industry": 1, "park": 1.2},
                (45, 98),
                0.8,
            ),
            _one("Wuhan", 2500, 3400, 101),
        ),
        CitySpec(
            "Hengyang",
            112.572,
            26.893,
            32649,
            48.0,
            12,
            Character(
                18,
                0.3,
                1300,
                12,
                190,
                0,
                {"towers": 1, "slabs": 2, "lowrise": 2, "village": 2, "fields": 5, "park": 1},
                (30, 60),
                0.8,
            ),
            _one("Hengyang", 2500, 3400, 102),
            las_format="las-1.2-1",
        ),
        CitySpec(
            "Shaoguan",
            113.597,
            24.811,
            32649,
            72.0,
            13,
            Character(
                360, 0.42, 2300, 40,
                90,
                0,
                {"towers": 1, "slabs": 2, "lowrise": 2, "village": 1, "fields": 1, "forest": 3},
                (28, 55),
                1.0,
            ),
            _one("Shaoguan", 2500, 3400, 103),
        ),
        CitySpec(
            "Kunming",
            102.712,
            25.041,
            32648,
            1858.0,
            14,
            Character(
                60,
                0.25,
                1500,
                20,
                0,
                1.5,
                {
                    "towers": 1.5,
                    "slabs": 3,
                    "lowrise": 2,
                    "industry": 2,
                    "park": 1.5,
                    "fields": 1.5,
                    "forest": 1,
                },
                (40, 75),
                1.0,
            ),
            _one("Kunming", 2500, 3400, 104),
            sun_elevation_deg=58.0,
        ),
        CitySpec(
            "Yingde",
            113.405,
            24.186,
            32649,
            36.0,
            15,
            Character(
                400, 0.36, 2500, 42,
                80,
                0,
                {"slabs": 1, "lowrise": 1.5, "village": 2.5, "fields": 3, "forest": 4, "bare": 1},
                (20, 40),
                1.15,
            ),
            _one("Yingde", 2500, 3400, 105, ascending=True),
        ),
        CitySpec(
            "Qichun",
            115.433,
            30.232,
            32650,
            18.0,
            16,
            Character(
                70,
                0.3,
                1500,
                24,
                110,
                1.0,
                {
                    "towers": 0.6,
                    "slabs": 2,
                    "lowrise": 2,
                    "village": 3,
                    "industry": 1,
                    "fields": 4.5,
                    "forest": 2,
                    "park": 1,
                },
                (26, 55),
                0.9,
            ),
            (
                SceneSpec("Qichun-1", (-1080.0, 170.0), 3650, 3650, 106, lidar_grid=(3, 2),
                          gap_m=(845.0, 812.0)),
                SceneSpec("Qichun-2", (1080.0, -170.0), 3650, 3650, 107, lidar_grid=(3, 2),
                          gap_m=(845.0, 812.0)),
            ),
        ),
    )
}


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
