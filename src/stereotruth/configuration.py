"""The whole configuration: every key with its type, limits, default and meaning, from the stages.

The defaults stand in the classes alone. ``config/config.yaml``, for who edits it, and the reference
tables of ``config/README.md`` are written from them by

    python -m stereotruth.configuration
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import Field

from .alignment.settings import Settings as Alignment
from .dataset.settings import Dataset, Evaluation, Limits, Tiles
from .disparity.settings import Project
from .epipolar.settings import Settings as Rectify
from .errors import InputError
from .evaluation.audit.settings import Settings as Audit
from .lidar.settings import Settings as Ingest
from .matching.benchmark.settings import DATASETS, METHODS
from .matching.benchmark.settings import Settings as Benchmark
from .matching.networks.training_settings import Training
from .matching.scenes.settings import Predict
from .report.settings import Settings as Report
from .settings import Flag, Text, Unit, Whole, settings
from .settings_text import Key, attributes_of, check, fields_of, meaning, nested, values_of
from .sheets import City, Image, Scene
from .simulate.settings import Settings as Simulate

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


@settings
class Dask:
    """The configuration's section dask."""

    scheduler_address: Annotated[Text | None, Unit("address")] = None
    """Dask scheduler (`tcp://host:8786`) whose workers make the blocks of the rules `project`,
    `predict_scene` and `dsm`, for who has a Dask cluster that works on one scene with scheduling of
    its own; null: threads of the job. The workers need this package and the same paths"""


@settings
class Configuration:
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

    simulate: Simulate = field(default_factory=Simulate)
    ingest: Ingest = field(default_factory=Ingest)
    alignment: Alignment = field(default_factory=Alignment)
    rectify: Rectify = field(default_factory=Rectify)
    project: Project = field(default_factory=Project)
    tiles: Tiles = field(default_factory=Tiles)
    evaluation: Evaluation = field(default_factory=Evaluation)
    quality: Limits = field(default_factory=Limits)
    dataset: Dataset = field(default_factory=Dataset)

    strips: Annotated[Strips | dict[str, Strips], Unit("number, or scene: number")] = 1
    """jobs among which the grid of a scene is shared, each for some rows of blocks of 1024 px; for
    any cluster that Snakemake submits jobs to, without a Dask that runs there. The bytes are those
    of one job"""

    dask: Dask = field(default_factory=Dask)
    report: Report = field(default_factory=Report)
    benchmark: Benchmark = field(default_factory=Benchmark)

    training: Training = field(default_factory=Training)
    """how the networks are trained (`results/train/<dataset>/<method>/`), see [below](#training);
    an entry of `benchmark.methods` may have a `training` of its own, whose keys precede"""

    predict: Predict = field(default_factory=Predict)
    audit: Audit = field(default_factory=Audit)

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


BY_NAME = {"datasets": DATASETS, "methods": METHODS}
BELOW = ("training", "benchmark.methods")  # have tables of their own
TABLE = re.compile(r"(<!-- keys: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rows(of: Any, before: str = "") -> Iterator[str]:
    """The rows of the reference table: key; unit, values; effect."""
    for name, key in fields_of(of).items():
        full = f"{before}{name}"
        inner, by_name = nested(key.type)
        if inner is None or key.meaning:
            yield row(full, key)
        if inner is not None and full not in BELOW:
            yield from rows(inner, f"{full}.<name>." if by_name else f"{full}.")


def row(name: str, key: Key) -> str:
    """One row."""
    return f"| `{name}` | {values_of(key)} | {key.meaning} |".replace("|  |", "| |")


def columns(of: Any) -> Iterator[str]:
    """The table of a sheet's columns."""
    yield from ("| column | meaning |", "|---|---|")
    yield from (f"| `{name}` | {key.meaning} |" for name, key in fields_of(of).items())


def with_tables(guide: str) -> str:
    """The text of ``config/README.md`` with its tables as they follow from the classes."""
    head = ("| key | unit, values | effect |", "|---|---|---|")
    tables = {
        "configuration": [*head, *rows(Configuration)],
        "training": [*head, *rows(Training, "training.")],
        "scenes": columns(Scene),
        "cities": columns(City),
        "images": columns(Image),
    }

    def table(found: re.Match[str]) -> str:
        return found[1] + "".join(f"{line}\n" for line in tables[found[2]]) + found[3]

    return TABLE.sub(table, guide)


HEAD = """\
# Every key with its default; units and effects are in config/README.md. Written by
# python -m stereotruth.configuration. Your own scenes: write a file that overrides what differs,
# and pass it with --configfile.
"""
LONGEST_LINE = 130  # characters
SHORTEST_REMARK = 20


def defaults_text() -> str:
    """The text of ``config/config.yaml``: every key with its default and what it is."""
    lines = list(_default_lines(Configuration, Configuration(), ""))
    return HEAD + "\n".join(lines) + "\n"


def _default_lines(of: Any, values: Any, indent: str) -> Iterator[str]:
    """Lines of a section; a blank one before each section of the whole."""
    for name, key in attributes_of(of).items():
        value, (inner, by_name) = getattr(values, name), nested(key.type)
        if not indent and inner is not None:
            yield ""
        if inner is not None and not by_name and key.name != "strips":
            yield f"{indent}{key.name}:"
            yield from _default_lines(inner, value, indent + "  ")
        elif inner is not None:
            yield f"{indent}{key.name}: # by name; null takes one of these away"
            entries = BY_NAME[key.name].items()
            yield from (f"{indent}  {entry}: {_yaml(given)}" for entry, given in entries)
        else:
            yield _with_remark(f"{indent}{key.name}: {_yaml(value)}", key)


def _yaml(value: Any) -> str:
    """A value on one line."""
    plain = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")


def _with_remark(line: str, key: Key) -> str:
    """A line with what the key is behind it, cut at a word where it is long."""
    remark = meaning(key).replace("`", "")
    room = LONGEST_LINE - len(line) - len(" # ")
    if not remark or room < SHORTEST_REMARK:
        return line
    return f"{line} # {textwrap.shorten(remark, room, placeholder=' …')}"


USAGE = """\
Usage: python -m stereotruth.configuration [FOLDER]
Writes config.yaml with all defaults, and the tables of keys in README.md, in FOLDER (config).
For developers, in a checkout: the reference is made of the classes that check a configuration.
"""

if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv[1:]):
        sys.stdout.write(USAGE)
        sys.exit()
    config = Path(*sys.argv[1:] or ["config"])
    guide = config / "README.md"
    if not guide.is_file():
        sys.exit(f"no {guide}. {USAGE.splitlines()[0]}")
    guide.write_text(with_tables(guide.read_text(encoding="utf-8")), encoding="utf-8")
    (config / "config.yaml").write_text(defaults_text(), encoding="utf-8")
