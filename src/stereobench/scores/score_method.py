"""A method's predictions of a dataset against its labels: a folder of scores and pictures.

scores.csv   a row per tile
cities.csv   a row per city, and one of all, with 95 % confidence intervals, and the median absolute
             error of the valid pixels (``median_px``; what is beyond 16 px counts as 16)
strata.csv   a row per stratum (see :mod:`.strata`), with confidence intervals
scores.json  all of it but the tiles, with settings, time and memory, the seal of the labels
             (:mod:`stereotruth.tiles.seals`), what makes the results doubtful (see
             :class:`.scores.Doubts`), why rows have no intervals (``no_interval``), and of methods
             that state uncertainties what :mod:`.confidence` says by stratum
cumulative.csv  the distribution of errors (see :class:`.scores.Cumulative`)
sparsification.csv  of such methods: mean errors by the share of pixels taken away
panels/      pictures of tiles: left, right, truth, disparity, error
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from .panels import Column, draw_columns
from .prediction_files import (
    SUBMITTED,
    hold_against,
    read_prediction,
    read_record,
    read_uncertainty,
)
from .protocols import Protocol, pair_sha256, protocol_of
from .scores import ALL, Cumulative, Doubts, Scorer, Scores
from .strata import Products, exact_truth, height_m_per_px, label_strata, layers_of

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


class _Sums:
    """Sums over the pairs of a dataset that are scored by a protocol."""

    def __init__(self, dataset: StereoDataset, protocol: Protocol, products: Products) -> None:
        self.dataset, self.protocol, self.products = dataset, protocol, products
        thresholds = protocol.thresholds_px
        self.scorer = Scorer(dataset.disparity_range, thresholds, dataset.grows_with_height)
        self.scores, self.cumulative = Scores(thresholds), Cumulative(thresholds)
        self.doubts = Doubts(dataset.disparity_range)
        self.confidences: dict[str, Confidence] = {}
        self.errors: dict[str, ErrorSum] = {}  # by city, and of all
        self.scored: list[tuple[str, str]] = []  # pairs, digests of their truth

    def add(
        self, pair: Pair, labels: np.ndarray, found: np.ndarray, sigma: np.ndarray | None
    ) -> np.ndarray:
        """Add a pair with disparities ``found`` and their uncertainty; the truth it is held to."""
        scorer, truth = self.scorer, labels
        strata = label_strata(pair, labels, self.products, layers_of(self.dataset, pair))
        exact = exact_truth(pair, self.products)
        truths = [labels]
        if self.protocol.truth == "exact":
            if not exact:
                raise InputError(
                    f"pair {pair.name} has no exact truth, by which its protocol scores",
                    file=pair.left,
                    remedy="take the workflow's own dataset of synthetic cities, or another "
                    "protocol",
                )
            truth = exact["exact_visible"]
            truths = [truth, *exact.values()]
        self.scored.append((pair.name, pair_sha256(pair, truths)))
        here = scorer.counted(truth)
        self.doubts.add(found, np.where(here, truth, np.nan))
        self.cumulative.add(np.abs(scorer.filled(found)[here] - truth[here].astype(np.float64)))
        sums = scorer.sums(found, truth, strata)
        sums |= {stratum: scorer.sums(found, of)[ALL] for stratum, of in exact.items()}
        self.scores.add(pair.name, pair.city, sums)
        error = (found - truth)[here]
        for place in (pair.city, ALL):
            self.errors.setdefault(place, ErrorSum()).add(error[np.isfinite(error)])
        if sigma is not None:
            within = {name: np.where(of, truth, np.nan) for name, of in strata.items()}
            for stratum, of in {ALL: truth, **within, **exact}.items():
                counted = np.where(scorer.counted(of), of, np.nan)
                self.confidences.setdefault(stratum, Confidence()).add(found, sigma, counted)
        return truth

    def rows(self, plan: ScoringPlan) -> dict[str, Any]:
        """Rows ``all``, ``cities``, ``strata`` with intervals by samples of the tiles."""
        scores = self.scores
        cities = [city for _, city, _ in scores.tiles]
        counts = {city: cities.count(city) for city in sorted(set(cities))} | {ALL: len(cities)}

        def row(name: Mapping[str, str], city: str | None = None, stratum: str = ALL) -> dict:
            found: dict[str, Any] = {**name, "tiles": counts[city or ALL]}
            intervals = scores.intervals(plan.bootstrap, plan.seed, city, stratum)
            for key, value in scores.row(city, stratum).items():
                found[key] = value
                if key in intervals:
                    found[f"{key}_low"], found[f"{key}_high"] = intervals[key] or (None, None)
            return found | {"no_interval": scores.no_interval(plan.bootstrap, city, stratum)}

        by_city = {
            city: row({"city": city}, None if city == ALL else city)
            | {"median_px": self.errors[city].figures()["median_absolute"]}
            for city in counts
        }
        strata = [
            row({"stratum": name}, stratum=name)
            for name in scores.strata
            if scores.row(stratum=name)["labelled"]
        ]
        return {"all": by_city.pop(ALL), "cities": list(by_city.values()), "strata": strata}

    def write_tables(self, folder: Path, rows: Mapping[str, Any]) -> None:
        """All CSV files."""
        tiles = [
            {"tile": tile, "city": city, **self.scores.figures(sums[ALL])}
            for tile, city, sums in self.scores.tiles
        ]
        write_table(folder / "scores.csv", tiles)
        write_table(folder / "cities.csv", [*rows["cities"], rows["all"]])
        write_table(folder / "strata.csv", rows["strata"])
        write_table(folder / "cumulative.csv", self.cumulative.rows())
        curves = [
            {
                "stratum": stratum,
                "removed_share": round(float(share), 2),
                "epe_px": round(float(stated), 6),
                "oracle_epe_px": round(float(oracle), 6),
            }
            for stratum, of in self.confidences.items()
            if of.count
            for share, stated, oracle in zip(SHARES, *of.curves())
        ]
        if self.confidences:
            write_table(folder / "sparsification.csv", curves)


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
    sums = _Sums(dataset, protocol, products)
    drawn = {pair.name for pair in choose(pairs, plan.panels)}
    with atomic_folder(out) as scratch:
        for pair in progress(pairs, len(pairs), f"{label}: pairs scored"):
            pair.refuse_changed()
            found, labels = read_prediction(predictions, pair), dataset.labels(pair)
            truth = sums.add(pair, labels, found, read_uncertainty(predictions, pair))
            if pair.name in drawn:
                shown = np.where(sums.scorer.counted(truth), truth, np.float32(np.nan))
                images = read_image(pair.left), read_image(pair.right)
                column = Column(pair.name, *images, shown, {label: found})
                draw_columns(scratch / "panels" / f"{pair.name}.png", [column], across=True)
        rows = sums.rows(plan)
        confidences = sums.confidences.items()
        summary = {
            "label": label,
            "fine_tuned_of": fine_tuned_of,
            **{key: record[key] for key in record if key not in ("pairs", SUBMITTED)},
            "protocol": protocol.identified(sums.scored),
            "seal": dataset.seal,
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
        sums.write_tables(scratch, rows)
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
        if count[city] == len(of):
            chosen += of
        else:
            places = np.linspace(0, len(of) - 1, count[city] + 2)[1:-1]
            chosen += [of[round(k)] for k in places]
    return chosen
