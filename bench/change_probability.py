"""The trees by which images of two lights tell how probable a change is, and how right they are.

python bench/change_probability.py [--fit 1 2 3 4 5 6 7 8 9 10 11 12] [--seeds 61 62]
                                   [--folder FOLDER]

Of the simulated cities of changes.py whose images are a year apart: the share of labels that have
changed by the probability that stereotruth.disparity.change_probability tells. With --fit the trees
are first fitted anew to the cities of these seeds, and written beside that module (pip install
scikit-learn).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from changes import CONDITIONS, Case, changed_and_kept, dated_truth, inputs_of
from numpy.typing import NDArray

from stereotruth.disparity.change_probability import (
    AGREED,
    CHANGED,
    LEAST_SIGNAL,
    TREES,
    UNKNOWN,
    Evidence,
    by_itself,
    change_evidence,
    trees,
    with_surroundings,
)
from stereotruth.disparity.recipe import lidar_labels
from stereotruth.disparity.status import VEGETATION_CLASSES, is_labelled
from stereotruth.disparity.window_points import read_window
from stereotruth.numerics.decision_trees import LEAF, DecisionTrees
from stereotruth.simulate.changes import TEXTURE

KINDS = (
    "nothing", "texture", "built", "demolished", "raised", "felled", "grown", "crops", "mixed",
    "noise", "mixed in noise", "sun", "leaves",
)  # fmt: skip
DENSITY = 4.0  # points/m²
BINS = 0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.15, CHANGED, 0.7, 1.0
# Share of the pixels that are fitted to, weight of those of new texture alone, which are few
FEW, OF_TEXTURE = 0.15, 5.0
NUMBER, LEAVES, RATE, LEAST_PIXELS = 100, 16, 0.12, 200  # of the trees


class Sample(NamedTuple):
    """Pixels of a city that have labels by the LiDAR and whose truth is known, crowns apart.

    Of those whose images do not agree fully: the ``evidence`` [k, n], which have ``changed`` [n] or
    are hidden, and which have a new ``texture`` [n] alone; of the others the numbers that have
    changed and have not (``agreed``).
    """

    evidence: NDArray[np.float32]
    changed: NDArray[np.bool_]
    texture: NDArray[np.bool_]
    agreed: tuple[int, int]

    @property
    def is_silent(self) -> NDArray[np.bool_]:
        """Whether noise leaves nothing to tell by [n]."""
        return ~(self.evidence[Evidence._fields.index("signal")] >= LEAST_SIGNAL)


def samples(seeds: list[int], folder: Path, around: bool) -> Iterator[tuple[str, Sample]]:
    """Of all kinds of change; ``around``: the evidence holds the probabilities of the surroundings,
    too."""
    for kind, seed in product(KINDS, seeds):
        yield kind, sample(Case(kind, CONDITIONS[1], seed, DENSITY), folder, around)


def sample(case: Case, folder: Path, around: bool) -> Sample:
    """Of the labels that the LiDAR alone would have."""
    inputs = inputs_of(case, folder)
    rows, cols = (slice(0, side) for side in inputs.pair.model.shape)
    by_lidar = lidar_labels(inputs, *read_window(inputs, rows, cols))
    window, comparison, labels = by_lidar.window, by_lidar.comparison, by_lidar.labels
    labelled = is_labelled(labels.status)
    doubtful, evidence = change_evidence(
        labels.labels, window, comparison.window_px, comparison.noise, labelled
    )
    features = [*evidence]
    if around:
        own = by_itself(evidence, doubtful)
        features += with_surroundings(own, doubtful, labels.labels, window, labelled)
    truth, changes = dated_truth(case, folder)
    changed, kept, hidden, texture = np.zeros((4, *labelled.shape), np.bool_)
    for out, pixels in zip((changed, kept, hidden), changed_and_kept(truth, changes)):
        out[window.inner] = pixels
    texture[window.inner] = changes["reason"] == TEXTURE
    known = labelled & ~np.isin(labels.surface_class, VEGETATION_CLASSES)
    changed |= hidden
    agreed = tuple(int((known & ~doubtful & of).sum()) for of in (changed, kept))
    chosen = (known & (changed | kept))[doubtful]
    arrays = np.stack(features)[:, chosen]
    return Sample(arrays, changed[doubtful][chosen], (texture & kept)[doubtful][chosen], agreed)


def fit(of: list[Sample]) -> DecisionTrees:
    """Trees by a share of the pixels of all samples."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    rng = np.random.default_rng(0)
    chosen = [(rng.random(s.changed.size) < FEW) & ~s.is_silent for s in of]
    features = np.concatenate([s.evidence[:, c].T for s, c in zip(of, chosen)])
    changed = np.concatenate([s.changed[c] for s, c in zip(of, chosen)])
    texture = np.concatenate([s.texture[c] for s, c in zip(of, chosen)])
    fitted = HistGradientBoostingClassifier(
        max_iter=NUMBER, max_leaf_nodes=LEAVES, learning_rate=RATE, min_samples_leaf=LEAST_PIXELS,
        early_stopping=False, random_state=0,
    ).fit(features, changed, sample_weight=np.where(texture, OF_TEXTURE, 1.0))  # fmt: skip
    rows = [(0, LEAF, 0.0, 0, 0, 0, float(fitted._baseline_prediction.item()))]
    for number, (predictor,) in enumerate(fitted._predictors, 1):
        for at, node in enumerate(predictor.nodes):
            if node["is_leaf"]:
                rows.append((number, LEAF, 0.0, 0, 0, 0, node["value"]))
                continue
            steps = int(node["left"]) - at, int(node["right"]) - at
            asked = int(node["feature_idx"]), node["num_threshold"], node["missing_go_to_left"]
            rows.append((number, *asked, *steps, 0.0))
    return DecisionTrees(*(np.array(column) for column in zip(*rows)))


