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
import hashlib
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stereotruth import __version__
from stereotruth.core.config.methods import Name, Scoring, StereoDatasetEntry
from stereotruth.core.config.section import FilePath, Section, Text, check, read_mapping
from stereotruth.core.errors import InputError, in_number
from stereotruth.core.products.files import (
    atomic_file,
    atomic_folder,
    link,
    write_json,
    write_table,
)
from stereotruth.core.products.provenance import file_sha256
from stereotruth.pages.page import write_page
from stereotruth.pages.pictures import ERRORS, Picture, Scale
from stereotruth.pages.tables import Table as Shown
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from .paired import CONFIDENCE, Sums, difference, differences, read_sums
from .panels import ERROR_PX, error_picture
from .prediction_files import FILE, hold_against, read_prediction
from .predictions import predict
from .protocols import PROTOCOLS
from .score_method import ScoringPlan, score
from .scores import MIN_TILES, Scorer
from .strata import Products, exact_truth
from .submissions import ADMITTED, Entry, read_admitted, refuse_borrowed
from .tables import Figure, error_figures, of_figures
from .tables import Table as Differences

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
    """A submission and its scores: summary, folders of its disparities and scores, digests of its
    disparities."""

    entry: Entry
    summary: Mapping[str, Any]
    maps: Path
    scores: Path
    digests: frozenset[str]

    def sums(self, figure: str) -> Sums:
        """Sums by pair of a figure of all labelled pixels, holes filled."""
        return read_sums(self.scores, {figure: ("labelled", figure)})[figure]


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

    ``take_in``: admit what has not been before and is not refused. Raises InputError if the
    settings or a dataset cannot be used: a label is not as its manifest or its seal has it.
    """
    settings = check(read_mapping(folder / SETTINGS), BoardSettings, folder / SETTINGS)
    places = sorted(path for path in (folder / "submissions").glob("*") if path.is_dir())
    known = read_admitted(folder)
    offered = [p for p in places if take_in and p.name not in known and (p / FILE).is_file()]
    admitted = known | {place.name: file_sha256(place / FILE) for place in offered}
    order = {name: k for k, name in enumerate(admitted)}
    places.sort(key=lambda path: (order.get(path.name, len(order)), path.name))
    tables = {name: _table(folder, name, settings) for name in settings.datasets}
    taken: list[Run] = []
    refused: list[dict[str, str]] = []
    for place in places:
        try:
            entry = Entry.read(place, admitted)
            run = _score(folder, entry, tables)
            refuse_borrowed(entry, run.digests, [(of.entry, of.digests) for of in taken])
            taken.append(run)
        except InputError as error:
            refused.append(_said(error, place))
            if place.name not in known:
                admitted.pop(place.name, None)
    for name in sorted(known.keys() - {place.name for place in places}):
        gone = "was admitted, and is not there any more"
        remedy = f"put it back, or take its line out of {ADMITTED}"
        refused.append({"file": name, "problem": gone, "remedy": remedy})
    if take_in:
        rows = [{"folder": name, "sha256": sha256} for name, sha256 in admitted.items()]
        write_table(folder / ADMITTED, rows, ("folder", "sha256"))
    for run in taken:
        table = tables[run.entry.facts["dataset"]]
        table.methods.setdefault(run.entry.method, []).append(run)
    with atomic_folder(to or folder / "site") as site:
        _write(site, settings, [of for of in tables.values() if of.methods], refused)
    return [f"{of['file']}: {of['problem']}. Remedy: {of['remedy']}" for of in refused]


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
        problem = f"dataset {entry.facts['dataset']} is none of this board's"
        entry.refuse(problem, f"take one of {', '.join(tables)}: names are those of board.yaml")
    dataset, split = table.dataset, table.pairs[0].split
    entry.check_maps(dataset, table.pairs)
    work = folder / WORK / dataset.name / entry.name
    maps, scores = work / "maps", work / "scores"
    place = entry.folder
    program = [place / name for name in entry.files] if entry.program else []
    settings = entry.settings(work / "program")
    predict(dataset, split, entry.name, settings, maps, work=work / "pairs", files=program)
    if program and not entry.is_random:
        settings, again = entry.settings(work / "program"), work / "again"
        how = {"work": again / "pairs", "files": program, "most": 1}
        predict(dataset, split, entry.name, settings, again / "maps", **how)
        first = dataset.pairs(split)[0]
        one, two = (_digest(read_prediction(of, first)) for of in (maps, again / "maps"))
        if one != two:
            remedy = 'have it set its seeds, or state "random": true beside its label'
            entry.refuse(f"two runs of its program differ on pair {first.name}", remedy)
    label = entry.facts["label"]
    summary = score(dataset, split, label, maps, scores, table.plan, products=table.products)
    if program and entry.scores:
        hold_against(entry.scores, summary)
    shown = ((p.name, read_prediction(maps, p), table.truth(p)) for p in table.pairs)
    entry.refuse_doubts(summary["doubts"], dataset, shown)
    digests = frozenset(_digest(read_prediction(maps, pair)) for pair in table.pairs)
    return Run(entry, summary, maps, scores, digests)


def _digest(disparity: NDArray[np.float32]) -> str:
    """Of the values of a map, whatever stood where it has none."""
    return hashlib.sha256(np.where(np.isnan(disparity), np.nan, disparity).tobytes()).hexdigest()


def _said(error: InputError, place: Path) -> dict[str, str]:
    """File, from the folder of submissions on; problem, without other paths; and remedy."""
    file = Path(error.file) if error.file else place / "submission.json"
    inside = file if file.is_relative_to(place) else place / "submission.json"
    lines = error.problem.splitlines()
    problem = " ".join(dict.fromkeys((lines[0], lines[-1]))).replace(f"{place.parent}/", "")
    file = inside.relative_to(place.parent)
    return {"file": file.as_posix(), "problem": problem, "remedy": error.remedy}


# ------------------------------------------------------------------------------- the figures


def _ranked(table: Table) -> tuple[list[dict[str, Any]], Differences]:
    """The methods of a table, the least EPE first, and the differences of each two."""
    summaries = [run.summary for runs in table.methods.values() for run in runs]
    figures, rows = error_figures(summaries), []
    labels = [label for label, _ in table.methods]
    for (label, by), runs in table.methods.items():
        facts = runs[0].entry.facts
        row = {
            "method": label if labels.count(label) == 1 else f"{label}, {by}",
            "by": by,
            "submissions": [run.entry.name for run in runs],
            "seeds": [run.entry.facts.get("seed") for run in runs],
            "random": any(run.entry.is_random for run in runs),
            **{key: facts[key] for key in ("licence", "trained_on")},
            **{key: str(facts.get(key) or "") for key in ("paper", "code")},
            "valid_share": min(run.summary["all"]["valid_share"] for run in runs),
            "cities": {run.entry.name: run.summary["cities"] for run in runs},
            "runs": runs,
        }
        for figure in figures:
            row |= difference([], [run.sums(figure.key) for run in runs]).row(figure.key)
        rows.append(row)
    rows.sort(key=lambda row: (row[figures[0].key], row["method"]))
    compared = [summaries[0] | {"label": row["method"]} for row in rows]
    of_two = differences(compared, [[run.scores for run in row.pop("runs")] for row in rows])
    level = [{pair["method"], pair["less"]} for pair in of_two.rows if pair["level"]]
    for k, row in enumerate(rows):
        others = (of["method"] for of in rows if of is not row)
        row["level_with"] = [name for name in others if {name, row["method"]} in level]
        row["rank"] = 1 + sum(before["method"] not in row["level_with"] for before in rows[:k])
    return rows, of_two


def _papers_with_code(title: str, boards: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The tables in the layout of sota-extractor's evaluation tables."""
    datasets = []
    for of in boards:
        figures = error_figures([of["definition"]])
        rows = [
            {
                "model_name": row["method"],
                "paper_title": "",
                "paper_url": row["paper"],
                "paper_date": None,
                "code_links": [{"title": row["method"], "url": row["code"]}] if row["code"] else [],
                "model_links": [],
                "metrics": {of.title: of.text(row, interval=False) for of in figures},
            }
            for row in of["methods"]
        ]
        about = f"Protocol {of['definition']['id']}, {in_number(of['pairs'], 'pair')}."
        more = {"subdatasets": [], "dataset_links": [], "dataset_citations": []}
        sota = {"metrics": [of.title for of in figures], "rows": rows}
        datasets.append({"dataset": of["dataset"], "description": about, **more, "sota": sota})
    task = {"task": TASK, "description": title, "subtasks": [], "source_link": None}
    return [{**task, "datasets": datasets}]


