"""A board of stereo methods as a static site, made of a folder of submissions alone.

    board.yaml     title; datasets as in ``benchmark.datasets``, roots from this folder on; a
                   dataset's ``seal``, and the project that has its exact truth
    submissions/   a folder each (:mod:`.submissions`); ``admitted.csv`` lists those taken in
    site/          index.html; board.json, all figures; papers_with_code.json, the layout of
                   sota-extractor; badges/, errors/ (maps of every pair), scores/ (a row per pair)

Every figure is computed from the files. A submission that cannot be used is refused by a sentence
with its file, and the board is made without it. There is a table for each dataset, by one protocol.
Submissions of one label and submitter are runs of one method. The least EPE stands first; a rank is
one more than the number of methods that are better by :mod:`.paired`, and who is not told apart is
level. Nothing in the site depends on a clock, a path, a machine's vector units or its number of
cores.
"""

from __future__ import annotations

import base64
import html
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import Field

from stereotruth import __version__
from stereotruth.core.config.methods import Name, Scoring, StereoDatasetEntry
from stereotruth.core.config.section import FilePath, Section, Text, check
from stereotruth.core.errors import InputError, in_number
from stereotruth.core.products.files import atomic_folder, link
from stereotruth.pages.page import write_page
from stereotruth.pages.pictures import ERRORS, Picture, Scale
from stereotruth.pages.tables import Cell, link_cell, minus, value_cell
from stereotruth.pages.tables import Table as Shown
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from .paired import CONFIDENCE, Difference, Sums, difference, read_sums
from .panels import ERROR_PX, error_picture
from .prediction_files import hold_against, read_prediction
from .predictions import predict
from .protocols import PROTOCOLS
from .score_method import ScoringPlan, score
from .scores import Scorer
from .strata import Products, exact_truth
from .submissions import Entry, admit, read_admitted, refuse_borrowed

log = logging.getLogger("stereotruth")
TEMPLATE = Path(__file__).with_name("board.html.jinja")
SETTINGS = "board.yaml"
WORK = ".work"  # what programs have made, to be carried on
STEPS = 8  # of a px, in maps of errors
THUMBNAIL_PX = 112
EXACT = [name for name, of in PROTOCOLS.items() if of.truth == "exact"]
TASK = "Stereo Matching of Satellite Images"


class BoardDataset(StereoDatasetEntry):
    """A dataset of a board: as in ``benchmark.datasets``, with its seal and its exact truth."""

    methods: None = None
    seal: Text = ""
    project: FilePath | None = None


class BoardSettings(Section):
    """What ``board.yaml`` holds."""

    title: Text = "Stereo methods"
    split: Text = "test"
    thresholds_px: tuple[float, ...] = Scoring().thresholds_px
    datasets: Annotated[dict[Name, BoardDataset], Field(min_length=1)]


@dataclass(frozen=True)
class Run:
    """A submission and its scores: summary, and folders of its disparities and scores."""

    entry: Entry
    summary: Mapping[str, Any]
    maps: Path
    scores: Path

    def sums(self, figure: str) -> Sums:
        """Sums by pair of a figure of all labelled pixels, holes filled."""
        return read_sums(self.scores, {"": ("labelled", f"filled_{figure}")})[""]


@dataclass(frozen=True)
class Table:
    """A dataset of the board, its pairs, and the runs on it by method."""

    dataset: StereoDataset
    products: Products
    pairs: Sequence[Pair]
    plan: ScoringPlan
    methods: dict[tuple[str, str], list[Run]]

    def truth(self, pair: Pair) -> NDArray[np.float32]:
        """What counts of a pair, float32[h, w] px, NaN elsewhere."""
        labels = self.dataset.labels(pair)
        if self.plan.protocol in EXACT:
            labels = exact_truth(pair, self.products)["exact_visible"]
        counted = Scorer(self.dataset.disparity_range).counted(labels)
        return np.where(counted, labels, np.float32(np.nan))


def make_board(folder: Path, to: Path | None = None, *, take_in: bool = False) -> list[str]:
    """Write the site; returns what is said of each submission that was refused.

    ``take_in``: admit what has not been before. Raises InputError if the settings or a dataset
    cannot be used: a label is not as its manifest or its seal has it.
    """
    settings = _settings(folder)
    places = sorted(path for path in (folder / "submissions").glob("*") if path.is_dir())
    admitted = admit(folder, [p.name for p in places]) if take_in else read_admitted(folder)
    order = {name: k for k, name in enumerate(admitted)}
    places.sort(key=lambda path: (order.get(path.name, len(order)), path.name))
    tables = {name: _table(folder, name, settings) for name in settings.datasets}
    taken: list[Run] = []
    refused: list[tuple[str, str]] = []
    for place in places:
        try:
            entry = Entry.read(place, admitted)
            refuse_borrowed(entry, [run.entry for run in taken])
            taken.append(_score(folder, entry, tables))
        except InputError as error:
            refused.append(_said(error, place))
    for run in taken:
        table = tables[run.entry.facts["dataset"]]
        table.methods.setdefault(run.entry.method, []).append(run)
    with atomic_folder(to or folder / "site") as site:
        _write(site, settings, list(tables.values()), refused)
    return [f"{file}: {problem}" for file, problem in refused]


