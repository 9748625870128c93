"""The trees by which images tell how probable a change is, and how right they are.

python bench/change_probability.py [--fit] [--seeds 61 62] [--folder FOLDER] [--real ../shared/real]

Of the simulated cities of changes.py, whose images are of one day or a year apart: the share of
labels that have changed by the probability that stereotruth.labels.change_probability tells.
With --fit the trees are first fitted anew, and written beside that module (pip install
scikit-learn): to simulated cities, to made fields, and to changes planted in real scenes, where
the folder of these is. Draws stay in the folder: delete it when the evidence has changed.
"""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from changes import (
    ALONE,
    CONDITIONS,
    SHARES,
    SIDE_PX,
    Case,
    changed_and_kept,
    dated_truth,
    inputs_of,
)
from made_fields import in_eight_bits, made_field
from numpy.typing import NDArray
from planted_changes import GROUND, KINDS, ROOF, Planted, RealScene
from real import Pair, Site

from stereocities.truth import REASONS, TEXTURE
from stereotruth.core.products.files import atomic_file
from stereotruth.core.status import is_labelled
from stereotruth.labels.change_evidence import (
    LEARNED,
    Evidence,
    LabelledWindow,
    change_evidence,
    learned,
)
from stereotruth.labels.change_probability import (
    CHANGED,
    TREES,
    UNCHANGED,
    least_probability,
    probability_by,
    probability_by_evidence,
    trees,
    with_surroundings,
)
from stereotruth.labels.decision_trees import LEAF, DecisionTrees
from stereotruth.labels.recipe import image_window, labels_around
from stereotruth.lidar.point_store import WATER_CLASS
from stereotruth.sensor.image_noise import EQUAL

Bools = NDArray[np.bool_]
Singles = NDArray[np.float32]

SEEN_ALONE = "moved", "water"  # no two lights tell the first, no labels show the second
APART = CONDITIONS[1]
JOBS = 2  # at once
BINS = 0.0, 0.002, 0.005, 0.01, 0.02, 0.05, 0.15, CHANGED, 0.7, 1.0
# What trees are fitted to: cities of all kinds by dense points, of some by sparse ones, of some in
# images of 8 bits; made fields; and changes planted in real scenes, by the numbers of draws.
DENSE_SEED, SPARSE_SEED, FIT_SIDE_PX = 1, 2, 640
OF_SPARSE = "mixed", "built", "grown", "moved", "leaves", "texture", "water"
IN_EIGHT_BITS = "mixed", "felled", "grown", "moved", "nothing", "woods", "raised"
FIELDS = 48  # of either light
REAL = (
    ("jacksonville", "J001-J002", False, (1, 3)),
    ("marseille", "left-right", False, (1,)),
    ("jacksonville", "J001-J013", True, (1, 3)),
    ("jacksonville", "J002-J003", True, (1,)),
    ("jacksonville", "J004-J005", True, (1,)),
    ("jacksonville", "J005-J007", True, (1,)),
    ("jacksonville", "J011-J012", True, (1,)),
)
UNKNOWN = 0.05  # share that has changed of pixels of which nothing is known
# Share of the pixels that are fitted to, of those that have changed and of others; weight of rare
# ones and of new texture
OF_CHANGED, FEW, OF_RARE, OF_TEXTURE = 0.3, 0.05, 5.0, 10.0
MOVED = REASONS.split().index("moved")
BEYOND = 0.01  # share at either end of what has been learned
NUMBER, LEAVES, RATE, LEAST_PIXELS = 100, 16, 0.12, 100  # of the trees


class Marked(NamedTuple):
    """Pixels [h, w] that have ``changed`` or are hidden by what has, those that have been
    ``kept``, those that have a new ``texture`` alone, and those that are ``rare``: moved vehicles
    of one light, and what is small in real scenes. The ``kind`` of
    what is planted, 1 the first of KINDS and 0 none."""

    changed: Bools
    kept: Bools
    texture: Bools
    rare: Bools
    kind: NDArray[np.uint8]


class Drawn(NamedTuple):
    """Pixels of a window that have labels by the LiDAR and whose truth is known: which are
    ``doubtful`` [h, w], the ``evidence`` [k, n] of these, and what is true."""

    compared: LabelledWindow
    marked: Marked
    doubtful: Bools
    evidence: Singles


