"""The LiDAR of a scene before its run: its headers, its strips, and the sign of its geoid."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..align.alignment import Alignment, GcpResidual
from ..align.doubts import (
    FEWEST_GCPS,
    WIDEST_M,
    agreeing,
    control_points_of,
    lift_by_rpcs,
    off_at_gcps,
)
from ..core.errors import InputError, in_number, in_words
from ..core.job import in_own_process
from ..core.products.remote_files import url_of
from ..core.sheets import Scene
from ..core.tables import epoch_year
from ..lidar.frames import Epoch, Epochs
from ..lidar.geoid import GeoidGrid, candidates_at, named
from ..lidar.ingest import SurveyedFile, ingest, survey
from ..lidar.lattice import Footprint, apart
from ..lidar.point_store import PointStore
from ..lidar.strip_comparison import compare_strips
from .findings import Findings

MOST_POINTS = 6_000_000  # read and compared in seven seconds
LEAST_UNDULATION_M = 5.0  # twice of it is more than a storey
CLEAR = 3.0  # tolerances by which no geoid, the geoid and twice the geoid are told apart

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
    how = {"lidar_crs": lidar_crs or None, "geoid": geoid or None}
    return _in_stores(files, how, lambda stores: compare_strips(stores).sentence)


def _in_stores(
    files: Sequence[Path], how: Mapping[str, Any], ask: Callable[[list[PointStore]], Any]
) -> Any:
    """What is asked of the points of files, which are read into stores for that."""
    logging.getLogger("stereotruth").setLevel(logging.ERROR)  # the check says what is odd of files
    with TemporaryDirectory() as folder:
        stores = [Path(folder) / f"{k}_{file.stem}.points" for k, file in enumerate(files)]
        for file, store in zip(files, stores):
            ingest(file, store, **how)
        return ask([PointStore(store) for store in stores])


def check_geoid(
    surveyed: Sequence[SurveyedFile],
    scene: Scene,
    alignment: Alignment,
    pixel: float,
    found: Findings,
) -> bool:
    """Whether heights are off by twice the geoid, H - N in the place of H + N, which is an error.

    Told by the points around control points of the ``alignment``, unless more than MOST_POINTS are
    to be read for that; without control points by the heights of its RPCs. ``pixel``: size on the
    ground, m. A geoid of less than LEAST_UNDULATION_M says nothing.
    """
    lifted = [f for f in surveyed if f.surface.startswith("orthometric") and f.box and f.heights]
    if not (scene.geoid and lifted):
        return False
    gcps = control_points_of(alignment)
    lon, lat = np.array([(g.lon, g.lat) for g in gcps] or [alignment.middle[:2]]).T
    try:
        undulation_m = float(np.median(GeoidGrid(Path(scene.geoid))(lon, lat)))
    except InputError:  # said of the files
        return False
    if abs(undulation_m) < LEAST_UNDULATION_M:
        return False
    if gcps:
        told = _off_at_gcps(lifted, scene, gcps, pixel, undulation_m)
    else:
        told = _off_by_rpcs(lifted, alignment, undulation_m)
    if told:
        found.fault(
            "heights",
            f"{scene.geoid}: with this geoid the LiDAR lies {2 * abs(undulation_m):.1f} m too "
            f"{'high' if undulation_m > 0 else 'low'}, {told}: twice its undulation of "
            f"{undulation_m:+.1f} m, whose sign is wrong",
            "heights above the ellipsoid are H + N: the values of this grid here should be about "
            f"{-undulation_m:+.1f} m" + (", or the GCPs have heights of H - N" if gcps else ""),
        )
    elif gcps and all(any(g.used for g in fit.gcps) for fit in alignment.fits):
        _hold_gcps_against_rpcs(alignment, scene, undulation_m, found)
    return bool(told)


def _hold_gcps_against_rpcs(
    alignment: Alignment, scene: Scene, undulation_m: float, found: Findings
) -> None:
    """A doubt if the RPCs alone see the control points twice the undulation off: the LiDAR agrees
    with them, so its heights are as wrong."""
    lift_m, sigma_m = lift_by_rpcs(alignment)
    if 2 * abs(lift_m + 2 * undulation_m) < abs(undulation_m) > CLEAR * sigma_m:
        found.doubt(
            "heights",
            f"{scene.gcps}: by the RPCs alone the GCPs lie {abs(lift_m):.0f} ± {sigma_m:.0f} m too "
            f"{'low' if lift_m > 0 else 'high'}, and the LiDAR with them: about twice the "
            f"undulation of {undulation_m:+.1f} m of {scene.geoid}",
            "heights above the ellipsoid are H + N: look at the sign of the geoid grids of both",
        )


def _off_at_gcps(
    files: Sequence[SurveyedFile],
    scene: Scene,
    gcps: Sequence[GcpResidual],
    pixel: float,
    undulation_m: float,
) -> str:
    """At which control points the files are off by twice the undulation; empty if they are not."""
    paths, fitting = set(), 0
    for gcp in gcps:
        around = [file for file in files if not apart(file.box, (gcp.lon, gcp.lat) * 2)]
        lifted = gcp.height + 2 * undulation_m
        fitting += any(file.heights[0] <= lifted <= file.heights[1] for file in around)
        paths |= {file.path for file in around}
    if fitting < FEWEST_GCPS:  # by the headers; so nothing is read where all is well, mostly
        return ""
    ordered = sorted(paths)
    near = Footprint.around([np.array([[g.lon], [g.lat]]) for g in gcps], WIDEST_M)
    how = {"lidar_crs": scene.lidar_crs or None, "geoid": scene.geoid, "footprint": near}
    try:
        with in_words():
            if sum(survey(path, **how).read[0] for path in ordered) > MOST_POINTS:
                return ""
            ask = partial(off_at_gcps, gcps, pixel=pixel)
            found, tolerance = in_own_process(partial(_in_stores, ordered, how, ask), ordered[0])
    except InputError:
        return ""
    none, once, twice = (agreeing(found, k * undulation_m, tolerance) for k in (0, 1, 2))
    clear = len(found) >= FEWEST_GCPS and abs(undulation_m) > CLEAR * tolerance
    certain = clear and 2 * none < len(found) < 2 * twice and once < twice
    return f"at {twice} of {len(found)} GCPs" if certain else ""


def _off_by_rpcs(files: Sequence[SurveyedFile], alignment: Alignment, undulation_m: float) -> str:
    """Whether the RPCs' heights are those of the files without twice the undulation.

    None of the files' heights may be near those of the RPCs: a bird is far above all others.
    """
    lowest, highest = zip(*(file.heights for file in files))
    bottom, top = min(lowest), max(highest)
    for sensor in (alignment.left, alignment.right):
        low, high = sensor.rpc.ground_box[4:]
        spare = (high - low) / 4
        if high - low > abs(undulation_m) or (bottom <= high + spare and top >= low - spare):
            return ""
        if not (bottom - 2 * undulation_m <= high and low <= top - 2 * undulation_m):
            return ""
    return f"by the RPCs' heights of {low:.0f} to {high:.0f} m"


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
