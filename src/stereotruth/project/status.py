"""What is made of each city, and what a run would make and why: asked of Snakemake's own plan.

And how two folders of results differ.
"""

from __future__ import annotations

import ast
import contextlib
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from ..core.config.configuration import Configuration
from ..core.errors import InputError
from ..core.products.files import read_json
from ..core.sheets import Scene
from ..evaluate.report.index_page import PAGES
from ..tiles.label_moves import moves, sample_labels, worst_point
from ..tiles.manifest import read_manifest
from .check import chosen
from .findings import heard, plain_table, wide
from .project import configured, read_images, read_scenes, require_scenes, sheet
from .run_workflow import arguments_for

FOLLOWS = "Input files updated by another job"  # of a job that runs because another does
LONGEST = 300  # characters of a reason
MISSING = "Missing output files"  # of what was never made
# Rules of figures, pages and what else is made of labels, which tiles are up to date without.
AFTER_TILES = {
    "closure_of_site", "draw_residuals", "draw_refinement", "dsm", "evaluate_images",
    "evaluate_truth", "evaluate_truth_city", "grid_truth", "image_heights", "originals",
    "predict_scene", "report_city", "score_dsm", "simulate_truth",
}  # fmt: skip
TO_DO = "a run of what is here would do, and why"
OF_ALL = "all cities"  # in the place of a city
# How Snakemake says that params differ, and what stands in these; ``code``, and what stands in
# ``sources``, are digests (workflow/rules/sources.smk).
PARAMS = re.compile(r"Params have changed .*?before: (.*) now: (.*)")
DIGEST = re.compile(r"'[0-9a-f]{12,16}'")


@dataclass(frozen=True)
class PlannedJob:
    """A job that a run would do."""

    rule: str
    city: str
    of: str
    reason: str

    @property
    def causes(self) -> list[str]:
        """Why it runs, other than that a job before it does."""
        parts = re.split(r"; (?=[A-Z])", self.reason)
        return [part for part in parts if part and not part.startswith(FOLLOWS)]


def plan(targets: Sequence[str], configfiles: Sequence[Path] | None = None) -> list[PlannedJob]:
    """The jobs that a run of the targets would do. Raises InputError if there is no plan."""
    from snakemake.cli import main

    given = [*targets, "--dry-run", "--cores", "1"]
    if configfiles:
        given += ["--configfile", *map(str, configfiles)]
    said, status = io.StringIO(), 0
    with (
        heard("snakemake") as records,
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
    ):
        try:
            main(arguments_for(given))
        except SystemExit as end:
            status = end.code
    if status:
        lines = [line for line in said.getvalue().splitlines() if line.strip()]
        raise InputError(
            f"there is no plan: {' '.join(lines[-4:])}",
            remedy="correct what it names; stereotruth check says more",
        )
    jobs = []
    for record in records:
        if str(getattr(record, "event", "")).endswith("job_info"):
            wildcards = dict(record.wildcards or {})
            names = ("scene", "lidar", "tile", "image", "dataset", "method")
            of = "/".join(filter(None, map(wildcards.get, names)))
            city = wildcards.get("city", "")
            jobs.append(PlannedJob(record.rule_name, city, of, record.reason))
    return jobs