def main() -> None:
    """Fit, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("results/changes"))
    parser.add_argument("--seeds", type=int, nargs="*", default=[61, 62])
    parser.add_argument("--fit", type=int, nargs="+", default=[], help="seeds to fit the trees to")
    given = parser.parse_args()

    def fitted(seeds: list[int], around: bool) -> DecisionTrees:
        of = [s for _, s in samples(seeds, given.folder, around)]
        changed, kept = np.sum([s.agreed for s in of], axis=0)
        print(f"of pixels that agree fully {changed / (changed + kept):.6f} have changed")
        silent = np.sum([[(s.is_silent & s.changed).sum(), s.is_silent.sum()] for s in of], axis=0)
        print(f"of those that noise keeps from telling {silent[0] / max(silent[1], 1):.4f} have")
        return fit(of)

    if given.fit:
        # the probabilities that the second ask are those of cities that the first do not know
        middle = len(given.fit) // 2
        own = fitted(given.fit[:middle], around=False)
        DecisionTrees.save(TREES, [own, own])
        trees.cache_clear()
        DecisionTrees.save(TREES, [own, fitted(given.fit[middle:], around=True)])
        trees.cache_clear()
    report(given.seeds, given.folder)


def report(seeds: list[int], folder: Path) -> None:
    """Print what is found and lost of each kind, and what has changed of labels by probability."""
    counts = np.zeros((2, len(BINS) - 1), np.int64)
    of_kind: dict[str, NDArray[np.int64]] = {}
    for kind, of in samples(seeds, folder, around=True):
        odds, changed = trees()[1].sum_at(of.evidence).astype(np.float64), of.changed
        p = np.where(of.is_silent, UNKNOWN, 1.0 / (1.0 + np.exp(-odds)))
        counts += [np.histogram(p[part], BINS)[0] for part in (changed, ~changed)]
        counts[:, np.searchsorted(BINS, AGREED) - 1] += of.agreed
        left = p > CHANGED
        shares = [
            (left & changed).sum(), changed.sum() + of.agreed[0],
            (left & ~changed).sum(), (~changed).sum() + of.agreed[1],
            (left & of.texture).sum(), of.texture.sum(),
        ]  # fmt: skip
        of_kind[kind] = of_kind.get(kind, 0) + np.array(shares)
    for kind, (found, changed, lost, kept, blank, texture) in of_kind.items():
        print(
            f"{kind}: {100 * found / max(changed, 1):.1f} % of the changed are found, "
            f"{100 * lost / max(kept, 1):.2f} % of the others lost, "
            f"{100 * blank / max(texture, 1):.1f} % of new texture that does not agree fully"
        )
    for low, high, n, others in zip(BINS, BINS[1:], *counts):
        if n + others:
            share = 100.0 * n / (n + others)
            print(f"P {low} to {high}: {share:.2f} % of {n + others} have changed")


if __name__ == "__main__":
    main()
