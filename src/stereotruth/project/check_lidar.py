"""The LiDAR of a scene before its run: by its headers, and strips against each other."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ..core.errors import InputError, in_number, in_words
from ..core.job import in_own_process
from ..core.products.remote_files import url_of
from ..core.sheets import Scene
from ..core.tables import epoch_year
from ..lidar.frames import Epoch, Epochs
from ..lidar.geoid import candidates_at, named
from ..lidar.ingest import SurveyedFile, ingest, survey
from ..lidar.lattice import Footprint
from ..lidar.point_store import PointStore
from ..lidar.strip_comparison import compare_strips
from .findings import Findings

MOST_POINTS = 6_000_000  # read and compared in seven seconds

AT_ONCE = 8  # files of servers that are looked at
NO_DATUM = (
    "declares no vertical datum",
    "if they are orthometric, set geoid to a grid of their datum for this scene",
)


def check_strips(surveyed: Sequence[SurveyedFile], scene: Scene, found: Findings) -> None:
    """Add what the strips of a scene's files are off.

    Files on servers, and more points than MOST_POINTS, are left to the run; so are files that it
    refuses.
    """
    files = tuple(sorted(file.path for file in surveyed))
    points = sum(file.points for file in surveyed)
    if not files or points > MOST_POINTS or any(url_of(file) for file in files):
        return
    sentence = _sentence(files, scene.lidar_crs, scene.geoid)
    if sentence:
        found.doubt(
            "LiDAR",
            sentence,
            "labels have this in their uncertainty; ingest.strips: adjusted moves the points",
        )


@cache
def _sentence(files: tuple[Path, ...], lidar_crs: str, geoid: str) -> str:
    """What is to be said of the strips of some files: once for all pairs of a site.

    In a process of its own, since some damaged LAZ files crash the decoder.
    """
    try:
        with in_words():
            return in_own_process(partial(_compared, files, lidar_crs, geoid), files[0])
    except InputError:
        return ""


def _compared(files: tuple[Path, ...], lidar_crs: str, geoid: str) -> str:
    logging.getLogger("stereotruth").setLevel(logging.ERROR)  # the check says what is odd of files
    with TemporaryDirectory() as folder:
        stores = [Path(folder) / f"{k}_{file.stem}.points" for k, file in enumerate(files)]
        for file, store in zip(files, stores):
            ingest(file, store, lidar_crs=lidar_crs or None, geoid=geoid or None)
        return compare_strips([PointStore(store) for store in stores]).sentence


def check_lidar(
    files: Sequence[Path],
    scene: Scene,
    found: Findings,
    footprint: Footprint | None = None,
    epoch: Epoch | None = None,
) -> list[SurveyedFile]:
    """The files that can be read, after what is to be said of all of them was added.

    ``footprint``: the ground of which a run reads them; None: all. ``epoch``: of the city's places.
    """
    how = {"lidar_crs": scene.lidar_crs or None, "geoid": scene.geoid or None}
    if epoch is not None:
        how["epochs"] = Epochs(epoch, epoch_year(scene.lidar_epoch))

    def look(file: Path) -> SurveyedFile | InputError:
        try:
            with in_words():
                return survey(file, footprint=footprint, **how)
        except InputError as error:
            return error

    remote = any(url_of(file) for file in files)
    with ThreadPoolExecutor(AT_ONCE if remote else 1) as pool:
        looked = list(pool.map(look, files))
    surveyed = [item for item in looked if isinstance(item, SurveyedFile)]
    errors = [item for item in looked if isinstance(item, InputError)]
    for problem, count in Counter(error.problem for error in errors).items():
        error = next(error for error in errors if error.problem == problem)
        name = error.file or "LiDAR"
        more = f" (and {count - 1} more files)" if count > 1 else ""
        found.fault("LiDAR", f"{name}{more}: {problem}", error.remedy)
    notes = Counter(note for file in surveyed for note in file.notes)
    for note, count in notes.items():
        of = "" if count == len(files) == 1 else f"{count} of {len(files)} files: "
        remedy = _geoids(surveyed) if NO_DATUM[0] in note else ""
        found.doubt("LiDAR", f"{of}{note}", remedy)
    surfaces = Counter(file.surface for file in surveyed)
    systems = Counter(file.system for file in surveyed)
    for what, kinds in (("heights", surfaces), ("systems", systems)):
        if len(kinds) > 1:
            said = "; ".join(f"{count}: {kind}" for kind, count in kinds.items())
            found.doubt("LiDAR", f"files differ in their {what} ({said})")
    if surveyed:
        points = sum(file.points for file in surveyed)
        placed = [file.heights for file in surveyed if file.heights]
        reach = dense = ""
        if area := sum(file.area_m2 for file in surveyed):
            dense = f", at least {points / area:.2g} points/m² (over the boxes of their headers)"
        if placed:
            reach = f", {min(h[0] for h in placed):.0f} to {max(h[1] for h in placed):.0f} m"
        found.fact(
            "LiDAR",
            f"{points / 1e6:.1f} M points in {len(surveyed)} "
            f"file{'s' * (len(surveyed) > 1)}{dense}, {next(iter(systems))}; heights "
            f"{next(iter(surfaces))}{reach}",
        )
        if footprint is not None:
            _say_what_is_read(surveyed, found)
    return surveyed


def _geoids(surveyed: Sequence[SurveyedFile]) -> str:
    """What to do about undeclared heights, with the geoids that there are of the place."""
    box = next((file.box for file in surveyed if file.box), None)
    of_place = candidates_at((box[0] + box[2]) / 2, (box[1] + box[3]) / 2) if box else []
    return NO_DATUM[1] + (f"; of the place PROJ knows {named(of_place)}" if of_place else "")


def _say_what_is_read(surveyed: Sequence[SurveyedFile], found: Findings) -> None:
    """How much of the files a run reads."""
    touched = sum(file.read[0] > 0 for file in surveyed)
    points, size = (sum(file.read[k] for file in surveyed) for k in (0, 1))
    every = sum(file.points for file in surveyed), sum(file.bytes for file in surveyed)
    found.fact(
        "LiDAR",
        f"a run reads {touched} of {in_number(len(surveyed), 'file')}, {points / 1e6:.1f} of "
        f"{every[0] / 1e6:.1f} M points, {size / 1e6:.1f} of {every[1] / 1e6:.1f} MB",
    )
