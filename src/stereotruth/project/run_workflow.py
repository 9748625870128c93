"""The workflow in this folder, by Snakemake: what it can make, and a run of it."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..core.config.methods import DATASETS
from ..core.config.section import read_mapping
from ..core.errors import InputError, did_you_mean
from .project import (
    CONFIG,
    FILES,
    configured,
    names_scenes,
    read_scenes,
    require_project,
    require_scenes,
)

TARGETS = {
    "tiles/<City>": "the benchmark tiles of a city (without a target: of all cities)",
    "dataset": "the tiles of all cities, in the layout of the published dataset",
    "originals": "crops of the original images with corrected cameras (dataset.originals)",
    "verify": "all tiles, held against the checksums of their manifests",
    "report": "the pages of all cities; results/report/<City>/index.html that of one",
    "evaluate": "figures from the images, and against the exact truth of synthetic cities",
    "results/project/<City>/<scene>.zarr": "disparity, status and uncertainty of a whole scene",
    "results/adjust/<City>.json": "corrections and residuals of images that pairs share",
    "closure": "what the labels of three pairs of images say of each other",
    "results/predict/<City>/<scene>/<method>_dsm.tif": "surface model of a scene by a method",
    "score_dsm/<City>/<scene>/<method>": "that surface model, held against the LiDAR",
    "benchmark": "the methods that each dataset names, scored and compared",
    "benchmark/<dataset>/<method>": "the scores of one method on one dataset",
    "submission/<dataset>/<method>": "the results of a method, as others submit them",
    "results/train/<dataset>/<method>/training.json": "a network, trained",
    "audit/<dataset>": "what is wrong with a stereo dataset",
    "training_cities": "synthetic cities to train on",
}

# Where a path has the name of a city, of a dataset.
STAGES = "ingest|align|refine|rectify|project|heights|export|evaluate|report|predict"
IN_PATH = (
    (re.compile(rf"(tiles|score_dsm|results/({STAGES}))/(?P<name>[^/]+)(/.+)?"), "city"),
    (re.compile(r"(benchmark|audit|submission|results/train)/(?P<name>[^/]+)(/.+)?"), "dataset"),
)

# Targets that are made of a dataset by its name, or of built-in cities by their own.
WITHOUT_SCENES = re.compile(
    r"(benchmark|audit|submission|results/(train|match|training_cities))/.+|training_cities"
)

EXAMPLE = "--example"  # the synthetic cities that come with the package
CONFIG_OPTIONS = ("--configfile", "--configfiles")
OWN_WORDS = re.compile(r"--(logger|verbose)(=|$)")  # who asks for Snakemake's own gets them
CORES = re.compile(r"--(cores|jobs|profile|executor)(=|$)|-[cj]")


def _names(configfiles: Sequence[Path] | None = None) -> dict[str, list[str]]:
    """What may stand in the place of a name of TARGETS, those of scenes with their cities."""
    settings, _ = configured(configfiles)
    cities, scenes = read_scenes(settings)
    if not names_scenes(configfiles):  # the built-in cities are made with --example alone
        cities, scenes = {}, {}
    of_cities = {scene.city for scene in scenes.values()}
    return {
        "<City>/<scene>": [f"{scene.city}/{name}" for name, scene in scenes.items()],
        "<City>": [city for city in cities if city in of_cities],
        "<scene>": list(scenes),
        "<dataset>": [name for name, entry in settings.benchmark.datasets.items() if entry],
        "<method>": [name for name, entry in settings.benchmark.methods.items() if entry],
    }


def list_targets(configfiles: Sequence[Path] | None = None) -> list[str]:
    """A line for each target, and the cities, scenes, datasets and methods to put into them."""
    width = max(map(len, TARGETS))
    return [f"{name:{width}}  {meaning}" for name, meaning in TARGETS.items()] + [
        f"{name}: {', '.join(values[:12])}{' …' if len(values) > 12 else ''}"
        for name, values in _names(configfiles).items()
        if values and "/" not in name
    ]


def completions(given: Sequence[str]) -> list[str]:
    """What may stand after these arguments of a run: targets, or a profile of the package."""
    if given[-1:] in (["--profile"], ["--workflow-profile"]):
        return sorted(file.parent.name for file in (FILES / "profiles").glob("*/config.yaml"))
    targets = [*TARGETS, "results/report/<City>/index.html"]
    for name, values in _names(config_files(given)).items():
        targets = [
            target.replace(name, value)
            for target in targets
            for value in (values if name in target else [""])
        ]
    return targets


def rules() -> list[str]:
    """Names of the workflow's rules."""
    return [
        name
        for file in sorted((FILES / "workflow" / "rules").glob("*.smk"))
        for name in re.findall(r"^rule (\w+):", file.read_text(encoding="utf-8"), re.MULTILINE)
    ]


