"""Closure of triplets: what the labels of three pairs of images say of each other, without truth.

For images A, B, C with labels of A-B, B-C and A-C, a pixel of A is carried to B and on to C, and to
C at once. Both places in C should be one. Their difference is given in px of the grid of A-C, along
its rows: the disparity of A-C by way of B less its label.

All three labels rest on one point cloud and, where the images are adjusted together, on one
correction per image. Whatever the three corrections and the heights of the ground are, the rays
that they define close: for one height h of a point, d_AB, d_BC and d_AC are its projections by the
same three sensors. So the alignment's covariance has no part in a closure. The points' noise has
none either where all three draw the same facet of one surface: what is left is that labels are read
between the centres of pixels. The stated uncertainty of a closure has the points' part of each
label's variance alone, as if the three were independent. That is an upper bound: no layer tells how
much of their noise three labels share.
How good the corrections are shows the closure of the pairs' own refinements, each of which rests on
tie points of its own: see :func:`closure_of_refinements`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from ..alignment.adjustment import PairEquations, estimate, over_the_image, parameters_of
from ..alignment.aligned_pair import Alignment
from ..alignment.label_uncertainty import LabelUncertainty
from ..alignment.site_fit import rpc_prior
from ..alignment.tie_equations import read_equations
from ..epipolar.model import EpipolarModel
from ..errors import InputError
from ..numerics.bilinear import bilinear
from ..products.files import atomic_file, sealed
from ..products.grids import blocks, require_complete

Floats = NDArray[np.float64]


BLOCK = 1024  # px, side of what is read at once
MOST = 250_000  # pixels of a triplet, about, that are compared
STEP_PX = 1.0  # difference of neighbouring labels: more is a height step between them
NODES = 9  # places along each side of an image, of the closure of refinements
UNITS = (
    "px along the rows of the grid of A-C; sigma: stated standard uncertainty, of labels by the "
    "noise of their points alone, as if the three were independent: an upper bound; of "
    "refinements, px of image C, of both coordinates"
)


@dataclass(frozen=True)
class PairFiles:
    """A scene, the names of its images, its labels (Zarr), alignment and tie points' equations."""

    scene: str
    left: str
    right: str
    disparity: Path
    alignment: Path
    equations: Path


@dataclass(frozen=True)
class Triplet:
    """Pairs A-B, B-C and A-C."""

    ab: PairFiles
    bc: PairFiles
    ac: PairFiles

    @property
    def images(self) -> tuple[str, str, str]:
        """A, B, C."""
        return self.ab.left, self.ab.right, self.ac.right


def triplets_of(pairs: Sequence[PairFiles]) -> list[Triplet]:
    """All triplets of pairs, whatever their order; of two pairs of the same images the first."""
    by_images: dict[tuple[str, str], PairFiles] = {}
    for pair in sorted(pairs, key=lambda pair: pair.scene):
        by_images.setdefault((pair.left, pair.right), pair)
    return [
        Triplet(ab, by_images[b, c], ac)
        for (a, b), ab in sorted(by_images.items())
        for (other, c), ac in sorted(by_images.items())
        if other == a and (b, c) in by_images
    ]


