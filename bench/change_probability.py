"""The trees by which images tell how probable a change is, and how right they are.

python bench/change_probability.py [--fit 1] [--seeds 61 62] [--folder FOLDER]
                                   [--project RUN --scenes jax-1-2 --apart jax-1-13 --draws 1 3]

Of the simulated cities of changes.py, whose images are of one day or a year apart: the share of
labels that have changed by the probability that stereotruth.disparity.change_probability tells.
With --fit the trees are first fitted anew to the cities of these seeds and to changes planted in
the real scenes of a run (planted_changes.py), and written beside that module (pip install
scikit-learn).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product, repeat
from pathlib import Path
from typing import NamedTuple

import numpy as np
from changes import ALONE, CONDITIONS, SHARES, Case, changed_and_kept, dated_truth, inputs_of
from numpy.typing import NDArray
from planted_changes import KINDS, Planted, RealScene

from stereotruth.disparity.change_evidence import Evidence, LabelledWindow, change_evidence
from stereotruth.disparity.change_probability import (
    CHANGED,
    TREES,
    UNCHANGED,
    by_itself,
    probability_by,
    trees,
    with_surroundings,
)
from stereotruth.disparity.crowns import with_crowns
from stereotruth.disparity.learned_evidence import LEARNED, learned
from stereotruth.disparity.recipe import lidar_labels
from stereotruth.disparity.window_points import read_window
from stereotruth.epipolar.image_noise import EQUAL
from stereotruth.lidar.point_store import WATER_CLASS
from stereotruth.numerics.decision_trees import LEAF, DecisionTrees
from stereotruth.simulate.changes import REASONS, TEXTURE
from stereotruth.status import is_labelled

SEEN_ALONE = "moved", "water"  # no two lights tell the first, no labels show the second
APART = CONDITIONS[1]
JOBS = 2  # at once
BINS = 0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.15, CHANGED, 0.7, 1.0
# Share of the pixels that are fitted to, of those that have changed and of others; weight of rare
# ones
OF_CHANGED, FEW, OF_RARE = 0.3, 0.05, 5.0
MOVED = REASONS.split().index("moved")
BEYOND, RANGE_EVERY = (
    0.0005,
    7,
)  # share at either end of what has been learned; pixels that are asked
NUMBER, LEAVES, RATE, LEAST_PIXELS = 100, 16, 0.12, 100  # of the trees


class Sample(NamedTuple):
    """Pixels of a city that have labels by the LiDAR and whose truth is known.

    Of those whose images do not agree closely: the ``evidence`` [k, n], which have ``changed`` [n]
    or are hidden, which have a new ``texture`` [n] alone, and which are ``rare`` [n]: those of two
    lights, moved vehicles of one light, and what is small in real scenes; and which lie in the
    ``upper`` half of their window. Of the others the numbers that have changed and have not
    (``agreed``).
    """

    evidence: NDArray[np.float32]
    changed: NDArray[np.bool_]
    texture: NDArray[np.bool_]
    rare: NDArray[np.bool_]
    upper: NDArray[np.bool_]
    agreed: NDArray[np.int64]


def cases(seeds: list[int], condition: str, fitted: bool) -> list[Case]:
    """Cities of all kinds of change under a condition. Those that trees are ``fitted`` to have
    dense and sparse points by turns, and every other sparse one no classes."""
    out = []
    for kind, seed in product(SHARES, seeds):
        if ALONE.get(kind, condition) != condition or (kind in SEEN_ALONE and condition == APART):
            continue
        dense = seed % 2 == 1 or not fitted
        out.append(Case(kind, condition, seed, 4.0 if dense else 1.0, dense or seed % 4 != 0))
    return out


def samples(
    of: list[Case | PlantedCase], folder: Path, around: bool, pool: Executor
) -> Iterator[tuple[str, Sample]]:
    """Of several cities and real scenes; ``around``: the evidence holds the probabilities of the
    surroundings, too."""
    yield from zip((case.kind for case in of), pool.map(sample, of, repeat(folder), repeat(around)))


@dataclass(frozen=True)
class PlantedCase:
    """Changes planted in a real scene, by the number of a draw."""

    scene: RealScene
    draw: int

    @property
    def apart(self) -> bool:
        """Whether the images share no light."""
        return self.scene.diachronic

    @property
    def kind(self) -> str:
        """For tables."""
        return f"planted in {self.scene.name}"


def sample(case: Case | PlantedCase, folder: Path, around: bool) -> Sample:
    """Of the labels that the LiDAR alone would have: facets and crowns."""
    return sample_of(*compared_of(case, folder), case.apart, around)


def compared_of(case: Case | PlantedCase, folder: Path) -> tuple[LabelledWindow, Marked]:
    """The whole of a case, and what is true there."""
    return planted_scene(case, folder) if isinstance(case, PlantedCase) else city(case, folder)


def planted_scene(case: PlantedCase, folder: Path) -> tuple[LabelledWindow, Marked]:
    """A real scene."""
    planted = Planted.of(case.scene, folder, case.draw)
    changed, kept, _, kind = planted.truth
    rare = np.isin(kind, [KINDS.index(name) + 1 for name in ("cars", "grown", "felled")])
    return planted.compared, Marked(changed, kept, np.zeros_like(changed), rare & changed)


def city(case: Case, folder: Path) -> tuple[LabelledWindow, Marked]:
    """A simulated city."""
    inputs = inputs_of(case, folder)
    rows, cols = (slice(0, side) for side in inputs.pair.model.shape)
    by_lidar = lidar_labels(inputs, *read_window(inputs, rows, cols))
    window, labels = by_lidar.window, by_lidar.labels
    truth, changes = dated_truth(case, folder)
    changed, kept, hidden, texture = np.zeros((4, *labels.status.shape), np.bool_)
    for out, pixels in zip((changed, kept, hidden), changed_and_kept(truth, changes)):
        out[window.inner] = pixels
    texture[window.inner] = changes["reason"] == TEXTURE
    moved = np.zeros_like(changed)
    moved[window.inner] = changes["reason"] == MOVED
    rare = texture & kept if case.apart else moved & changed
    labels = with_crowns(labels, by_lidar.rough, window)
    labelled = is_labelled(labels.status) & (labels.surface_class != WATER_CLASS)
    equal = window.of_equal_noise(inputs.noise)
    compared = LabelledWindow(equal, labels.labels, labelled, labels.surface_class, EQUAL)
    return compared, Marked(changed | hidden, kept, texture, rare)


class Marked(NamedTuple):
    """Pixels [h, w] that have changed or not, that have a new texture, and that are rare."""

    changed: NDArray[np.bool_]
    kept: NDArray[np.bool_]
    texture: NDArray[np.bool_]
    rare: NDArray[np.bool_]


def sample_of(compared: LabelledWindow, of: Marked, apart: bool, around: bool) -> Sample:
    """Of a window; ``apart``: whether its images share no light."""
    doubtful, evidence = change_evidence(compared)
    features = [*evidence]
    if around:
        own = by_itself(evidence, doubtful, apart)
        features += with_surroundings(own, doubtful, compared)
    chosen = (of.changed | of.kept)[doubtful]
    agreed = [
        int((compared.labelled & ~doubtful & pixels).sum()) for pixels in (of.changed, of.kept)
    ]
    of_chosen = (pixels[doubtful][chosen] for pixels in (of.changed, of.texture & of.kept, of.rare))
    upper = np.nonzero(doubtful)[0][chosen] < len(doubtful) // 2
    return Sample(np.stack(features)[:, chosen], *of_chosen, upper, np.array(agreed))


def fit(of: list[Sample]) -> DecisionTrees:
    """Trees by a share of the pixels of all samples."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    rng = np.random.default_rng(0)
    shares = [np.where(s.changed, OF_CHANGED, FEW) for s in of]
    chosen = [rng.random(share.size) < share for share in shares]
    features = np.concatenate([s.evidence[:, c].T for s, c in zip(of, chosen)])
    changed = np.concatenate([s.changed[c] for s, c in zip(of, chosen)])
    weights = np.concatenate(
        [np.where(s.rare, OF_RARE, 1.0)[c] * (FEW / share)[c]
         for s, share, c in zip(of, shares, chosen)]
    )  # fmt: skip
    fitted = HistGradientBoostingClassifier(
        max_iter=NUMBER, max_leaf_nodes=LEAVES, learning_rate=RATE, min_samples_leaf=LEAST_PIXELS,
        early_stopping=False, random_state=0,
    ).fit(features, changed, sample_weight=weights)  # fmt: skip
    rows = [(0, LEAF, 0.0, 0, 0, float(fitted._baseline_prediction.item()))]
    for number, (predictor,) in enumerate(fitted._predictors, 1):
        for at, node in enumerate(predictor.nodes):
            if node["is_leaf"]:
                rows.append((number, LEAF, 0.0, 0, 0, node["value"]))
                continue
            asked = int(node["feature_idx"]), node["num_threshold"], node["missing_go_to_left"]
            rows.append((number, *asked, int(node["right"]) - at, 0.0))
    return DecisionTrees(*(np.array(column) for column in zip(*rows)))