def _settings(folder: Path) -> BoardSettings:
    file = folder / SETTINGS
    try:
        given = yaml.safe_load(file.read_text(encoding="utf-8"))
        if not isinstance(given, dict):
            raise ValueError("no keys")
    except (OSError, ValueError, yaml.YAMLError) as error:
        problem = f"no settings of a board ({type(error).__name__})"
        raise InputError(problem, file=file, remedy="write title and datasets into it") from None
    return check(given, BoardSettings, file)


def _table(folder: Path, name: str, settings: BoardSettings) -> Table:
    """An empty table of a dataset whose labels are as its manifest and seal have them."""
    of = settings.datasets[name]
    dataset = StereoDataset.of(name, of.model_dump() | {"root": folder / of.root})
    if of.seal not in ("", dataset.seal):
        raise InputError(
            f"dataset {name} has {f'seal {dataset.seal}' if dataset.seal else 'no seal'}, the "
            f"board is of seal {of.seal}",
            file=dataset.root,
            remedy="take the dataset that was sealed",
        )
    pairs = dataset.pairs(settings.split, labelled=True)
    tops = ("tiles", "results/project", "results/truth")
    known = [folder / of.project / top for top in tops] if of.project is not None else ()
    products = Products(*known)
    for pair in pairs:
        pair.refuse_changed()
        if of.protocol in EXACT and not exact_truth(pair, products):
            problem = f"protocol {of.protocol} scores by exact truth, which this pair has not"
            raise InputError(problem, file=pair.left, remedy="name its project, or no protocol")
    plan = ScoringPlan(settings.thresholds_px, 0, 0, 0, of.protocol)
    return Table(dataset, products, pairs, plan, {})


def _score(folder: Path, entry: Entry, tables: Mapping[str, Table]) -> Run:
    """A submission, made or taken, and scored; raises InputError if it is refused."""
    table = tables.get(entry.facts["dataset"])
    if table is None:
        entry.refuse("dataset is none of this board's", f"take one of {', '.join(tables)}")
    dataset, split = table.dataset, table.pairs[0].split
    entry.check_maps(dataset, table.pairs)
    work = folder / WORK / dataset.name / entry.name
    maps, scores = work / "maps", work / "scores"
    place = entry.submission.folder
    program = [place / name for name in entry.submission.files] if entry.program else []
    predict(dataset, split, entry.name, entry.settings, maps, work=work / "pairs", files=program)
    label = entry.facts["label"]
    summary = score(dataset, split, label, maps, scores, table.plan, products=table.products)
    if program and entry.submission.scores:
        hold_against(entry.submission.scores, summary)
    shown = ((p.name, read_prediction(maps, p), table.truth(p)) for p in table.pairs)
    entry.refuse_doubts(summary["doubts"], dataset, shown)
    return Run(entry, summary, maps, scores)


def _said(error: InputError, place: Path) -> tuple[str, str]:
    """File, from the folder of submissions on, and what is said of it, without other paths."""
    file = Path(error.file) if error.file else place / "submission.json"
    inside = file if file.is_relative_to(place) else place / "submission.json"
    problem = error.problem.splitlines()[0].replace(f"{place.parent}/", "")
    return inside.relative_to(place.parent).as_posix(), problem


# ------------------------------------------------------------------------------- the figures


def _name(row: Mapping[str, Any]) -> str:
    """A method by its label and who submitted it."""
    return f"{row['method']} by {row['by']}"


def _titles(rows: Sequence[Mapping[str, Any]]) -> dict[str, tuple[str, str, float]]:
    """Title, format and factor of the figures of the rows: EPE, and D1 at each threshold."""
    names = rows[0]["figures"] if rows else ("epe_px",)
    d1 = {name: (f"D1, {name[3:-9]} px (%)", ".2f", 100.0) for name in names if name != "epe_px"}
    return {"epe_px": ("EPE (px)", ".3f", 1.0), **d1}