class _Labels:
    """Labels of a pair, read window by window."""

    def __init__(self, pair: PairFiles) -> None:
        group = require_complete(pair.disparity)
        self.model = EpipolarModel.from_dict(group.attrs["epipolar"])
        self.disparity: zarr.Array = group["disparity"]
        self.uncertainty: zarr.Array = group["uncertainty"]
        self.alignment = LabelUncertainty.of(Alignment.load(pair.alignment), self.model)

    def window(self, window: tuple[slice, slice]) -> tuple[Floats, Floats]:
        """Disparity and, of its variance, the part of the points [h, w] px, px²."""
        disparity = self.disparity[window].astype(float)
        rows, cols = (
            np.arange(part.start, part.start + size, dtype=float)
            for part, size in zip(window, disparity.shape)
        )
        slope = np.zeros((2, *disparity.shape))
        for axis, size in ((1, cols.size), (0, rows.size)):
            if size > 1:
                slope[1 - axis] = np.nan_to_num(np.gradient(disparity, axis=axis))
        of_alignment = self.alignment.variance(cols, rows, slope)
        return disparity, np.maximum(self.uncertainty[window].astype(float) ** 2 - of_alignment, 0)

    def at(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """As :meth:`window`, [n] at places of the left grid; NaN between surfaces."""
        rows, cols = self.disparity.shape
        known = (x >= 0) & (y >= 0) & (x <= cols - 1) & (y <= rows - 1)
        disparity, variance = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
        if not known.any():
            return disparity, variance
        left, top = int(x[known].min()), int(y[known].min())
        window = np.s_[top : int(y[known].max()) + 2, left : int(x[known].max()) + 2]
        labels, of_points = self.window(window)
        u, v = x[known] - left, y[known] - top
        i, j = u.astype(int), v.astype(int)
        below = np.minimum(j + 1, labels.shape[0] - 1)
        beside = np.minimum(i + 1, labels.shape[1] - 1)
        corners = np.stack(
            [labels[j, i], labels[j, beside], labels[below, i], labels[below, beside]]
        )
        even = np.ptp(corners, axis=0) < STEP_PX  # not where one is NaN
        disparity[known] = np.where(even, bilinear(labels, u, v), np.nan)
        variance[known] = bilinear(of_points, u, v)
        return disparity, variance


def _closures(triplet: Triplet) -> Iterator[tuple[Floats, Floats]]:
    """Closure and its uncertainty [n] px of each block of the grid of A-B."""
    ab, bc, ac = (_Labels(pair) for pair in (triplet.ab, triplet.bc, triplet.ac))
    rows, cols = ab.disparity.shape
    step = max(1, round((rows * cols / MOST) ** 0.5))
    for window in blocks((rows, cols), BLOCK):
        d_ab, v_ab = (values[::step, ::step] for values in ab.window(window))
        j, i = np.nonzero(np.isfinite(d_ab))
        if not len(i):
            continue
        x, y = window[1].start + step * i.astype(float), window[0].start + step * j.astype(float)
        d_ab, v_ab = d_ab[j, i], v_ab[j, i]

        def in_ac(in_bc: tuple[Floats, Floats], disparity: Floats) -> tuple[Floats, Floats]:
            in_c = bc.model.epipolar_to_right(in_bc[0] - disparity, in_bc[1])
            return ac.model.right_to_epipolar(*in_c)

        in_bc = bc.model.left_to_epipolar(*ab.model.epipolar_to_right(x - d_ab, y))
        d_bc, v_bc = bc.at(*in_bc)
        by_b = in_ac(in_bc, d_bc)[0]
        in_a = ac.model.left_to_epipolar(*ab.model.epipolar_to_left(x, y))
        d_ac, v_ac = ac.at(*in_a)
        beside = bc.model.left_to_epipolar(*ab.model.epipolar_to_right(x - d_ab - 1.0, y))
        by_ab = in_ac(beside, d_bc)[0] - by_b
        by_bc = in_ac(in_bc, d_bc + 1.0)[0] - by_b
        closure = in_a[0] - by_b - d_ac
        variance = by_ab**2 * v_ab + by_bc**2 * v_bc + v_ac
        good = np.isfinite(closure) & np.isfinite(variance)
        yield closure[good], np.sqrt(variance[good])


def figures(closure: Floats, sigma: Floats) -> dict[str, Any]:
    """Figures of closures [n] with their stated uncertainty."""
    if not len(closure):
        return {"count": 0}
    size = np.abs(closure)
    return {
        "count": len(closure),
        "rms": round(float(np.sqrt(np.mean(size**2))), 5),
        "median": round(float(np.median(closure)), 5),
        "largest": round(float(size.max()), 4),
        "sigma_rms": round(float(np.sqrt(np.mean(sigma**2))), 5),
        "within_1_sigma": round(float(np.mean(size <= sigma)), 4),
        "within_2_sigma": round(float(np.mean(size <= 2.0 * sigma)), 4),
    }


def closure_of_labels(triplet: Triplet) -> tuple[Floats, Floats]:
    """Closure and stated uncertainty [n] px at pixels of A all over the triplet's ground."""
    parts = [(np.zeros(0), np.zeros(0)), *_closures(triplet)]
    return np.concatenate([c for c, _ in parts]), np.concatenate([s for _, s in parts])


def closure_of_refinements(triplet: Triplet) -> tuple[Floats, Floats] | None:
    """Closure and stated uncertainty [2 n] px in image C, of the pairs' refinements by themselves.

    Each pair's own tie points say how its images are off against each other. Round a triplet these
    errors add up to nothing, but for the errors of the three refinements, which are independent. At
    n places of image A that all three images show; None if a pair has no tie points.
    """
    pairs = triplet.ab, triplet.bc, triplet.ac
    ties = [read_equations(pair.equations)[0] for pair in pairs]
    if any(one is None for one in ties):
        return None
    ab, bc, ac = (Alignment.load(pair.alignment) for pair in pairs)
    a, b, c = ab.left, ab.right, ac.right
    cols, rows = ab.left_fit.size
    grid = np.meshgrid(np.linspace(0, cols - 1, NODES), np.linspace(0, rows - 1, NODES))
    at = np.stack([axis.ravel() for axis in grid], axis=1)
    height = ab.reference_height

    def to(first: Any, second: Any, where: Floats) -> Floats:
        return np.stack(second.project(*first.localize(*where.T, height), height), axis=1)

    in_b, in_c = to(a, b, at), to(a, c, at)
    seen = _inside(in_b, ab.right_fit.size) & _inside(in_c, ac.right_fit.size)
    if not seen.any():
        return np.zeros(0), np.zeros(0)
    at, in_b, in_c = at[seen], in_b[seen], in_c[seen]

    def slopes(first: Any, second: Any, where: Floats) -> Floats:
        ends = [to(first, second, where + s) for s in ([0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5])]
        return np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=-1)

    of_a, of_b, of_c = (
        over_the_image(fit).design(*where.T)
        for fit, where in ((ab.left_fit, at), (ab.right_fit, in_b), (ac.right_fit, in_c))
    )
    a_to_c, b_to_c = slopes(a, c, at), slopes(b, c, in_b)
    effects = (
        b_to_c @ np.concatenate([-slopes(a, b, at) @ of_a, of_b], axis=-1),
        np.concatenate([-b_to_c @ of_b, of_c], axis=-1),
        -np.concatenate([-a_to_c @ of_a, of_c], axis=-1),
    )
    closure, variance = np.zeros((len(at), 2)), np.zeros((len(at), 2))
    for effect, alignment, one in zip(effects, (ab, bc, ac), ties):
        # Against the site's corrections, which are one per image: they close.
        about = np.concatenate([parameters_of(over_the_image(fit)) for fit in alignment.fits])
        parameters, covariance = _by_itself(one, alignment, about)
        closure += effect @ parameters
        variance += np.einsum("nap,pq,naq->na", effect, covariance, effect)
    return closure.ravel(), np.sqrt(variance).ravel()


