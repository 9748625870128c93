"""What the workflow can make: a line for each target, and which one a typo may mean."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path

from ..core.config.methods import DATASETS
from ..core.errors import InputError
from .project import FILES, configured, names_scenes, read_scenes

TARGETS = {
    "tiles/<City>": "the benchmark tiles of a city (without a target: of all cities)",
    "dataset": "the tiles of all cities, in the layout of the published dataset",
    "originals": "crops of the original images with corrected RPCs (dataset.originals)",
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


def list_targets(configfiles: Sequence[Path] | None = None) -> list[str]:
    """A line for each target, and the cities, scenes, datasets and methods to put into them."""
    settings, _ = configured(configfiles)
    cities, scenes = read_scenes(settings)
    if not names_scenes(configfiles):  # the built-in cities are made with --example alone
        cities, scenes = {}, {}
    with_scenes = [city for city in cities if any(s.city == city for s in scenes.values())]
    width = max(map(len, TARGETS))
    known = {
        "<City>": with_scenes,
        "<scene>": list(scenes),
        "<dataset>": [name for name, entry in settings.benchmark.datasets.items() if entry],
        "<method>": [name for name, entry in settings.benchmark.methods.items() if entry],
    }
    return [f"{name:{width}}  {meaning}" for name, meaning in TARGETS.items()] + [
        f"{name}: {', '.join(values[:12])}{' …' if len(values) > 12 else ''}"
        for name, values in known.items()
        if values
    ]


def rules() -> list[str]:
    """Names of the workflow's rules."""
    return [
        name
        for file in sorted((FILES / "workflow" / "rules").glob("*.smk"))
        for name in re.findall(r"^rule (\w+):", file.read_text(encoding="utf-8"), re.MULTILINE)
    ]


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
            close = difflib.get_close_matches(word, names, n=1)
            remedy = f"did you mean {close[0]}?" if close else "stereotruth targets lists them"
            raise InputError(f"{word}: no such target", remedy=remedy)