@dataclass(frozen=True)
class CityStatus:
    """A city's tiles and pages, or what is made of all cities together, and what a run would do.

    Of tiles, pages and the figures of `evaluate`, and of all else that was ever made. ``refused``:
    why there is no plan of it.
    """

    city: str
    made: str
    pages: tuple[str, ...]
    jobs: tuple[PlannedJob, ...]
    refused: str = ""

    @property
    def state(self) -> str:
        """Of the tiles, in a few words."""
        if self.refused:
            return "no plan"
        if all(job.rule in AFTER_TILES for job in self.jobs):
            return "up to date"
        return "out of date" if self.made else "not made"

    def why(self) -> list[str]:
        """What a run would do, and the causes of it, the most frequent first.

        Figures and pages that were never made of tiles that are up to date are nothing to do.
        """
        if self.refused:
            return [self.refused]
        jobs = sorted(self.jobs, key=lambda job: job.rule in AFTER_TILES)
        if self.state == "up to date":
            jobs = [job for job in jobs if MISSING not in job.reason]
        if not jobs:
            return []
        rules = Counter(job.rule for job in jobs)
        lines = [", ".join(f"{rule} {count}" for rule, count in rules.items())]
        causes: dict[str, list[str]] = {}
        for job in jobs:
            for cause in job.causes:
                expected = not self.made or job.rule in AFTER_TILES
                if not (expected and cause.startswith(MISSING)):
                    causes.setdefault(_short(cause), []).append(f"{job.rule} {job.of}".strip())
        for cause, of in causes.items():
            more = f" and {len(of) - 2} more" if len(of) > 2 else ""
            lines.append(f"{', '.join(of[:2])}{more}: {cause}")
        return lines


def _short(reason: str) -> str:
    """Which params differ, where Snakemake says that some do: it gives all of their values."""
    text = " ".join(reason.split())
    if params := PARAMS.match(text):
        with contextlib.suppress(ValueError, SyntaxError):  # values that cannot be read back
            text = _changes(*(dict(_flat(ast.literal_eval(f"[{p}]"))) for p in params.groups()))
    return text if len(text) <= LONGEST else f"{text[:LONGEST]} …"


def _flat(params: Iterable[object]) -> Iterator[tuple[str, str]]:
    """Values by their names in dictionaries, at any depth; digests and others by what they are."""
    for value in params:
        if isinstance(value, dict):
            for name, inner in value.items():
                if isinstance(inner, dict):
                    yield from _flat([inner])
                else:
                    yield str(name), repr(inner)
        elif DIGEST.fullmatch(repr(value)):
            yield "code", repr(value)
        else:
            yield "", repr(value)


def _changes(old: Mapping[str, str], new: Mapping[str, str]) -> str:
    said = []
    for name in sorted(name for name in {**old, **new} if old.get(name) != new.get(name)):
        values = f"{old.get(name, 'nothing')} -> {new.get(name, 'nothing')}"
        said.append(name if DIGEST.search(values) else f"{name} {values}".strip())
    return f"changed: {', '.join(said)}"


def _made(city: str) -> str:
    """How many tiles a city has, by its manifest; empty if it has none."""
    folder = Path("tiles", city)
    if not (folder / "manifest.csv").is_file():
        return ""
    rows = read_manifest(folder)
    splits = Counter(row.get("split", "") for row in rows if row.get("complete") == "yes")
    incomplete = len(rows) - splits.total()
    counts = [f"{count} {split or 'without a split'}" for split, count in splits.items()]
    counts += [f"{incomplete} without complete labels"] * (incomplete > 0)
    return f"{len(rows)} tiles ({', '.join(counts)})"


def _made_before(
    settings: Configuration, cities: Sequence[str], scenes: Mapping[str, Scene]
) -> tuple[list[str], list[str]]:
    """Targets beside tiles and pages that are here: of cities, and of all cities together.

    Those of cities, scenes, images, methods and datasets that are no more cannot be made again.
    """
    methods = [name for name, entry in settings.benchmark.methods.items() if entry]
    datasets = [name for name, entry in settings.benchmark.datasets.items() if entry]
    images = read_images(settings, cities).values()
    of_scenes = [f"{s.city}/{s.scene}/{method}" for s in scenes.values() for method in methods]
    of_cities = [
        *(f"originals/{city}" for city in cities),
        *(f"results/closure/{city}.json" for city in cities),
        *(f"results/heights/{image.city}/{image.image}.zarr" for image in images),
        *(f"results/predict/{name}_dsm.tif" for name in of_scenes),
        *(f"score_dsm/{name}" for name in of_scenes),
    ]
    of_all = ["dataset", *(f"benchmark/{name}/index.html" for name in datasets)]
    of_all += [f"benchmark/{name}/{method}" for name in datasets for method in methods]
    of_all += [f"audit/{name}" for name in datasets]
    return tuple([name for name in names if Path(name).exists()] for names in (of_cities, of_all))


