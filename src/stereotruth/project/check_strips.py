"""Strips of a scene's LiDAR compared before a run, where that takes seconds."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

from ..core.errors import InputError, in_words
from ..core.job import in_own_process
from ..core.products.remote_files import url_of
from ..core.sheets import Scene
from ..lidar.ingest import SurveyedFile, ingest
from ..lidar.point_store import PointStore
from ..lidar.strip_comparison import compare_strips
from .findings import Findings, Level

MOST_POINTS = 6_000_000  # read and compared in seven seconds


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
        found.say(
            "LiDAR",
            Level.DOUBT,
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