def main() -> None:
    """Fit, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("results/changes"))
    parser.add_argument("--seeds", type=int, nargs="*", default=[61, 62])
    parser.add_argument("--fit", type=int, nargs="+", default=[], help="seeds to fit the trees to")
    parser.add_argument("--project", type=Path, help="a run whose real scenes are fitted to, too")
    parser.add_argument(
        "--scenes", nargs="*", default=[], help="of it, whose images share the light"
    )
    parser.add_argument("--apart", nargs="*", default=[], help="of it, whose images do not")
    parser.add_argument("--draws", type=int, nargs="+", default=[1], help="of planted changes")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.fit:
        of = [
            cases(given.fit, condition, fitted=True)
            + [
                PlantedCase(RealScene(given.project, name, condition == APART), draw)
                for name, draw in product(names, given.draws)
            ]
            for condition, names in zip(CONDITIONS, (given.scenes, given.apart))
        ]
        fit_all(of, given.folder)
    for condition in CONDITIONS:
        report(cases(given.seeds, condition, fitted=False), given.folder)


def fit_all(of: list[list[Case | PlantedCase]], folder: Path) -> None:
    """Trees of both conditions to a table beside the code: those by a pixel itself from the upper
    halves of all images, those that ask its surroundings from the lower ones. To another the range
    of the evidence."""
    sums: list[DecisionTrees] = []
    ranges = ["\t".join(("figure", "diachronic", "low", "high"))]
    for around in (False, True):
        for diachronic, cases_of in enumerate(of):
            with ProcessPoolExecutor(JOBS) as pool:
                found = [s for _, s in samples(cases_of, folder, around, pool)]
            sums.append(fit([half(s, not around) for s in found]))
            if not around:
                ranges += range_of(found, diachronic)
        DecisionTrees.save(TREES, sums)
        trees.cache_clear()
    LEARNED.write_text("\n".join(ranges) + "\n", encoding="utf-8")
    learned.cache_clear()


def half(of: Sample, upper: bool) -> Sample:
    """The pixels of one half of a window."""
    chosen = of.upper == upper
    marked = (of.changed, of.texture, of.rare, of.upper)
    return Sample(of.evidence[:, chosen], *(pixels[chosen] for pixels in marked), of.agreed)


def range_of(of: list[Sample], diachronic: int) -> list[str]:
    """Lines of the table of what has been learned."""
    values = np.concatenate([s.evidence[:, ::RANGE_EVERY] for s in of], axis=1)
    low, high = np.nanquantile(values, [BEYOND, 1.0 - BEYOND], axis=1)
    return [
        f"{name}\t{diachronic}\t{a:.6g}\t{b:.6g}" for name, a, b in zip(Evidence._fields, low, high)
    ]


def report(of: list[Case], folder: Path) -> None:
    """Print what is found and lost of each kind, and what has changed of labels by probability."""
    counts = np.zeros((2, len(BINS) - 1), np.int64)
    of_kind: dict[str, NDArray[np.int64]] = {}
    diachronic = of[0].apart
    with ProcessPoolExecutor(JOBS) as pool:
        for kind, s in samples(of, folder, around=True, pool=pool):
            p = probability_by(trees(diachronic)[1], s.evidence)
            counts += [np.histogram(p[part], BINS)[0] for part in (s.changed, ~s.changed)]
            counts[:, np.searchsorted(BINS, UNCHANGED) - 1] += s.agreed
            left, changed = p > CHANGED, s.changed
            shares = [
                (left & changed).sum(), changed.sum() + s.agreed[0],
                (left & ~changed).sum(), (~changed).sum() + s.agreed[1],
                (left & s.texture).sum(), s.texture.sum(), *s.agreed,
            ]  # fmt: skip
            of_kind[kind] = of_kind.get(kind, 0) + np.array(shares)
    print(f"images {of[0].condition}:")
    for kind, (found, changed, lost, kept, blank, texture, *_) in of_kind.items():
        print(
            f"{kind}: {100 * found / max(changed, 1):.1f} % of the changed are found, "
            f"{100 * lost / max(kept, 1):.2f} % of the others lost, "
            f"{100 * blank / max(texture, 1):.1f} % of new texture that does not agree closely"
        )
    for low, high, n, others in zip(BINS, BINS[1:], *counts):
        if n + others:
            share = 100.0 * n / (n + others)
            print(f"P {low} to {high}: {share:.2f} % of {n + others} have changed")
    changed, kept = sum(of_kind.values())[-2:]
    print(f"of {changed + kept} labels whose images agree closely {changed} have changed")


if __name__ == "__main__":
    main()
