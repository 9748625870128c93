"""A method's predictions of a dataset against its labels: a folder of scores and pictures.

scores.csv   a row per tile
cities.csv   a row per city, and one of all, with 95 % confidence intervals, and the median absolute
             error of the valid pixels (``median_px``; what is beyond 16 px counts as 16)
strata.csv   a row per stratum (see :mod:`.strata`), with confidence intervals
scores.json  all of it but the tiles, with settings, time and memory, what makes the results
             doubtful (see :mod:`.doubts`), why rows have no intervals (``no_interval``), and
             of methods that state uncertainties what :mod:`.confidence` says of them by stratum
cumulative.csv  the distribution of errors (see :mod:`.cumulative`)
sparsification.csv  of such methods: mean errors by the share of pixels taken away
panels/      pictures of tiles: left, right, truth, disparity, error
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereotruth.core.errors import InputError, in_number
from stereotruth.core.job import progress
from stereotruth.core.numerics.statistics import ErrorSum
from stereotruth.core.products.files import atomic_folder, write_table
from stereotruth.core.products.rasters import read_image
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from .confidence import SHARES, Confidence
from .cumulative import Cumulative
from .doubts import Doubts
from .panels import Column, draw_columns
from .prediction_files import read_prediction, read_record, read_uncertainty
from .protocols import Protocol, pair_sha256, protocol_of
from .scores import ALL, Collector, Scorer, Scores
from .strata import Products, exact_truth, height_m_per_px, label_strata, layers_of
from .submission import SUBMITTED, hold_against

log = logging.getLogger("stereotruth")


@dataclass(frozen=True)
class ScoringPlan:
    """How predictions are scored.

    ``thresholds_px``: errors above these count for D1; ``bootstrap``: samples of the tiles for the
    intervals, drawn by ``seed``; ``panels``: most tiles that are drawn; ``protocol``: see
    :mod:`.protocols`, it precedes the thresholds.
    """

    thresholds_px: Sequence[float]
    bootstrap: int
    seed: int
    panels: int
    protocol: str | None = None

    @property
    def sampling(self) -> dict[str, int]:
        """Of the intervals."""
        return {"times": self.bootstrap, "seed": self.seed}


@dataclass
class _Sums:
    """Sums over the pairs that are scored, by ``scorer`` and ``protocol``."""

    dataset: StereoDataset
    scorer: Scorer
    protocol: Protocol
    products: Products
    collector: Collector
    cumulative: Cumulative
    doubts: Doubts
    confidences: dict[str, Confidence] = field(default_factory=dict)
    errors: dict[str, ErrorSum] = field(default_factory=dict)
    scored: list[tuple[str, str]] = field(default_factory=list)  # pairs, digests of their truth

    @classmethod
    def of(cls, dataset: StereoDataset, protocol: Protocol, products: Products) -> _Sums:
        """Of no pair yet."""
        thresholds = protocol.thresholds_px
        scorer = Scorer(dataset.disparity_range, thresholds, dataset.grows_with_height)
        doubts = Doubts(dataset.disparity_range)
        return cls(
            dataset,
            scorer,
            protocol,
            products,
            Collector(thresholds),
            Cumulative(thresholds),
            doubts,
        )

    def add(
        self, pair: Pair, labels: np.ndarray, found: np.ndarray, sigma: np.ndarray | None
    ) -> np.ndarray:
        """Add a pair with disparities ``found`` and their uncertainty; the truth it is held to."""
        scorer, truth = self.scorer, labels
        layers = layers_of(self.dataset, pair)
        strata_of_labels = label_strata(pair, labels, self.products, layers)
        exact_of_pair = exact_truth(pair, self.products)
        truths = [labels]
        if self.protocol.truth == "exact":
            truth = _visible(pair, exact_of_pair)
            truths = [truth, *exact_of_pair.values()]
        self.scored.append((pair.name, pair_sha256(pair, truths)))
        here = scorer.counted(truth)
        self.doubts.add(found, np.where(here, truth, np.nan))
        self.cumulative.add(np.abs(scorer.filled(found)[here] - truth[here].astype(np.float64)))
        sums = scorer.sums(found, truth, strata_of_labels)
        for stratum, exact in exact_of_pair.items():
            sums[stratum] = scorer.sums(found, exact)[ALL]
        error = (found - truth)[here]
        for place in (pair.city, ALL):
            self.errors.setdefault(place, ErrorSum()).add(error[np.isfinite(error)])
        if sigma is not None:
            by_stratum = {
                ALL: truth,
                **{name: np.where(of, truth, np.nan) for name, of in strata_of_labels.items()},
                **exact_of_pair,
            }
            for stratum, exact in by_stratum.items():
                counted = np.where(scorer.counted(exact), exact, np.nan)
                self.confidences.setdefault(stratum, Confidence()).add(found, sigma, counted)
        self.collector.add(pair.name, pair.city, sums)
        return truth

    def rows(self, sampling: Mapping[str, int]) -> dict[str, Any]:
        """Rows ``all``, ``cities``, ``strata`` with intervals by samples of the tiles."""
        scores = self.collector.scores()
        medians = {place: of.figures()["median_absolute"] for place, of in self.errors.items()}
        cities = [
            _row(scores, {"city": city}, sampling, scores.in_city(city))
            | {"median_px": medians[city]}
            for city in _cities(scores)
        ]
        strata = [
            _row(scores, {"stratum": name}, sampling, stratum=name)
            for name in scores.strata
            if scores.row(stratum=name)["labelled"]
        ]
        total = _row(scores, {"city": ALL}, sampling) | {"median_px": medians[ALL]}
        return {"all": total, "cities": cities, "strata": strata}

    def write_tables(self, folder: Path, rows: Mapping[str, Any], pairs: Sequence[Pair]) -> None:
        """All CSV files."""
        scores = self.collector.scores()
        tiles = [
            {"tile": pair.name, "city": pair.city, **scores.row(_only(len(pairs), n))}
            for n, pair in enumerate(pairs)
        ]
        write_table(folder / "scores.csv", tiles)
        write_table(folder / "cities.csv", [*rows["cities"], rows["all"]])
        write_table(folder / "strata.csv", rows["strata"])
        write_table(folder / "cumulative.csv", self.cumulative.rows())
        if self.confidences:
            write_table(folder / "sparsification.csv", _sparsification(self.confidences))


def score(
    dataset: StereoDataset,
    split: str | None,
    label: str,
    predictions: str | Path,
    out: str | Path,
    plan: ScoringPlan,
    *,
    fine_tuned_of: str | None = None,
    products: Products | None = None,
) -> dict[str, Any]:
    """Score the predictions of rule match; returns what scores.json holds.

    ``label``: how the method is called in pictures and tables; ``fine_tuned_of``: the method whose
    training it carried on; ``products``: where the strata of the workflow's own dataset come from.

    Raises InputError if there are no labelled pairs, files are missing, the protocol is not one for
    the dataset, or a submission's scores are others.
    """
    protocol = protocol_of(plan.protocol, dataset, split, plan.thresholds_px)
    pairs = dataset.pairs(split, labelled=True)
    products = products or Products()
    record = read_record(predictions)
    sums = _Sums.of(dataset, protocol, products)
    drawn = {pair.name for pair in choose(pairs, plan.panels)}
    with atomic_folder(out) as scratch:
        for pair in progress(pairs, len(pairs), f"{label}: pairs scored"):
            pair.refuse_changed()
            found, labels = read_prediction(predictions, pair), dataset.labels(pair)
            truth = sums.add(pair, labels, found, read_uncertainty(predictions, pair))
            if pair.name in drawn:
                shown = np.where(sums.scorer.counted(truth), truth, np.float32(np.nan))
                column = Column(
                    pair.name, read_image(pair.left), read_image(pair.right), shown, {label: found}
                )
                draw_columns(scratch / "panels" / f"{pair.name}.png", [column], across=True)
        rows = sums.rows(plan.sampling)
        confidences = sums.confidences.items()
        summary = {
            "label": label,
            "fine_tuned_of": fine_tuned_of,
            **{key: record[key] for key in record if key not in ("pairs", SUBMITTED)},
            "protocol": protocol.identified(sums.scored),
            "tiles": len(pairs),
            "thresholds_px": list(protocol.thresholds_px),
            "bootstrap": plan.bootstrap,
            "height_m_per_px": height_m_per_px(pairs, products),
            "doubts": sums.doubts.lines(),
            "constant_px": sums.doubts.constant_px,
            **rows,
            "confidence": [{"stratum": name, **of.figures()} for name, of in confidences],
        }
        if SUBMITTED in record:
            hold_against(record[SUBMITTED], summary)
        sums.write_tables(scratch, rows, pairs)
        text = json.dumps(summary, indent=2) + "\n"
        (scratch / "scores.json").write_text(text, encoding="utf-8")
    log.info("%s: %s", label, describe(summary))
    for doubt in summary["doubts"]:
        log.warning("%s: %s", label, doubt)
    return summary


def describe(summary: Mapping[str, Any]) -> str:
    """The scores of a method in one line."""
    total, limit = summary["all"], summary["thresholds_px"][0]
    d1 = f"d1_{limit:g}_px_share"
    if not total["labelled"]:
        return "no label in the disparity range"
    if not total["valid_share"]:
        return "no valid disparity"
    text = f"EPE {total['epe_px']:.3f} px, D1 ({limit:g} px) {100 * total[d1]:.2f} %"
    if total["valid_share"] < 1:
        text += (
            f" of the {100 * total['valid_share']:.1f} % of pixels that are valid; holes filled: "
            f"EPE {total['filled_epe_px']:.3f} px, D1 {100 * total[f'filled_{d1}']:.2f} %"
        )
    return f"{text}; {in_number(summary['tiles'], 'pair')}"


def choose(pairs: Sequence[Pair], most: int) -> list[Pair]:
    """At most so many of the pairs, of as many cities as possible, evenly chosen in each."""
    by_city: dict[str, list[Pair]] = {}
    for pair in pairs:
        by_city.setdefault(pair.city, []).append(pair)
    count = dict.fromkeys(by_city, 0)
    for _ in range(min(most, len(pairs))):
        city = min((c for c in by_city if count[c] < len(by_city[c])), key=count.__getitem__)
        count[city] += 1
    chosen = []
    for city, of in by_city.items():
        index = np.linspace(0, len(of) - 1, count[city] + 2)[1:-1] if count[city] < len(of) else ()
        chosen += [of[round(k)] for k in index] if len(index) else (of if count[city] else [])
    return chosen


def _visible(pair: Pair, exact: Mapping[str, np.ndarray]) -> np.ndarray:
    if not exact:
        raise InputError(
            f"pair {pair.name} has no exact truth, by which its protocol scores",
            file=pair.left,
            remedy="take the workflow's own dataset of synthetic cities, or another protocol",
        )
    return exact["exact_visible"]


def _cities(scores: Scores) -> list[str]:
    return list(dict.fromkeys(sorted(scores.cities)))


def _only(count: int, index: int) -> np.ndarray:
    return np.arange(count) == index


def _sparsification(confidences: Mapping[str, Confidence]) -> list[dict[str, Any]]:
    return [
        {
            "stratum": stratum,
            "removed_share": round(float(share), 2),
            "epe_px": round(float(stated), 6),
            "oracle_epe_px": round(float(oracle), 6),
        }
        for stratum, of in confidences.items()
        if of.count
        for share, stated, oracle in zip(SHARES, *of.curves())
    ]


def _row(
    scores: Scores,
    name: Mapping[str, str],
    sampling: Mapping[str, int],
    where: Any = None,
    stratum: str = ALL,
) -> dict[str, Any]:
    """Figures and intervals (``…_low``, ``…_high``) of the chosen tiles."""
    figures = scores.row(where, stratum)
    row: dict[str, Any] = {
        **name,
        "tiles": int(len(scores.tiles) if where is None else where.sum()),
    }
    intervals = scores.intervals(**sampling, where=where, stratum=stratum)
    for key, value in figures.items():
        row[key] = value
        if key in intervals:
            row[f"{key}_low"], row[f"{key}_high"] = intervals[key] or (None, None)
    row["no_interval"] = scores.no_interval(sampling["times"], where, stratum)
    return row