@dataclass(frozen=True)
class City:
    """A simulated city, whose images may be turned into such of 8 bits."""

    case: Case
    eight_bits: bool = False

    @property
    def apart(self) -> bool:
        """Whether the images share no light."""
        return self.case.apart

    @property
    def name(self) -> str:
        """Of the file that keeps it."""
        c, bits = self.case, "-8-bits" if self.eight_bits else ""
        return f"{c.kind}-{c.condition}-{c.seed}-{c.density}-{c.side_px}{bits}".replace(" ", "_")

    def compared(self, folder: Path) -> tuple[LabelledWindow, Marked]:
        """The whole of it, and what is true there."""
        inputs = inputs_of(self.case, folder)
        rows, cols = (slice(0, side) for side in inputs.pair.model.shape)
        by_lidar = labels_around(inputs, rows, cols)
        window, labels = image_window(inputs, rows, cols, by_lidar), by_lidar.labels
        truth, changes = dated_truth(self.case, folder)
        changed, kept, hidden, texture, moved = np.zeros((5, *labels.status.shape), np.bool_)
        for out, pixels in zip((changed, kept, hidden), changed_and_kept(truth, changes)):
            out[window.inner] = pixels
        texture[window.inner] = changes["reason"] == TEXTURE
        moved[window.inner] = changes["reason"] == MOVED
        rare = moved & changed & (not self.apart)
        labelled = is_labelled(labels.status) & (labels.surface_class != WATER_CLASS)
        noise = inputs.noise
        if self.eight_bits:
            window, noise = in_eight_bits(inputs, window)
        compared = LabelledWindow(
            window.of_equal_noise(noise), labels.labels, labelled, labels.surface_class, EQUAL
        )
        none = np.zeros_like(changed, np.uint8)
        return compared, Marked(changed | hidden, kept, texture, rare, none)


@dataclass(frozen=True)
class PlantedIn:
    """Changes planted in a real scene, by the number of a draw."""

    scene: RealScene
    draw: int

    @property
    def apart(self) -> bool:
        """Whether the images share no light."""
        return self.scene.diachronic

    @property
    def name(self) -> str:
        """Of the file that keeps it."""
        light = "two" if self.apart else "one"
        return f"{self.scene.project.name}-{self.scene.name}-{self.draw}-{light}"

    def is_of(self, site: str) -> bool:
        """Whether it lies there."""
        return self.scene.project.name == site

    def make_points(self, folder: Path) -> None:
        """Points and surface with and without what is planted."""
        place = folder / "planted" / self.scene.project.name
        place.mkdir(parents=True, exist_ok=True)
        for number in (0, self.draw):
            self.scene.inputs(self.scene.stores(place, number))

    def compared(self, folder: Path) -> tuple[LabelledWindow, Marked]:
        """The whole of it, and what is true there."""
        planted = Planted.of(self.scene, folder / "planted" / self.scene.project.name, self.draw)
        changed, kept, _, kind = planted.truth
        small = np.isin(kind, [KINDS.index(name) + 1 for name in ("cars", "grown", "felled")])
        no_texture = np.zeros_like(changed)
        return planted.compared, Marked(changed, kept, no_texture, small & changed, kind)


@dataclass(frozen=True)
class Made:
    """A made field, by its number."""

    number: int
    apart: bool

    @property
    def name(self) -> str:
        """Of the file that keeps it."""
        return f"field-{self.number}-{'two' if self.apart else 'one'}"

    def compared(self, _folder: Path) -> tuple[LabelledWindow, Marked]:
        """The whole of it, and what is true there."""
        compared, changed, same = made_field(self.number, self.apart)
        none = np.zeros_like(changed)
        return compared, Marked(changed, same, none, none, none.astype(np.uint8))


Draw = City | PlantedIn | Made


def cities(seed: int, density: float, kinds: tuple[str, ...], side_px: int) -> Iterator[Case]:
    """Of kinds of change, under both conditions where both can tell it."""
    for kind in kinds:
        for condition in CONDITIONS:
            is_told = kind not in SEEN_ALONE or condition != APART
            if ALONE.get(kind, condition) == condition and is_told:
                yield Case(kind, condition, seed, density, side_px=side_px)


