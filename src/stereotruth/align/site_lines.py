"""Corrections by line of a site's images: one for each image, from the tie points of all its pairs.

Each pair tells by itself whether its lines are off (:mod:`.line_fit`). The images of pairs that do
are fitted together, as Gaussian processes whose standard deviations and length are the medians of
those pairs. An image that jitters shows it in all of its pairs, its partners in one of theirs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..sensor.line_correction import LineCorrection
from .adjustment import FREE, MATCHING, Estimate
from .line_fit import (
    LineFit,
    covariance_at_lines,
    line_design,
    posterior_covariance,
    process,
    sums_of,
)
from .records import Equations, SiteLines

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PairOfLines:
    """A pair's equations, its own estimate and lines; ``images`` by number, left and right."""

    scene: str
    images: tuple[int, int]
    equations: Equations
    estimate: Estimate
    lines: LineFit


def fit_site_lines(
    pairs: Sequence[PairOfLines], rows: Sequence[int], known: Mapping[int, LineCorrection | None]
) -> SiteLines:
    """Of images of ``rows`` lines; ``known`` ones stay as they are."""
    jittering = [pair for pair in pairs if pair.lines.stands_out]
    found = {image: lines for image, lines in known.items() if lines is not None}
    images = sorted({k for pair in jittering for k in pair.images} - set(known))
    if not images:
        return SiteLines(found, {})
    root = process(float(np.median([pair.lines.length for pair in jittering])))
    rank = root.shape[1]
    deviations = np.median([pair.lines.rms_px for pair in jittering], axis=0)
    start = {image: 2 * rank * k for k, image in enumerate(images)}
    count = 2 * rank * len(images)  # then six of each image's affine
    size = count + 6 * len(rows)
    normal, right = np.zeros((size, size)), np.zeros(size)
    of_known = SiteLines(found, {})
    for pair in pairs:
        columns, design, observed = _of_pair(pair, rows, root, start, count, of_known)
        part, side = sums_of(
            design, observed, pair.estimate.weights, pair.equations.site, pair.lines.of_site
        )
        normal[np.ix_(columns, columns)] += part
        right[columns] += side
    variances = np.tile(np.repeat(deviations**2, rank), len(images))
    prior = np.concatenate([1.0 / variances, np.full(size - count, FREE)])
    mean = np.linalg.solve(normal + np.diag(prior), right)[:count]
    covariance = posterior_covariance(normal[:count, :count], variances)
    for image, at in start.items():
        values = mean[at : at + 2 * rank].reshape(2, rank) @ root.T
        found[image] = LineCorrection((0.0, rows[image] - 1.0), np.round(values, 6))
    padded = np.pad(covariance, (0, 1))  # nothing is unknown of an image without a start

    def own_unknowns(pair: PairOfLines) -> NDArray[np.int64]:
        of_images = [start[k] + np.arange(2 * rank) if k in start else np.full(2 * rank, -1)
                     for k in pair.images]  # fmt: skip
        return np.concatenate(of_images)

    return SiteLines(
        found,
        {
            pair.scene: covariance_at_lines(
                padded[np.ix_(*[own_unknowns(pair)] * 2)],
                root,
                pair.equations.lines,
                (rows[pair.images[0]], rows[pair.images[1]]),
            )
            for pair in pairs
            if set(pair.images) & set(start)
        },
    )


def _of_pair(
    pair: PairOfLines,
    rows: Sequence[int],
    root: Floats,
    start: Mapping[int, int],
    count: int,
    known: SiteLines,
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """Which unknowns a pair tells of, its design [n, 2, p] of them and observations [n, 2], in
    standard deviations of its matches."""
    equations = pair.equations
    own = equations.design
    of_pair = rows[pair.images[0]], rows[pair.images[1]]
    parts = np.split(line_design(own, equations.lines, of_pair), 4, axis=-1)
    columns, design = [], []
    for k, image in enumerate(pair.images):
        if image in start:
            columns.append(start[image] + np.arange(2 * root.shape[1]))
            design += [part @ root for part in parts[2 * k : 2 * k + 2]]
        columns.append(count + 6 * image + np.arange(6))
        design.append(own[:, :, 6 * k : 6 * k + 6])
    scale = 1.0 / (pair.lines.noise * np.hypot(equations.own, MATCHING))
    observed = equations.observed - known.effect(own, equations.lines, pair.images)
    return (
        np.concatenate(columns),
        np.concatenate(design, axis=-1) * scale[:, None, None],
        observed * scale[:, None],
    )