# ---------------------------------------------------------------------------------- the site


def _write(
    site: Path,
    settings: BoardSettings,
    tables: Iterable[Table],
    refused: Sequence[Mapping[str, str]],
) -> None:
    boards, shown = [], []
    for table in tables:
        rows, of_two = _ranked(table)
        protocol = next(iter(table.methods.values()))[0].summary["protocol"]
        board = {"dataset": table.dataset.name, "definition": protocol, "pairs": len(table.pairs)}
        board |= {"seal": table.dataset.seal, "methods": rows, "differences": of_two.rows}
        boards.append(board)
        for row in rows:
            with atomic_file(site / "badges" / f"{row['submissions'][0]}.svg") as file:
                file.write_text(_badge(row, len(rows), protocol["id"]), encoding="utf-8")
        maps = [_error_maps(site, table, run) for runs in table.methods.values() for run in runs]
        count = in_number(len(table.pairs), "pair")
        too_few = [f"{count}: too few to tell methods apart, so that all of them have rank 1"]
        too_few = too_few if len(table.pairs) < MIN_TILES else []
        shown.append(
            (board, count, too_few, _ranking(rows, protocol), of_two.shown[0], sorted(maps))
        )
    every = {"software": f"stereotruth {__version__}", "confidence": CONFIDENCE, "boards": boards}
    told = [{key: of[key] for key in ("file", "problem")} for of in refused]
    write_json(site / "board.json", {**every, "refused": told})
    write_json(site / "papers_with_code.json", _papers_with_code(settings.title, boards))
    values = {
        "title": settings.title,
        "boards": shown,
        "places": [(of["dataset"], of["dataset"]) for of in boards],
        "refused": [f"{of['file']}: {of['problem']}" for of in refused],
        "links": [(name, name, "") for name in ("board.json", "papers_with_code.json")],
        "confidence": f"{CONFIDENCE:.0%}",
        "errors": Scale.of(ERRORS, "0", f"{ERROR_PX:g} px; blue: no disparity"),
    }
    write_page(site / "index.html", TEMPLATE, values)


