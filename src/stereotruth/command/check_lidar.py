"""The LiDAR of a scene by its headers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError, in_words
from ..lidar.survey import SurveyedFile, survey
from ..sheets import Scene
from .findings import Findings, Level

NO_DATUM = (
    "declares no vertical datum",
    "if they are orthometric, set geoid to a grid of their datum for this scene",
)


def check_lidar(files: Sequence[Path], scene: Scene, found: Findings) -> list[SurveyedFile]:
    """The files that can be read, after what is to be said of all of them was added."""

    def look(file: Path) -> SurveyedFile | InputError:
        try:
            with in_words():
                return survey(file, lidar_crs=scene.lidar_crs or None, geoid=scene.geoid or None)
        except InputError as error:
            return error

    looked = [look(file) for file in files]
    surveyed = [item for item in looked if isinstance(item, SurveyedFile)]
    errors = [item for item in looked if isinstance(item, InputError)]
    for problem, (error, count) in _by_text(errors).items():
        name = error.file or "LiDAR"
        more = f" (and {count - 1} more files)" if count > 1 else ""
        found.say("LiDAR", Level.ERROR, f"{name}{more}: {problem}", error.remedy)
    notes = Counter(note for file in surveyed for note in file.notes)
    for note, count in notes.items():
        of = "" if count == len(files) == 1 else f"{count} of {len(files)} files: "
        remedy = NO_DATUM[1] if NO_DATUM[0] in note else ""
        found.say("LiDAR", Level.DOUBT, f"{of}{note}", remedy)
    surfaces = Counter(file.surface for file in surveyed)
    systems = Counter(file.system for file in surveyed)
    for what, kinds in (("heights", surfaces), ("systems", systems)):
        if len(kinds) > 1:
            said = "; ".join(f"{count}: {kind}" for kind, count in kinds.items())
            found.say("LiDAR", Level.DOUBT, f"files differ in their {what} ({said})")
    if surveyed:
        points = sum(file.points for file in surveyed)
        placed = [file.heights for file in surveyed if file.heights]
        reach = dense = ""
        if area := sum(file.area_m2 for file in surveyed):
            dense = f", at least {points / area:.2g} points/m² (over the boxes of their headers)"
        if placed:
            reach = f", {min(h[0] for h in placed):.0f} to {max(h[1] for h in placed):.0f} m"
        found.say(
            "LiDAR",
            Level.FACT,
            f"{points / 1e6:.1f} M points in {len(surveyed)} "
            f"file{'s' * (len(surveyed) > 1)}{dense}, {next(iter(systems))}; heights "
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