def need_scenes(given: Sequence[str], configfiles: Sequence[Path] | None = None) -> bool:
    """Whether the targets of a run are made of the scenes sheet."""
    targets = words_before_options(given)
    if targets == ["benchmark"]:
        settings, _ = configured(configfiles)
        return any(settings.benchmark.datasets.get(name) for name in DATASETS)
    return not targets or not all(map(WITHOUT_SCENES.fullmatch, targets))


def words_before_options(given: Sequence[str]) -> list[str]:
    """The targets among the arguments of a run."""
    words = list(given)
    first_option = next((k for k, word in enumerate(words) if word.startswith("-")), len(words))
    return [word.rstrip("/") for word in words[:first_option]]


def _names_for(word: str, configfiles: Sequence[Path] | None) -> list[str]:
    """What a word that is no option may be: rules, or its path with each city or dataset in it.

    Empty for a path of which this is not known.
    """
    if "/" not in word:
        return [] if Path(word).exists() else [*rules(), "all"]
    for pattern, kind in IN_PATH:
        if found := pattern.fullmatch(word):
            settings, _ = configured(configfiles)
            datasets = [name for name, entry in settings.benchmark.datasets.items() if entry]
            names = list(read_scenes(settings)[0]) if kind == "city" else datasets
            start, end = found.span("name")
            return [word[:start] + name + word[end:] for name in names]
    return []


def refuse_unknown(given: Sequence[str], configfiles: Sequence[Path] | None = None) -> None:
    """Raise InputError for a target that is a typo, with what it may mean.

    ``given``: arguments of a run; targets are the words before the first option. Paths without a
    city or dataset at a known place are left to Snakemake.
    """
    for word in words_before_options(given):
        names = _names_for(word, configfiles)
        if names and word not in names:
            remedy = did_you_mean(word, names, "stereotruth targets lists them")
            raise InputError(f"{word}: no such target", remedy=remedy)


def arguments_for(given: Sequence[str]) -> list[str]:
    """Arguments of Snakemake for what stands after ``stereotruth run``."""
    given = [word for word in _with_profiles(given) if word != "--"]
    configured = any(word.split("=")[0] in CONFIG_OPTIONS for word in given)
    if EXAMPLE in given:
        given.remove(EXAMPLE)
    elif not configured:
        require_project()
        given += ["--configfile", CONFIG] if Path(CONFIG).is_file() else []
    arguments = ["--snakefile", str(FILES / "Snakefile"), *given]
    if not any(map(CORES.match, given)):
        arguments += ["--cores", "all"]
    return arguments


def _with_profiles(given: Sequence[str]) -> list[str]:
    """Arguments with the path of a profile that comes with the package in place of its name.

    Raises InputError if the executor or the storage of a profile is not installed.
    """
    words = list(given)
    for k, word in enumerate(words):
        option, equals, value = word.partition("=")
        if option not in ("--profile", "--workflow-profile"):
            continue
        at = k if equals else k + 1
        name = value if equals else words[at] if at < len(words) else ""
        shipped = FILES / "profiles" / name
        of_package = "/" not in name and not Path(name).exists() and shipped.is_dir()
        file = next((shipped if of_package else Path(name)).glob("config*.yaml"), None)
        if not name or file is None:  # left to Snakemake, which has more places for profiles
            continue
        for package in _plugins(read_mapping(file)):
            if find_spec(package.replace("-", "_")) is None:
                raise InputError(
                    f"profile {name!r} needs the package {package}",
                    remedy=f"pip install {package}",
                )
        if of_package:
            words[at] = f"{option}={shipped}" if equals else str(shipped)
    return words


def _plugins(profile: Mapping[str, Any]) -> list[str]:
    """The packages of the executor and the storage that a profile names."""
    executor, storage = profile.get("executor", "local"), profile.get("default-storage-provider")
    named = [] if executor == "local" else [f"snakemake-executor-plugin-{executor}"]
    return named + ([f"snakemake-storage-plugin-{storage}"] if storage else [])


def config_files(arguments: Sequence[str]) -> list[Path]:
    """The files that follow ``--configfile`` or ``--configfiles``, those that are there."""
    found, inside = [], False
    for word in arguments:
        option, _, value = word.partition("=")
        if word.startswith("-"):
            inside = option in CONFIG_OPTIONS
        if inside and (name := value if word.startswith("-") else word):
            found.append(Path(name))
    return [file for file in found if file.is_file()]


def run_workflow(given: Sequence[str]) -> None:
    """Become a run of the workflow. Raises InputError for what Snakemake would not name."""
    arguments = arguments_for(given)
    files = config_files(arguments)
    for file in files:  # Snakemake names no file that it cannot read
        read_mapping(file)
    if EXAMPLE not in given:
        refuse_unknown(given, files)
        by_option = any(word.startswith("scenes=") for word in given)  # of --config
        if not by_option and need_scenes(given, files):
            require_scenes(files)
    news = [] if any(map(OWN_WORDS.match, given)) else ["--logger", "stereotruth"]
    os.execv(sys.executable, [sys.executable, "-m", "snakemake", *news, *arguments])