def _by_itself(ties: PairEquations, alignment: Alignment, about: Floats) -> tuple[Floats, Floats]:
    """What the tie points of a pair say by themselves: parameters [12] and their covariance.

    Without what all of them share behind their guard: it acts as a height, and heights close.
    """
    prior = np.zeros((12, 12))
    for k, fit in enumerate(alignment.fits):
        prior[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = rpc_prior(over_the_image(fit))
    found = estimate(ties.equations.about(about), prior)
    return found.parameters, found.covariance


def _inside(at: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    return ((at >= 0.0) & (at <= np.array(size) - 1.0)).all(axis=1)


def closure(
    city: str, pairs: Sequence[PairFiles], provenance: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Closure of all triplets of a site, by triplet, image and site; JSON-ready.

    Raises InputError if no three pairs form a triplet.
    """
    triplets = triplets_of(pairs)
    if not triplets:
        raise InputError(
            f"no triplet among the {len(pairs)} pairs of {city} that share images",
            remedy="a triplet needs the pairs A-B, B-C and A-C: add one, or all by "
            "stereotruth pairs --all",
        )
    rows: list[dict[str, Any]] = []
    kinds: dict[str, list[tuple[tuple[str, ...], Floats, Floats]]] = {
        "labels": [],
        "refinements": [],
    }
    for triplet in triplets:
        row: dict[str, Any] = {
            "images": list(triplet.images),
            "scenes": [pair.scene for pair in (triplet.ab, triplet.bc, triplet.ac)],
        }
        of_pairs = closure_of_refinements(triplet)
        for kind, found in (("labels", closure_of_labels(triplet)), ("refinements", of_pairs)):
            if found is not None:
                row[kind] = figures(*found)
                kinds[kind].append((triplet.images, *found))
        rows.append(row)
    names = sorted({name for triplet in triplets for name in triplet.images})
    return {
        "what": "closure of triplets of images",
        "units": UNITS,
        "city": city,
        "site": {kind: _together(found) for kind, found in kinds.items()},
        "images": {
            name: {
                kind: _together([one for one in found if name in one[0]])
                for kind, found in kinds.items()
            }
            for name in names
        },
        "triplets": rows,
        "provenance": dict(provenance or {}),
    }


def _together(found: Sequence[tuple[tuple[str, ...], Floats, Floats]]) -> dict[str, Any]:
    none = np.zeros(0)
    return figures(
        np.concatenate([none, *(one[1] for one in found)]),
        np.concatenate([none, *(one[2] for one in found)]),
    )


def write_closure(values: Mapping[str, Any], path: str | Path) -> None:
    """Write what :func:`closure` found, as JSON."""
    with atomic_file(path) as scratch:
        scratch.write_text(sealed(values), encoding="utf-8")
