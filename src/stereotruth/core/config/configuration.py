"""The whole configuration: what users write, checked."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from ..errors import InputError
from .labels import (
    Alignment,
    Dataset,
    Evaluation,
    Ingest,
    Limits,
    Project,
    Rectify,
    Report,
    Simulate,
    Tiles,
)
from .methods import DATASETS, Audit, Benchmark, Predict, Training
from .section import Flag, Section, Text, Unit, Whole, check

Strips = Annotated[Whole, Field(ge=1, le=1000)]


REPLACED = {
    "occlusion.method": "project.recipe: surface takes the place of both, paper that of "
    "correlation; there is nothing in place of geometric and none",
    "occlusion.window": "it is project.window now",
    "occlusion.correlation_threshold": "it is project.correlation_threshold now",
    "project.representative": "project.recipe: surface takes the place of top, paper that of paper",
    "project.fill": "project.recipe: surface labels pixels between points; there is nothing in "
    "place of none (drop the status labelled_between) and of surface_and_images",
}
"""Keys of earlier versions, and what takes their place."""


class Dask(Section):
    """The configuration's section dask."""

    scheduler_address: Annotated[Text | None, Unit("address")] = None
    """Dask scheduler (`tcp://host:8786`) whose workers make the blocks of the rules `project`,
    `predict_scene` and `dsm`, for who has a Dask cluster that works on one scene with scheduling of
    its own; null: threads of the job. The workers need this package and the same paths"""


class Configuration(Section):
    """All keys of ``config/config.yaml``."""

    scenes: Annotated[Text, Unit("path")] = "config/scenes.tsv"
    """the scenes sheet, see below"""

    cities: Annotated[Text, Unit("path")] = "config/cities.tsv"
    """the cities sheet, see below"""

    images: Annotated[Text, Unit("path")] = ""
    """the images sheet of sites, see below; empty: scenes name files"""

    strict: Flag = False
    """true: warnings about the alignment (any ground control point left out), the splits or a limit
    of `quality` end the run"""

    seed: Annotated[Whole, Field(ge=0), Unit("whole number")] = 20230213
    """of everything random: measurement noise of the synthetic cities, splits"""

    simulate: Simulate = Field(default_factory=Simulate)
    ingest: Ingest = Field(default_factory=Ingest)
    alignment: Alignment = Field(default_factory=Alignment)
    rectify: Rectify = Field(default_factory=Rectify)
    project: Project = Field(default_factory=Project)
    tiles: Tiles = Field(default_factory=Tiles)
    evaluation: Evaluation = Field(default_factory=Evaluation)
    quality: Limits = Field(default_factory=Limits)
    dataset: Dataset = Field(default_factory=Dataset)

    strips: Annotated[Strips | dict[str, Strips], Unit("number, or scene: number")] = 1
    """jobs among which the grid of a scene is shared, each for some rows of blocks of 1024 px; for
    any cluster that Snakemake submits jobs to, without a Dask that runs there. The bytes are those
    of one job"""

    dask: Dask = Field(default_factory=Dask)
    report: Report = Field(default_factory=Report)
    benchmark: Benchmark = Field(default_factory=Benchmark)

    training: Training = Field(default_factory=Training)
    """how the networks are trained (`results/train/<dataset>/<method>/`), see [below](#training);
    an entry of `benchmark.methods` may have a `training` of its own, whose keys precede"""

    predict: Predict = Field(default_factory=Predict)
    audit: Audit = Field(default_factory=Audit)

    @classmethod
    def of(cls, config: Mapping[str, Any], file: str | Path = "config") -> Configuration:
        """What the user wrote. Raises InputError that names ``file`` and the first wrong key."""
        _refuse_replaced(config, file)
        return check(_without_unnamed(config), cls, file)


def _without_unnamed(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The configuration without built-in datasets, if it names others and none of the built-in."""
    benchmark = config.get("benchmark")
    datasets = benchmark.get("datasets") if isinstance(benchmark, Mapping) else None
    if not isinstance(datasets, Mapping) or not datasets or set(datasets) & set(DATASETS):
        return config
    unnamed = dict.fromkeys(DATASETS)
    return {**config, "benchmark": {**benchmark, "datasets": {**unnamed, **datasets}}}


def _refuse_replaced(config: Mapping[str, Any], file: str | Path) -> None:
    """Raise InputError that names the first key of REPLACED which is given."""
    for name, remedy in REPLACED.items():
        section, key = name.split(".")
        given = config.get(section)
        if isinstance(given, Mapping) and key in given:
            raise InputError(f"{name}: there is no such key any more", file=file, remedy=remedy)
