"""The LiDAR of a scene by its headers, and the labels that its density lets one expect."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ..configuration import Configuration
from ..errors import InputError
from ..lidar.survey import SurveyedFile, survey
from ..sheets import Scene
from .findings import Findings, Level

# Measured with bench/density.py: share of visible pixels with a label by points a pixel.
POINTS_PER_PX = (0.0, 0.105, 0.21, 0.42, 0.85, 1.7, 2.6)
LABELLED = {
    "none": (0.0, 0.099, 0.188, 0.347, 0.598, 0.871, 0.95),
    "surface": (0.0, 0.799, 0.852, 0.895, 0.927, 0.947, 0.956),
    "surface_and_images": (0.0, 0.860, 0.884, 0.909, 0.932, 0.949, 0.957),
}
BOX_SLACK = 2.0  # how much denser points may be than their header's box says: it may be half empty


def check_lidar(files: Sequence[Path], scene: Scene, found: Findings) -> list[SurveyedFile]:
    """The files that can be read, after what is to be said of all of them was added."""

    def look(file: Path) -> SurveyedFile | InputError:
        try:
            return survey(file, lidar_crs=scene.lidar_crs or None, geoid=scene.geoid or None)
        except InputError as error:
            return error

    with found.of("LiDAR"), ThreadPoolExecutor(4) as pool:
        looked = list(pool.map(look, files))
    surveyed = [item for item in looked if isinstance(item, SurveyedFile)]
    errors = [item for item in looked if isinstance(item, InputError)]
    for problem, (error, count) in _by_text(errors).items():
        name = error.file or "LiDAR"
        more = f" (and {count - 1} more files)" if count > 1 else ""
        found.say("LiDAR", Level.ERROR, f"{name}{more}: {problem}", error.remedy)
    notes = Counter(note for file in surveyed for note in file.notes)
    for note, count in notes.items():
        of = "" if count == len(files) == 1 else f"{count} of {len(files)} files: "
        found.say("LiDAR", Level.DOUBT, f"{of}{note}")
    surfaces = Counter(file.surface for file in surveyed)
    systems = Counter(file.system for file in surveyed)
    for what, kinds in (("heights", surfaces), ("systems", systems)):
        if len(kinds) > 1:
            said = "; ".join(f"{count}: {kind}" for kind, count in kinds.items())
            found.say("LiDAR", Level.DOUBT, f"files differ in their {what} ({said})")
    if surveyed:
        points = sum(file.points for file in surveyed)
        placed = [file.heights for file in surveyed if file.heights]
        reach = ""
        if placed:
            reach = f", {min(h[0] for h in placed):.0f} to {max(h[1] for h in placed):.0f} m"
        found.say(
            "LiDAR",
            Level.FACT,
            f"{points / 1e6:.1f} M points in {len(surveyed)} "
            f"file{'s' * (len(surveyed) > 1)}, {next(iter(systems))}; heights "
            f"{next(iter(surfaces))}{reach}",
        )
    return surveyed


def _by_text(errors: Sequence[InputError]) -> dict[str, tuple[InputError, int]]:
    """First error and number of errors of each problem."""
    counts = Counter(error.problem for error in errors)
    return {
        problem: (next(e for e in errors if e.problem == problem), count)
        for problem, count in counts.items()
    }


def expected_labels(
    per_m2: float, pixel_m2: float, covered: float, settings: Configuration, found: Findings
) -> None:
    """Say what share of the pixels will carry a label, and doubt it where tiles need more."""
    per_px = per_m2 * pixel_m2

    def share(points: float, fill: str) -> float:
        return float(np.interp(points, POINTS_PER_PX, LABELLED[fill]))

    fill, needed = settings.project.fill, settings.tiles.min_labelled
    expected = share(per_px, fill)
    found.say(
        "labels",
        Level.FACT,
        f"{per_m2:.2g} points/m² by the headers, {per_px:.2g} a pixel; LiDAR on {covered:.0%} of "
        f"the images: some {expected:.0%} of the pixels that both views see of it labelled "
        f"(fill: {fill})",
    )
    if expected >= needed:
        return
    better = [
        name
        for name in LABELLED
        if LABELLED[name] > LABELLED[fill] and share(per_px, name) >= needed
    ]
    remedy = f"set tiles.min_labelled below {expected:.2g}"
    if better:
        remedy = f"set project.fill to {better[0]} ({share(per_px, better[0]):.0%}), or {remedy}"
    dense = share(BOX_SLACK * per_px, fill)
    found.say(
        "labels",
        Level.DOUBT if dense >= needed else Level.ERROR,
        f"some {expected:.0%} of the pixels will have a label, tiles.min_labelled asks for "
        f"{needed:.0%} of a tile",
        remedy,
    )