def _rows(table: Table) -> list[dict[str, Any]]:
    """The methods of a table with all figures, the least EPE first."""
    if not table.methods:
        return []
    limits = next(iter(table.methods.values()))[0].summary["thresholds_px"]
    names = ["epe_px", *(f"d1_{limit:g}_px_share" for limit in limits)]
    sums = {
        m: {n: [run.sums(n) for run in runs] for n in names} for m, runs in table.methods.items()
    }
    means = {method: {n: difference([], of[n]) for n in names} for method, of in sums.items()}
    order = sorted(sums, key=lambda method: (means[method]["epe_px"].value or 0.0, method))
    rows = []
    for method in order:
        runs = table.methods[method]
        less = {other: difference(sums[other]["epe_px"], sums[method]["epe_px"]) for other in order}
        better = [o for o, of in less.items() if not of.level and (of.value or 0) > 0]
        facts = runs[0].entry.facts
        rows.append(
            {
                "method": method[0],
                "by": method[1],
                "rank": 1 + len(better),
                "level_with": [
                    other[0] for other in order if other != method and less[other].level
                ],
                "seeds": [run.entry.facts.get("seed") for run in runs],
                "submissions": [run.entry.name for run in runs],
                **{key: facts[key] for key in ("licence", "trained_on")},
                "version": (facts.get("identity") or {}).get("version"),
                "links": {k: facts[k] for k in ("paper", "code") if isinstance(facts.get(k), str)},
                "valid_share": [run.summary["all"]["valid_share"] for run in runs],
                "figures": {name: vars(of) for name, of in means[method].items()},
                "less": {" by ".join(o): vars(of) for o, of in less.items() if o != method},
                "runs": {run.entry.name: run.summary["cities"] for run in runs},
            }
        )
    return rows


