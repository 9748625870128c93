"""Make synthetic cities without a workflow.

python -m stereocities Qichun data/synthetic/Qichun
python -m stereocities place.laz twin --crs EPSG:2154
python -m stereocities gcps config/gcps
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from pathlib import Path

from stereotruth.core.config.configuration import Simulate
from stereotruth.core.errors import InputError

from .cities import CITIES, CitySpec, SceneSpec, lidar_files, read_city
from .control_points import simulate_points, write_gcps
from .lidar import simulate_lidar_tile
from .render import simulate_image
from .truth import simulate_truth
from .twin_world import twin_city

log = logging.getLogger("stereotruth")


SEED = 1


def make_scene(
    city: CitySpec, scene: SceneSpec, folder: Path, *, spacing_m: float, seed: int
) -> None:
    """All files of a scene under ``folder``, as the workflow makes them, and gcps.csv."""
    jobs = [
        ("points", lambda: simulate_points(
            city, scene, folder / "gcps.csv", folder / "gcps_exact.csv",
            folder / "checkpoints.csv", seed=seed)),
        ("left", lambda: simulate_image(city, scene, "left", folder / "left.tif", seed=seed)),
        ("right", lambda: simulate_image(city, scene, "right", folder / "right.tif", seed=seed)),
        *(
            (name, lambda name=name: simulate_lidar_tile(
                city, scene, name, folder / "lidar" / name, spacing_m=spacing_m, seed=seed))
            for name in lidar_files(city, scene)
        ),
        ("truth", lambda: simulate_truth(city, scene, folder / "truth.zarr")),
    ]  # fmt: skip
    for name, job in jobs:
        start = time.perf_counter()
        job()
        log.info("%s %s: %.1f s", scene.name, name, time.perf_counter() - start)


def _city(what: str, crs: str) -> CitySpec:
    """What is asked for: a city by name or by its file, or the twin of a place."""
    if what in CITIES:
        return CITIES[what]
    if what.lower().endswith(".json"):
        return read_city(what)
    if what.lower().endswith((".las", ".laz")):
        return twin_city("Twin", what, crs=crs)
    raise InputError(
        f"{what!r} is no city", remedy=f"name one of {', '.join(CITIES)}, a city.json, LAS or LAZ"
    )


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m stereocities", description=__doc__)
    parser.add_argument(
        "what",
        help=f"a city ({', '.join(CITIES)}), city.json of one, the LAS or LAZ file of a place to "
        "make a twin of, or gcps for all GCP files",
    )
    parser.add_argument("folder", type=Path, help="where to write <scene>/… (or <scene>.csv)")
    parser.add_argument(
        "--spacing-m", type=float, default=Simulate().lidar_spacing_m, help="LiDAR pulse spacing"
    )
    parser.add_argument("--seed", type=int, default=SEED, help="draws all measurement noise")
    parser.add_argument("--crs", default="", help="of a place's points, if they declare none")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        if given.what == "gcps":
            for path in write_gcps(given.folder, seed=given.seed):
                log.info("wrote %s", path)
            return 0
        city = _city(given.what, given.crs)
        for scene in city.scenes:
            make_scene(city, scene, given.folder / scene.name,
                       spacing_m=given.spacing_m, seed=given.seed)  # fmt: skip
    except InputError as error:
        log.error("error: %s", error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