def draws_to_fit(real: Path, folder: Path) -> list[Draw]:
    """All that trees are fitted to; of the real sites those whose folders are there."""
    dense = [*cities(DENSE_SEED, 4.0, tuple(SHARES), FIT_SIDE_PX)]
    out: list[Draw] = [City(case) for case in dense]
    out += [City(case, eight_bits=True) for case in dense if case.kind in IN_EIGHT_BITS]
    out += [City(case) for case in cities(SPARSE_SEED, 1.0, OF_SPARSE, FIT_SIDE_PX)]
    out += [Made(number, apart) for apart in (False, True) for number in range(FIELDS)]
    for name in dict.fromkeys(name for name, *_ in REAL):
        if not (real / name).is_dir():
            print(f"{real / name} is absent: fitted without it")
            continue
        site = Site(real / name, folder / "real" / name)
        of_site = [pair for pair in REAL if pair[0] == name]
        pairs = list(dict.fromkeys(pair for _, pair, *_ in of_site))
        if not all(Pair(site, pair).product("project").is_dir() for pair in pairs):
            site.make(pairs, "", 256, JOBS)
        for _, pair, apart, numbers in of_site:
            of_scene = [PlantedIn(RealScene(site.project, pair, apart), n) for n in numbers]
            for planted in of_scene:  # one after the other: pairs of a site share them
                planted.make_points(folder)
            out += of_scene
    return out


def measured(draw: Draw, folder: Path) -> Drawn:
    """The window of a draw."""
    compared, marked = draw.compared(folder)
    doubtful, evidence = change_evidence(compared)
    return Drawn(compared, marked, doubtful, np.stack(evidence))


def drawn(draw: Draw, folder: Path) -> Drawn:
    """The window of a draw, made once."""
    file = folder / "drawn" / f"{draw.name}.pickle"
    if not file.is_file():
        file.parent.mkdir(exist_ok=True)
        with atomic_file(file) as scratch, scratch.open("wb") as stream:
            pickle.dump(measured(draw, folder), stream)
    with file.open("rb") as stream:
        return pickle.load(stream)


class Sample(NamedTuple):
    """Pixels that trees are fitted to: ``features`` [n, k], which have ``changed``, and their
    ``weight``."""

    features: Singles
    changed: Bools
    weight: NDArray[np.float64]