def _papers_with_code(title: str, boards: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The tables in the layout of sota-extractor's evaluation tables."""
    datasets = []
    for of in boards:
        rows = []
        for row in of["methods"]:
            code = row["links"].get("code")
            paper = {"paper_title": "", "paper_url": row["links"].get("paper", "")}
            rows.append(
                {
                    "model_name": row["method"],
                    **paper,
                    "paper_date": None,
                    "code_links": [{"title": row["method"], "url": code}] if code else [],
                    "model_links": [],
                    "metrics": {
                        title: f"{factor * row['figures'][name]['value']:{form}}"
                        for name, (title, form, factor) in _titles(of["methods"]).items()
                    },
                }
            )
        metrics = [title for title, *_ in _titles(of["methods"]).values()]
        about = f"Protocol {of['protocol']}, {in_number(of['pairs'], 'pair')}."
        more = {"subdatasets": [], "dataset_links": [], "dataset_citations": []}
        sota = {"metrics": metrics, "rows": rows}
        datasets.append({"dataset": of["dataset"], "description": about, **more, "sota": sota})
    task = {"task": TASK, "description": title, "subtasks": [], "source_link": None}
    return [{**task, "datasets": datasets}]


# ---------------------------------------------------------------------------------- the site


def _write(
    site: Path,
    settings: BoardSettings,
    tables: Sequence[Table],
    refused: Sequence[tuple[str, str]],
) -> None:
    boards, shown = [], []
    for table in tables:
        rows = _rows(table)
        summaries = [run.summary for runs in table.methods.values() for run in runs]
        protocol = summaries[0]["protocol"] if summaries else {}
        boards.append(
            {
                "dataset": table.dataset.name,
                "protocol": protocol.get("id", ""),
                "definition": protocol,
                "seal": table.dataset.seal,
                "pairs": len(table.pairs),
                "methods": rows,
            }
        )
        maps = [(row["method"], _error_maps(site, table, row)) for row in rows]
        for row in rows:
            badge = _badge(row, len(rows), protocol["id"])
            _text(site / "badges" / f"{row['submissions'][0]}.svg", badge)
        shown.append((boards[-1], _ranking(rows), _pairs(rows), maps))
    told = [{"file": file, "problem": problem} for file, problem in refused]
    board = {"software": f"stereotruth {__version__}", "confidence": CONFIDENCE, "boards": boards}
    _text(site / "board.json", _json(board | {"refused": told}))
    _text(site / "papers_with_code.json", _json(_papers_with_code(settings.title, boards)))
    values = {
        "title": settings.title,
        "boards": shown,
        "places": [(of["dataset"], of["dataset"]) for of in boards],
        "refused": [f"{file}: {problem}" for file, problem in refused],
        "links": [(name, name, "") for name in ("board.json", "papers_with_code.json")],
        "confidence": f"{CONFIDENCE:.0%}",
        "errors": Scale.of(ERRORS, "0", f"{ERROR_PX:g} px; blue: no disparity"),
    }
    write_page(site / "index.html", TEMPLATE, values)


def _json(values: Any) -> str:
    return json.dumps(values, indent=1, sort_keys=True, ensure_ascii=False, allow_nan=False) + "\n"


def _text(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text, encoding="utf-8", newline="\n")


def _error_maps(
    site: Path, table: Table, row: Mapping[str, Any]
) -> list[tuple[str, str, list[tuple[str, str, str]]]]:
    """Maps of errors and scores by pair of a method's runs: run, its table, maps as PNG to show."""
    shown = []
    for run in table.methods[row["method"], row["by"]]:
        name, maps = run.entry.name, []
        link(run.scores / "scores.csv", site / "scores" / f"{name}.csv")
        for pair in table.pairs:
            truth = table.truth(pair)
            steps = np.floor(STEPS * np.abs(read_prediction(run.maps, pair) - truth)) / STEPS
            picture = error_picture(steps, np.where(np.isfinite(truth), np.float32(0), truth))
            file = site / "errors" / name / f"{pair.name}.png"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(_png(picture))
            each = max(1, max(picture.shape[:2]) // THUMBNAIL_PX)
            small = _png(np.ascontiguousarray(picture[each // 2 :: each, each // 2 :: each]))
            uri = "data:image/png;base64," + base64.b64encode(small).decode("ascii")
            maps.append((pair.name, f"errors/{name}/{pair.name}.png", uri))
        shown.append((name, f"scores/{name}.csv", maps))
    return shown


def _png(picture: Picture) -> bytes:
    return cv2.imencode(".png", picture[..., ::-1])[1].tobytes()


def _interval(of: Mapping[str, Any], form: str, factor: float = 1.0) -> Cell:
    """A figure with its interval."""
    value, low, high = (of[key] for key in ("value", "low", "high"))
    if value is None:
        return value_cell(value, form)
    text = format(factor * value, form)
    if low is not None:
        text += f" [{factor * low:{form}}, {factor * high:{form}}]"
    return Cell(minus(text), f"{value:.9g}")


def _ranking(rows: Sequence[Mapping[str, Any]]) -> Shown | None:
    """The methods, the least EPE first."""
    lines = []
    for row in rows:
        behind = row["less"].get(_name(rows[0]))
        seeds = [str(seed) for seed in row["seeds"] if seed is not None]
        epe, *d1 = (_interval(row["figures"][n], *how[1:]) for n, how in _titles(rows).items())
        lines.append(
            (
                value_cell(row["rank"], ".0f"),
                link_cell(row["method"], f"#{row['submissions'][0]}", best=row["rank"] == 1),
                epe,
                _interval(behind, "+.3f") if behind else Cell("–", "0"),
                Cell("\n".join(row["level_with"]) or "–", str(len(row["level_with"]))),
                *d1,
                value_cell(min(row["valid_share"]), ".2f", 100),
                Cell(", ".join(seeds) or "–", str(len(seeds))),
                *(Cell(row[key], row[key]) for key in ("trained_on", "licence", "by")),
            )
        )
    epe, *d1 = (title for title, *_ in _titles(rows).values())
    first = ("rank", "method", epe, "behind the first, px", "level with")
    titles = (*first, *d1, "valid, %", "seeds", "trained on", "licence", "by")
    n = len(titles)
    return Shown.of(titles, lines, (1, 4, *range(n - 4, n)))


def _pairs(rows: Sequence[Mapping[str, Any]]) -> Shown | None:
    """Each two methods, the difference of their EPE."""
    lines = []
    for k, row in enumerate(rows):
        for other in rows[:k]:
            of = Difference(**row["less"][_name(other)])
            text = f"{row['method']} less {other['method']}"
            share = value_cell(of.better_share, ".0f", 100)
            said = "level" if of.level else "told apart"
            lines.append((Cell(text, text), _interval(vars(of), "+.3f"), share, Cell(said, said)))
    return Shown.of(("methods", "EPE (px)", "better on (% of pairs)", ""), lines, (0, 3))


def _badge(row: Mapping[str, Any], count: int, protocol: str) -> str:
    """A badge in the form of shields.io's: EPE, rank, protocol."""
    epe = row["figures"]["epe_px"]["value"]
    right = f"EPE {epe:.3f} px · rank {row['rank']} of {count}"
    widths = [int(6.6 * len(text)) + 14 for text in (protocol, right)]
    total, colour = sum(widths), "#2e7d32" if row["rank"] == 1 else "#37618e"
    texts = "".join(
        f'<text x="{x}" y="14">{html.escape(text)}</text>'
        for x, text in ((7, protocol), (widths[0] + 7, right))
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{total}" height="20" role="img" '
        f'aria-label="{html.escape(protocol)}: {html.escape(right)}">'
        f'<rect width="{total}" height="20" rx="3" fill="#444"/>'
        f'<path d="M{widths[0]} 0h{widths[1] - 3}q3 0 3 3v14q0 3-3 3h-{widths[1] - 3}z" '
        f'fill="{colour}"/><g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" '
        f'font-size="11">{texts}</g></svg>\n'
    )