def status_of(cities: Sequence[str], configfiles: Sequence[Path] | None) -> list[CityStatus]:
    """The status of cities, or of those of scenes; all of the sheet if none is named, and then of
    what is made of all of them together.

    Raises InputError for a name that no sheet has.
    """
    require_scenes(configfiles)
    settings, _ = configured(configfiles)
    known, scenes = read_scenes(settings)
    found = chosen(cities, scenes, known, sheet(settings, "scenes"))
    wanted = [city for city in known if any(scene.city == city for scene in found.values())]
    of_city = "tiles/{0}", "results/report/{0}/index.html"
    targets = [target.format(city) for city in wanted for target in of_city]
    of_cities, of_all = _made_before(settings, known, found)
    of_all = [] if cities else of_all
    refused = ""
    try:
        jobs = plan([*targets, *of_cities, *of_all, "evaluate"], configfiles)
    except InputError as error:  # of a dataset that is no more, say: tiles have a plan all the same
        if not (of_cities or of_all):
            raise
        jobs, refused = plan([*targets, "evaluate"], configfiles), error.problem
    pages = [page for pattern in PAGES for page in Path().glob(pattern)]
    every = [
        CityStatus(
            city,
            _made(city),
            tuple(str(page) for page in pages if city in page.parts),
            tuple(job for job in jobs if job.city == city),
        )
        for city in wanted
    ]
    if of_all or refused:
        together = tuple(job for job in jobs if not job.city and job.rule != "evaluate")
        made = ", ".join([*of_cities, *of_all] if refused else of_all)
        every.append(CityStatus(OF_ALL, made, (), together, refused))
    return every


def show_status(cities: Sequence[str], configfiles: Sequence[Path] | None) -> None:
    """Print a table of the cities."""
    every = status_of(cities, configfiles)
    table = plain_table(("city", "tiles", "made", "page", TO_DO))
    for city in every:
        style = "green" if city.state == "up to date" else "yellow"
        page = ", ".join(city.pages) or "none"
        row = (city.city, f"[{style}]{city.state}[/{style}]", city.made or "none", page)
        table.add_row(*row, "\n".join(map(escape, city.why())))
    wide().print(table)


def compare_labels(old: Path, new: Path) -> Table:
    """A table of the scenes of two folders `results`: how far labels and heights have moved from
    the ``old`` to the ``new``, and the control points of both.

    Raises InputError if they share no scene.
    """
    headings = ("scene", "labels, px of disparity", "height, m", "control points, px rms", "worst")
    table = plain_table(headings, whole=("scene",))
    for store in sorted(new.glob("project/*/*.zarr")):
        if (before := old / store.relative_to(new)).is_dir():
            found = moves(sample_labels(before), store)
            name = f"{store.parent.name}/{store.stem}"
            records = [_alignment(results, name) for results in (old, new)]
            rms = " -> ".join(map(_rms, records))
            moved = (found.disparities, found.heights) if found else ("none before", "")
            cells = name, *moved, rms, worst_point(records[1])[1]
            table.add_row(*map(escape, cells))
    if not table.row_count:
        raise InputError(
            f"no labels (project/<City>/<scene>.zarr) of a scene that {old} has, too",
            file=new,
            remedy="name the folders `results` of two runs",
        )
    return table


def _alignment(results: Path, scene: str) -> Mapping[str, Any]:
    """The last record of a scene's alignment; empty without any."""
    files = (results / stage / scene / "alignment.json" for stage in ("adjust", "refine", "align"))
    return next((read_json(file) for file in files if file.is_file()), {})


def _rms(record: Mapping[str, Any]) -> str:
    """Of the control points' residuals, left and right image."""
    views = (record.get(view, {}).get("rms", {}).get("after") for view in ("left", "right"))
    return ", ".join("–" if value is None else f"{value:.3f}" for value in views)
