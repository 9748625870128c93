"""The weights by which images of two lights tell how probable a change is, and how right they are.

python bench/change_probability.py [--fit 1 2 3] [--seeds 41 42] [--folder FOLDER]

Of the simulated cities of changes.py whose images are a year apart, with and without predicted
shadows: the share of labels that have changed by the probability that
stereotruth.disparity.change_probability tells. With --fit the weights of its logistic regressions,
as they follow from the cities of these seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from changes import CONDITIONS, Case, changed_and_kept, dated_truth, inputs_of
from numpy.typing import NDArray

from stereotruth.disparity.change_probability import (
    CHANGED,
    WEIGHTS,
    WEIGHTS_LIT,
    Evidence,
    Weights,
    around,
    by_itself,
    change_evidence,
    log_odds,
    probability_with,
)
from stereotruth.disparity.pixel_labels import Labels
from stereotruth.disparity.recipe import lidar_labels
from stereotruth.disparity.status import VEGETATION_CLASSES, is_labelled
from stereotruth.disparity.window_points import read_window

KINDS = (
    "nothing", "texture", "built", "demolished", "raised", "felled", "grown", "crops", "mixed",
)  # fmt: skip
DENSITY = 4.0  # points/m²
BINS = 0.0, 0.002, 0.005, 0.01, 0.02, 0.05, CHANGED, 0.3, 0.6, 1.0
FEW = 0.1  # share of the pixels that are fitted to


class Sample(NamedTuple):
    """Pixels of a city whose truth is known: the images' ``evidence`` of its ``labels`` where there
    are any (``labelled``), what is ``changed`` and what is ``kept``; arrays [h, w]."""

    evidence: Evidence
    labels: Labels
    labelled: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    kept: NDArray[np.bool_]


def samples(seeds: list[int], folder: Path, lit: bool) -> Iterator[tuple[str, Sample]]:
    """Of all kinds of change; ``lit``: shadows are predicted."""
    for kind in KINDS:
        for seed in seeds:
            yield kind, sample(Case(kind, CONDITIONS[1], seed, DENSITY, with_suns=lit), folder)


def sample(case: Case, folder: Path) -> Sample:
    """Of the labels that the LiDAR alone would have, but for crowns."""
    inputs = inputs_of(case, folder)
    rows, cols = (slice(0, side) for side in inputs.pair.model.shape)
    by_lidar = lidar_labels(inputs, *read_window(inputs, rows, cols))
    window, comparison, labels = by_lidar.window, by_lidar.comparison, by_lidar.labels
    labelled = is_labelled(labels.status)
    evidence = change_evidence(
        labels.labels, window, comparison.window_px, comparison.noise, labelled
    )
    changed, kept = np.zeros((2, *labelled.shape), np.bool_)
    changed[window.inner], kept[window.inner] = changed_and_kept(*dated_truth(case, folder))
    known = labelled & ~np.isin(labels.surface_class, VEGETATION_CLASSES)
    changed, kept = changed & known, kept & known
    return Sample(evidence, labels.labels, labelled, changed, kept)


def regression(columns: list[NDArray], changed: NDArray[np.bool_]) -> list[float]:
    """Constant and weights of the ``columns`` [n] by maximum likelihood (Newton's method)."""
    x = np.column_stack([np.ones(changed.size), *columns])
    weights = np.zeros(x.shape[1])
    for _ in range(30):
        p = 1.0 / (1.0 + np.exp(-x @ weights))
        step = np.linalg.solve((x.T * (p * (1.0 - p))) @ x, x.T @ (changed - p))
        weights += step
    return weights.tolist()


def fit(of: list[Sample]) -> Weights:
    """Weights by a share of the pixels of all samples."""
    rng = np.random.default_rng(0)
    tells = [~np.isnan(s.evidence.agreement) & ~s.evidence.is_weak for s in of]
    either = [s.changed | s.kept for s in of]
    chosen = [e & t & (rng.random(t.shape) < FEW) for e, t in zip(either, tells)]
    silent = [e & np.isnan(s.evidence.agreement) for s, e in zip(of, either)]
    unknown = sum((s.changed & q).sum() for s, q in zip(of, silent)) / sum(map(np.sum, silent))

    def column(values: list[NDArray]) -> NDArray:
        return np.concatenate([v[c] for v, c in zip(values, chosen)])

    changed = column([s.changed for s in of])
    evidence = ([getattr(s.evidence, n) for s in of] for n in ("agreement", "advantage"))
    first = regression([column(values) for values in evidence], changed)
    weights = Weights(*first, 0.0, 0.0, 0.0, float(unknown))
    own = [by_itself(s.evidence, weights) for s in of]
    near = [around(p, s.labels, s.labelled) for p, s in zip(own, of)]
    second = regression([column([log_odds(p) for p in ps]) for ps in (own, near)], changed)
    return Weights(*first, *second, float(unknown))


def main() -> None:
    """Print weights and tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("results/changes"))
    parser.add_argument("--seeds", type=int, nargs="*", default=[41, 42])
    parser.add_argument("--fit", type=int, nargs="+", default=[], help="seeds to fit weights to")
    given = parser.parse_args()
    for lit, weights in ((False, WEIGHTS), (True, WEIGHTS_LIT)):
        print("predicted shadows" if lit else "no suns known", flush=True)
        if given.fit:
            fitted = fit([s for _, s in samples(given.fit, given.folder, lit)])
            print("  " + ", ".join(f"{name} {w:.3f}" for name, w in fitted._asdict().items()))
        changed, every = np.zeros((2, len(BINS) - 1), np.int64)
        for kind, of in samples(given.seeds, given.folder, lit):
            p = probability_with(weights, of.evidence, of.labels, of.labelled)
            changed += np.histogram(p[of.changed], BINS)[0]
            every += np.histogram(p[of.changed | of.kept], BINS)[0]
            parts = {"of the changed are found": of.changed, "of the others lost": of.kept}
            shares = [
                f"{100.0 * (p[part] > CHANGED).mean():.1f} % {name}"
                for name, part in parts.items()
                if part.any()
            ]
            print(f"  {kind}: {', '.join(shares)}", flush=True)
        for low, high, n, of_all in zip(BINS, BINS[1:], changed, every):
            if of_all:
                print(f"  P {low} to {high}: {100.0 * n / of_all:.2f} % of {of_all} have changed")


if __name__ == "__main__":
    main()
