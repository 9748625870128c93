"""The images of a site adjusted together, on made equations whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from stereotruth.align.alignment import ViewFit
from stereotruth.align.records import Equations, PairEquations
from stereotruth.align.site_fit import (
    ImageToFit,
    PairToFit,
    PointsOfImage,
    SiteFit,
    fit_site,
)

SIDE = 1000
NAMES = tuple("ABCDE")
TIES = 150


def view(name: str) -> ViewFit:
    """An image's fit by its RPC alone."""
    middle = (SIDE - 1) / 2
    return ViewFit(
        "left", f"{name}.tif", (SIDE, SIDE), np.eye(2, 3), (), np.nan, 0, (middle, middle),
        SIDE / 2, np.zeros((6, 6)),
    )  # fmt: skip


class Made:
    """A site whose true corrections are ``truth`` by name, with control and tie points.

    Tie points see what two images do not share, and a twentieth of what they share (slopes).
    """

    def __init__(self, seed: int, points: int = 12) -> None:
        rng = self.rng = np.random.default_rng(seed)
        self.truth = {n: rng.normal(0, [0.1, 0.1, 5.0] * 2) for n in NAMES}
        where = rng.uniform(50, SIDE - 50, (points, 2))
        self.images = {n: self.image(n, where) for n in NAMES}
        self.pairs = [self.pair(*names) for names in combinations(NAMES, 2)]

    def image(self, name: str, where: np.ndarray) -> ImageToFit:
        """An image with its control points, 0.25 px of noise."""
        start = view(name)
        measured = where + start.design(*where.T) @ self.truth[name]
        measured = measured + self.rng.normal(0, 0.25, measured.shape)
        zeros = np.zeros(len(where))
        ids = tuple(f"G{k}" for k in range(len(where)))
        seen = PointsOfImage(ids, zeros, zeros, zeros, measured, where)
        return ImageToFit(name, start, seen, 2.0 * np.eye(2))

    def pair(self, left: str, right: str) -> PairToFit:
        """A pair with tie points of 0.03 px."""
        at = self.rng.uniform(0, SIDE, (TIES, 2))
        basis = view(left).design(*at.T)
        slopes = np.eye(2) * (1.0 + self.rng.normal(0, 0.05, (TIES, 1, 1)))
        design = np.concatenate([-slopes @ basis, basis], axis=-1)
        truth = np.concatenate([self.truth[left], self.truth[right]])
        own = self.rng.uniform(0.02, 0.04, TIES)
        observed = design @ truth + self.rng.normal(0, 1, (TIES, 2)) * own[:, None]
        site = (at // 125).astype(int) @ [8, 1]
        about = truth + self.rng.normal(0, 0.05, 12)
        ties = PairEquations(Equations(design, observed, own, site, at, at), about, about, 200, 0.0)
        return PairToFit(f"{left}-{right}", left, right, ties)

    def errors(self, fit: SiteFit, name: str) -> np.ndarray:
        """[81, 2] px over an image."""
        grid = np.meshgrid(np.linspace(0, SIDE, 9), np.linspace(0, SIDE, 9))
        design = view(name).design(*(axis.ravel() for axis in grid))
        return design @ (fit.parameters[name] - self.truth[name])

    def fit(self) -> SiteFit:
        return fit_site(list(self.images.values()), self.pairs)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_images_together_are_better_than_by_their_points_alone():
    made = Made(1)
    joint = made.fit()
    alone = fit_site(list(made.images.values()), [])
    mean = np.mean([rms(made.errors(joint, n)) for n in NAMES])
    assert mean < 0.7 * np.mean([rms(made.errors(alone, n)) for n in NAMES])
    between = made.errors(joint, "A") - made.errors(joint, "B")
    assert rms(between) < 0.02
    assert joint.point_sigma == pytest.approx(0.25, rel=0.15)


@pytest.mark.slow
def test_stated_covariance_is_that_of_the_errors():
    size = []
    for seed in range(25):
        made = Made(100 + seed, points=6)
        fit = made.fit()
        for left, right in (("A", "B"), ("C", "E")):
            # of one image in the middle, and of what two images differ by at a corner
            middle = view(left).design(SIDE / 2, SIDE / 2)
            corner = view(left).design(SIDE - 1, SIDE - 1)
            for design in (
                np.concatenate([middle, 0 * middle], axis=1),
                np.concatenate([corner, -corner], axis=1),
            ):
                error = np.concatenate([fit.parameters[n] - made.truth[n] for n in (left, right)])
                covariance = design @ fit.covariance_of(left, right) @ design.T
                size += list(np.abs(design @ error) / np.sqrt(np.diag(covariance)))
    size = np.array(size)
    assert 0.58 < np.mean(size < 1) < 0.85
    assert np.mean(size < 2) > 0.9


def test_a_pair_that_contradicts_the_others_gets_no_weight():
    made = Made(4)
    clean = made.fit()
    wrong = made.pairs[2]
    equations = wrong.ties.equations
    moved = replace(equations, observed=equations.observed + np.array([0.4, -0.3]))
    made.pairs[2] = replace(wrong, ties=replace(wrong.ties, equations=moved))
    fit = made.fit()
    assert fit.pairs[wrong.scene].weight == 0.0
    assert all(pair.weight > 0.5 for name, pair in fit.pairs.items() if name != wrong.scene)
    for name in NAMES:
        assert rms(made.errors(fit, name)) < rms(made.errors(clean, name)) + 0.02


def test_wrong_control_points_are_left_out():
    made = Made(5, points=6)
    clean = made.fit()
    image = made.images["C"]
    image.points.measured[3] += 8.0, -5.0
    fit = made.fit()
    assert np.flatnonzero(~fit.used["C"]).tolist() == [3]
    assert all(fit.used[name].all() for name in NAMES if name != "C")
    assert rms(made.errors(fit, "C")) < rms(made.errors(clean, "C")) + 0.05
    # what the point is off, by the adjustment without it
    assert fit.leave_one_out["C"][3] == pytest.approx([8.0, -5.0], abs=0.8)


@pytest.mark.slow
def test_an_image_that_jitters_is_corrected_by_line():
    """It swings along its columns; what its pairs tell makes one correction, and no other's."""
    made = Made(11)
    periods = 2.1 * 2 * np.pi / SIDE

    def swing(at: np.ndarray) -> np.ndarray:
        return 0.3 * np.sin(periods * at[:, 1] + 1.0)

    pairs = []
    for pair in made.pairs:
        equations = pair.ties.equations
        own = 2 if pair.left == "A" else 8
        if "A" in (pair.left, pair.right):
            moved = equations.design[:, :, own] * swing(equations.at)[:, None]
            equations = replace(equations, observed=equations.observed + moved)
        pairs.append(replace(pair, ties=replace(pair.ties, equations=equations)))
    fit = fit_site(list(made.images.values()), pairs)
    rows = np.arange(50.0, SIDE - 50, 10)
    at = np.column_stack([rows, rows])
    found = {name: one.at(rows)[0] for name, one in fit.by_line.items()}
    for name in "BCDE":
        left = found["A"] - found[name] - swing(at)
        trend = np.polyval(np.polyfit(rows, left, 1), rows)  # is the affines'
        assert np.sqrt(np.mean((left - trend) ** 2)) < 0.03
    # What all images share no pair sees: their mean is nothing, and A has the most.
    assert max(found, key=lambda name: np.std(found[name])) == "A"
    assert all(pair.lines_covariance is not None for pair in fit.pairs.values())