def sample(draw: Draw, folder: Path, first: DecisionTrees | None) -> Sample:
    """Of a draw: of the upper half of its window for trees that ask a pixel's own evidence; of the
    lower half, with what the ``first`` trees say of the surroundings."""
    of = drawn(draw, folder)
    marked = [pixels[of.doubtful] for pixels in of.marked]
    changed, kept, texture, rare, _ = marked
    row = np.nonzero(of.doubtful)[0]
    here = (row < len(of.doubtful) // 2) == (first is None)
    share = np.where(changed, OF_CHANGED, FEW)
    rng = np.random.default_rng([len(row), first is None])
    chosen = here & (changed | kept) & (rng.random(share.size) < share)
    features = [*of.evidence]
    if first is not None:
        features += surroundings(of, first)
    weight = np.select([texture & kept & draw.apart, rare], [OF_TEXTURE, OF_RARE], 1.0)
    weight *= FEW / share
    return Sample(np.stack(features)[:, chosen].T, changed[chosen], weight[chosen])


def surroundings(of: Drawn, first: DecisionTrees) -> list[Singles]:
    """What the first trees say of the pixels around doubtful ones."""
    own = np.full(of.doubtful.shape, UNCHANGED)
    own[of.doubtful] = probability_by(first, of.evidence)
    return with_surroundings(own, of.doubtful, of.compared)


def fit(of: list[Sample]) -> DecisionTrees:
    """Trees by the pixels of all samples."""
    from sklearn.ensemble import HistGradientBoostingClassifier

    features, changed, weight = (np.concatenate(values) for values in zip(*of))
    fitted = HistGradientBoostingClassifier(
        max_iter=NUMBER, max_leaf_nodes=LEAVES, learning_rate=RATE, min_samples_leaf=LEAST_PIXELS,
        early_stopping=False, random_state=0,
    ).fit(features, changed, sample_weight=weight)  # fmt: skip
    rows = [(0, LEAF, 0.0, 0, 0, float(fitted._baseline_prediction.item()))]
    for number, (predictor,) in enumerate(fitted._predictors, 1):
        for at, node in enumerate(predictor.nodes):
            if node["is_leaf"]:
                rows.append((number, LEAF, 0.0, 0, 0, node["value"]))
                continue
            asked = int(node["feature_idx"]), node["num_threshold"], node["missing_go_to_left"]
            rows.append((number, *asked, int(node["right"]) - at, 0.0))
    return DecisionTrees(*(np.array(column) for column in zip(*rows)))


class Fitted(NamedTuple):
    """Trees of one light that ask a pixel's own evidence, and those that ask what these say of its
    surroundings, too; lowest and greatest value [2, k] of each figure of the evidence."""

    first: DecisionTrees
    second: DecisionTrees
    range: NDArray[np.float64]

    @classmethod
    def to(cls, draws: list[Draw], folder: Path) -> Fitted:
        """Draws of one light."""
        with ProcessPoolExecutor(JOBS) as pool:
            first = fit(list(pool.map(partial(sample, folder=folder, first=None), draws)))
            second = fit(list(pool.map(partial(sample, folder=folder, first=first), draws)))
        every = np.concatenate([drawn(draw, folder).evidence for draw in draws], axis=1)
        return cls(first, second, np.nanquantile(every, [BEYOND, 1.0 - BEYOND], axis=1))


def write(fitted: list[Fitted]) -> None:
    """Trees and ranges of both lights to the tables beside the code."""
    DecisionTrees.save(TREES, [of.first for of in fitted] + [of.second for of in fitted])
    ranges = ["\t".join(("figure", "diachronic", "low", "high"))]
    for apart, of in enumerate(fitted):
        ranges += [
            f"{name}\t{apart}\t{low:.6g}\t{high:.6g}"
            for name, low, high in zip(Evidence._fields, *of.range)
        ]
    LEARNED.write_text("\n".join(ranges) + "\n", encoding="utf-8")
    trees.cache_clear()
    learned.cache_clear()


def hold_out(site: str, draws: list[Draw], folder: Path) -> None:
    """Print what trees that know nothing of a site find of what is planted there, and by which
    number their log odds (less those of UNKNOWN) are to be divided so that what they say is most
    likely, of pixels within and beyond the range of what was learned."""
    for apart in (False, True):
        of_light = [draw for draw in draws if draw.apart == apart]
        here = [draw for draw in of_light if isinstance(draw, PlantedIn) and draw.is_of(site)]
        if not here:
            continue
        fitted = Fitted.to([draw for draw in of_light if draw not in here], folder)
        told: list[tuple[NDArray[np.float64], Bools, Bools]] = []
        for draw in here:
            of = drawn(draw, folder)
            odds = fitted.second.sum_at(np.stack([*of.evidence, *surroundings(of, fitted.first)]))
            probability = np.full(of.doubtful.shape, UNCHANGED)
            probability[of.doubtful] = 1.0 / (1.0 + np.exp(-odds.astype(np.float64)))
            print(f"{draw.name}, held out: {found_and_lost(of, probability)}", flush=True)
            low, high = fitted.range[..., None]
            beyond = ((of.evidence < low) | (of.evidence > high)).any(axis=0)
            changed, known = (
                pixels[of.doubtful]
                for pixels in (of.marked.changed, of.marked.changed | of.marked.kept)
            )
            told.append((odds[known].astype(np.float64), changed[known], beyond[known]))
        odds, changed, beyond = map(np.concatenate, zip(*told))
        for name, part in (("within", ~beyond), ("beyond", beyond)):
            less, share = likeliest(odds[part], changed[part]), changed[part].mean()
            print(f"{name}: {part.sum()} px, {100 * share:.1f} % changed, divided by {less:.2f}")


def likeliest(odds: NDArray[np.float64], changed: Bools) -> float:
    """What log odds less those of UNKNOWN are divided by, so that the truth is most likely."""
    unknown = np.log(UNKNOWN / (1.0 - UNKNOWN))
    sign = np.where(changed, 1.0, -1.0)

    def loss(less: float) -> float:
        return float(np.logaddexp(0.0, -sign * (unknown + (odds - unknown) / less)).sum())

    return min(np.arange(0.5, 4.0, 0.05), key=loss)


def found_and_lost(of: Drawn, probability: NDArray[np.float64]) -> str:
    """What of each kind of planted change a window's probability finds, and what is lost of others
    on ground and roofs, of its labels."""
    left_out = of.compared.labelled & (probability > least_probability(of.compared))
    labelled, marked = of.compared.labelled, of.marked

    def percent(pixels: Bools) -> str:
        return f"{100.0 * (left_out & pixels).sum() / max(int(pixels.sum()), 1):.1f} %"

    parts = []
    for number, kind in enumerate(KINDS, 1):
        pixels = labelled & marked.changed & (marked.kind == number)
        parts += [f"{kind} {percent(pixels)}"] if pixels.any() else []
    kept = labelled & marked.kept
    parts += [
        f"{name} lost {percent(kept & (of.compared.surface_class == number))}"
        for name, number in (("ground", GROUND), ("roofs", ROOF))
    ]
    return ", ".join([*parts, f"all lost {percent(kept)}"])


class Counts(NamedTuple):
    """Of a city's labels: changed and other ones by BINS of their probability [2, bins]; how many
    have changed and how many of them are found; how many of the others are lost, and of those with
    new texture that do not agree closely; how many agree closely, and have changed of these."""

    by_probability: NDArray[np.int64]
    changed: int
    found: int
    kept: int
    lost: int
    texture: int
    texture_lost: int
    agreed: int
    agreed_changed: int

    @classmethod
    def of(cls, city: City, folder: Path) -> Counts:
        """A city that trees are not fitted to."""
        of = measured(city, folder)
        window = of.compared, of.doubtful, of.evidence
        probability, _ = probability_by_evidence(*window, city.apart)
        labelled, marked = of.compared.labelled, of.marked
        changed, kept = labelled & marked.changed, labelled & marked.kept
        texture, agreed = kept & of.doubtful & marked.texture, (changed | kept) & ~of.doubtful
        left_out = probability > CHANGED
        bins = [np.histogram(probability[part], BINS)[0] for part in (changed, kept)]
        pixels = (changed, changed & left_out, kept, kept & left_out, texture, texture & left_out,
                  agreed, agreed & changed)  # fmt: skip
        return cls(np.array(bins), *(int(part.sum()) for part in pixels))


def report(of: list[City], folder: Path) -> None:
    """Print what is found and lost of each kind, and what has changed of labels by probability."""
    with ProcessPoolExecutor(JOBS) as pool:
        counts = list(pool.map(partial(Counts.of, folder=folder), of))
    print(f"images {of[0].case.condition}:")
    for kind in dict.fromkeys(city.case.kind for city in of):
        c = Counts(*map(sum, zip(*(n for city, n in zip(of, counts) if city.case.kind == kind))))
        print(
            f"{kind}: {100 * c.found / max(c.changed, 1):.1f} % of the changed are found, "
            f"{100 * c.lost / max(c.kept, 1):.2f} % of the others lost, "
            f"{100 * c.texture_lost / max(c.texture, 1):.1f} % of new texture that does not agree "
            "closely"
        )
    every = Counts(*map(sum, zip(*counts)))
    labels = every.by_probability.sum()
    for low, high, n, others in zip(BINS, BINS[1:], *every.by_probability):
        if n + others:
            share, of_labels = 100.0 * n / (n + others), 100.0 * (n + others) / labels
            print(f"P {low} to {high}: {share:.2f} % have changed, {of_labels:.1f} % of all")
    print(f"of {every.agreed} labels whose images agree closely {every.agreed_changed} changed")


def main() -> None:
    """Fit, and print tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("results/changes"))
    parser.add_argument("--seeds", type=int, nargs="*", default=[61, 62], help="of judged cities")
    parser.add_argument("--fit", action="store_true", help="fit the trees anew")
    parser.add_argument("--real", type=Path, default=Path("../shared/real"), help="real sites")
    parser.add_argument("--hold-out", nargs="+", default=[], help="real sites to judge others by")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    draws = draws_to_fit(given.real, given.folder) if given.fit or given.hold_out else []
    for site in given.hold_out:
        hold_out(site, draws, given.folder)
    if given.fit:
        of_lights = ([draw for draw in draws if draw.apart == apart] for apart in (False, True))
        write([Fitted.to(of, given.folder) for of in of_lights])
    judged = [
        City(case) for seed in given.seeds for case in cities(seed, 4.0, tuple(SHARES), SIDE_PX)
    ]
    for apart in (False, True):
        of = [city for city in judged if city.apart == apart]
        if of:
            report(of, given.folder)


if __name__ == "__main__":
    main()