def _error_maps(site: Path, table: Table, run: Run) -> tuple[str, str, list[tuple[str, str]]]:
    """Write the maps of errors and scores by pair of a run; its name, label, maps to show."""
    name, shown = run.entry.name, []
    link(run.scores / "scores.csv", site / "scores" / f"{name}.csv")
    (site / "errors" / name).mkdir(parents=True)
    for pair in table.pairs:
        truth = table.truth(pair)
        steps = np.floor(STEPS * np.abs(read_prediction(run.maps, pair) - truth)) / STEPS
        picture = error_picture(steps, np.where(np.isfinite(truth), np.float32(0), truth))
        (site / "errors" / name / f"{pair.name}.png").write_bytes(_png(picture))
        each = max(1, max(picture.shape[:2]) // THUMBNAIL_PX)
        small = base64.b64encode(_png(picture[each // 2 :: each, each // 2 :: each]))
        shown.append((pair.name, f"data:image/png;base64,{small.decode('ascii')}"))
    return name, run.entry.facts["label"], shown


def _png(picture: Picture) -> bytes:
    return cv2.imencode(".png", np.ascontiguousarray(picture[..., ::-1]))[1].tobytes()


def _ranking(rows: Sequence[Mapping[str, Any]], protocol: Mapping[str, Any]) -> Shown | None:
    """The methods, the least EPE first."""
    figures = [replace(figure, interval=True) for figure in error_figures([protocol])]
    figures.append(Figure("valid, %", "valid_share", 100, ".2f"))
    texts = [
        {
            **row,
            "rank": str(row["rank"]),
            "level_with": "\n".join(row["level_with"]) or "–",
            "seeds": ", ".join(
                [str(seed) for seed in row["seeds"] if seed is not None]
                + ["random: another run gives other disparities"] * row["random"]
            )
            or "–",
        }
        for row in rows
    ]
    more = ("level_with", "seeds", "trained_on", "licence", "by")
    titles = {key: key.replace("_", " ") for key in more}
    return of_figures(texts, {"rank": "rank", "method": "method"}, figures, titles)


def _badge(row: Mapping[str, Any], count: int, protocol: str) -> str:
    """A badge in the form of shields.io's: protocol; EPE and rank."""
    epe = f"EPE {row['filled_epe_px']:.3f} px · rank {row['rank']} of {count}"
    first, second = (int(6.6 * len(text)) + 14 for text in (protocol, epe))
    colour = "#2e7d32" if row["rank"] == 1 else "#37618e"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{first + second}" height="20" role="img" '
        f'aria-label="{protocol}: {epe}"><rect width="{first}" height="20" fill="#444"/>'
        f'<rect x="{first}" width="{second}" height="20" fill="{colour}"/>'
        '<g fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11">'
        f'<text x="7" y="14">{protocol}</text><text x="{first + 7}" y="14">{epe}</text></g></svg>\n'
    )
