"""Closure of triplets: what the labels of three pairs of images say of each other, without truth.

For images A, B, C with labels of A-B, B-C and A-C, a pixel of A is carried to B and on to C, and to
C at once. Both places in C should be one. Their difference is given in px of the grid of A-C, along
its rows: the disparity of A-C by way of B less its label.

All three labels rest on one point cloud and, where the images are adjusted together, on one
correction per image: neither the alignment's covariance nor the noise of the points has a part in
a closure. What makes up its uncertainty is the *reading* of labels between the centres of pixels
(:func:`_reading`), the y-parallax of the *epipolar models*, and the *alignment* where an image has
not one correction in all three pairs. An error that neighbours share is no part of the first: an
offset of one pair, a correction that differs, an RPC that is not smooth show as a closure beyond
its uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray

from ..align.adjustment import estimate
from ..align.alignment import Alignment, over_the_image, parameters_of, rpc_prior
from ..align.records import PairEquations, SiteLines, read_equations
from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..core.numerics.interpolation import between_four
from ..core.products.grids import blocks, require_complete
from ..epipolar.model import EpipolarModel

BLOCK = 1024  # px, side of what is read at once
MOST = 250_000  # pixels of a triplet, about, that are compared
STEP_PX = 1.0  # difference of neighbouring labels: more is a height step between them
LAG = 3.0  # px between pixels whose errors of reading are as good as independent
CLASSES, LEAST_OF_CLASS = 10, 200  # of like roughness, and pixels of each
HEAVY = 4.0  # usual sizes, the most that a difference counts
FLOAT_PX = 100.0  # disparity whose rounding is the least roughness
NODES = 9  # places along each side of an image, of the closure of refinements
UNITS = (
    "px along the rows of the grid of A-C; sigma: standard uncertainty, of labels by their reading "
    "between the centres of pixels, by the y-parallax of the epipolar models and, of images with "
    "several corrections, by these; of refinements, px of image C, of both coordinates"
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
        self.y_parallax = self.model.report["y_parallax_over_image_footprints"]["rms_px"]

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the grid."""
        return self.disparity.shape

    def at(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Disparity and roughness [n] px at places of the left grid; NaN between surfaces."""
        rows, cols = self.shape
        known = (x >= 0) & (y >= 0) & (x <= cols - 1) & (y <= rows - 1)
        disparity, roughness = np.full(x.shape, np.nan), np.full(x.shape, np.nan)
        if not known.any():
            return disparity, roughness
        left, top = max(int(x[known].min()) - 1, 0), max(int(y[known].min()) - 1, 0)
        window = np.s_[top : int(y[known].max()) + 3, left : int(x[known].max()) + 3]
        labels = self.disparity[window].astype(float)
        rough = _roughness(labels)
        u, v = x[known] - left, y[known] - top
        i, j = u.astype(int), v.astype(int)
        beside, below = np.ceil(u).astype(int), np.ceil(v).astype(int)

        def corners(grid: Floats) -> Floats:
            return np.stack([grid[j, i], grid[j, beside], grid[below, i], grid[below, beside]])

        four, of_four = corners(labels), corners(rough)
        even = np.ptp(four, axis=0) < STEP_PX  # not where one is NaN
        disparity[known] = np.where(even, between_four(*four, u - i, v - j), np.nan)
        share = between_four(*np.isfinite(of_four).astype(float), u - i, v - j)
        with np.errstate(divide="ignore", invalid="ignore"):
            roughness[known] = between_four(*np.nan_to_num(of_four), u - i, v - j) / share
        return disparity, roughness


def _roughness(labels: Floats) -> Floats:
    """Mean size [h, w] px of the second differences of labels along x and y on one surface."""
    sizes = []
    for axis in (0, 1):
        first = np.diff(labels, axis=axis)
        first[~(np.abs(first) < STEP_PX)] = np.nan
        second = np.full(labels.shape, np.nan)
        second[(np.s_[1:-1], np.s_[:])[:: 1 if axis == 0 else -1]] = np.diff(first, axis=axis)
        sizes.append(np.abs(second))
    count = np.isfinite(sizes).sum(axis=0)
    with np.errstate(invalid="ignore"):
        return np.where(count > 0, np.nansum(sizes, axis=0) / count, np.nan)


class _Closures(NamedTuple):
    """Of n pixels of A: ``closure`` px; ``roughness`` px, of all three labels, as it counts in a
    closure; ``of_models`` px²: variance by the y-parallax of the epipolar models."""

    closure: Floats
    roughness: Floats
    of_models: Floats


class _Triplet:
    """The labels of a triplet."""

    def __init__(self, triplet: Triplet) -> None:
        self.ab, self.bc, self.ac = (_Labels(p) for p in (triplet.ab, triplet.bc, triplet.ac))

    def closures(self, x: Floats, y: Floats) -> _Closures:
        """At pixels of the grid of A-B; NaN where a label is missing."""
        ab, bc, ac = self.ab, self.bc, self.ac
        d_ab, of_ab = ab.at(x, y)
        in_a = ac.model.left_to_epipolar(*ab.model.epipolar_to_left(x, y))
        d_ac, of_ac = ac.at(*in_a)
        in_bc = bc.model.left_to_epipolar(*ab.model.epipolar_to_right(x - d_ab, y))
        d_bc, of_bc = bc.at(*in_bc)

        def by_b(along_ab: float, across_ab: float, along_bc: float, across_bc: float) -> Floats:
            """x in A-C by way of B, with labels and rows of A-B and B-C off by so many px."""
            in_b = ab.model.epipolar_to_right(x - d_ab - along_ab, y + across_ab)
            x_bc, y_bc = bc.model.left_to_epipolar(*in_b)
            in_c = bc.model.epipolar_to_right(x_bc - d_bc - along_bc, y_bc + across_bc)
            return ac.model.right_to_epipolar(*in_c)[0]

        found = by_b(0.0, 0.0, 0.0, 0.0)
        of_d_ab, of_y_ab, of_d_bc, of_y_bc = (by_b(*move) - found for move in np.eye(4))
        roughness = np.sqrt((of_d_ab * of_ab) ** 2 + (of_d_bc * of_bc) ** 2 + of_ac**2)
        of_models = (of_y_ab * ab.y_parallax) ** 2 + (of_y_bc * bc.y_parallax) ** 2
        return _Closures(in_a[0] - found - d_ac, roughness, of_models)

    def blocks(self) -> Iterator[tuple[_Closures, _Closures]]:
        """Closures of pixels all over the grid of A-B, and LAG px beside each, where there are."""
        rows, cols = self.ab.shape
        step = max(1, round((rows * cols / MOST) ** 0.5))
        for window in blocks((rows, cols), BLOCK):
            y, x = (
                grid.ravel().astype(float)
                for grid in np.mgrid[
                    window[0].start : window[0].stop : step, window[1].start : window[1].stop : step
                ]
            )
            here = self.closures(x, y)
            good = np.isfinite(here).all(axis=0)
            yield (
                _Closures(*(values[good] for values in here)),
                self.closures(x[good] + LAG, y[good]),
            )


def _reading(here: _Closures, beside: _Closures) -> Floats:
    """Standard uncertainty [n] px of closures by the reading of the labels.

    Each grid samples the small facets of rough ground in its own way: errors of reading grow with
    the second differences of the labels around, and are as good as independent a few pixels on. So
    in each class of like roughness it is the standard deviation of closure over roughness, from the
    differences of pixels LAG apart; none counts more than HEAVY of its usual size.
    """
    floor = np.finfo(np.float32).eps * FLOAT_PX
    rough, other = (np.maximum(one.roughness, floor) for one in (here, beside))
    difference = np.abs(here.closure / rough - beside.closure / other) / 2**0.5
    known = np.isfinite(difference)
    order = np.argsort(rough, kind="stable")
    sigma = np.full(rough.shape, np.nan)
    for part in np.array_split(order, max(1, min(CLASSES, int(known.sum()) // LEAST_OF_CLASS))):
        size = difference[part][known[part]]
        if len(size):
            size = np.minimum(size, HEAVY * np.quantile(size, 0.683))
            sigma[part] = rough[part] * np.sqrt(np.mean(size**2))
    return sigma


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
    """Closure and its uncertainty [n] px at pixels of A all over the triplet's ground."""
    labels = _Triplet(triplet)
    here, beside = (
        _Closures(*map(np.concatenate, zip(*of_blocks))) for of_blocks in zip(*labels.blocks())
    )
    of_alignment = _of_alignment(triplet, labels.ac.model)
    variance = _reading(here, beside) ** 2 + here.of_models + of_alignment
    known = np.isfinite(variance)
    return here.closure[known], np.sqrt(variance[known])


def _of_alignment(triplet: Triplet, model: EpipolarModel) -> float:
    """Variance px² of closures by the alignment, on level ground, mean of the triplet's ground;
    ``model``: of A-C.

    0 if each image has one correction in both of its pairs. Else the pairs' alignments count as
    independent. They share images and planes of the LiDAR, so that this is mostly too large.
    """
    pairs = _pairs(triplet)
    ab, bc, ac = (pair.alignment for pair in pairs)
    of_image = (ab.fits[0], ac.fits[0]), (ab.fits[1], bc.fits[0]), (bc.fits[1], ac.fits[1])
    if all(np.array_equal(one.affine, other.affine) for one, other in of_image):
        return 0.0
    ground = _Ground.of(pairs)
    if not len(ground.in_c):
        return 0.0
    along = model.right_image.slopes(*ground.in_c.T)[:, 0]  # x of the grid by px of image C
    variance = 0.0
    for effect, pair in zip(ground.effects, pairs):
        covariance = pair.alignment.covariance if pair.ties is None else pair.by_itself()[1]
        moved = np.einsum("na,nap->np", along, effect)
        variance += float(np.einsum("np,pq,nq->n", moved, covariance, moved).mean())
    return variance


@dataclass(frozen=True, eq=False)
class _AlignedPair:
    """An alignment and its tie points, in whose parameters its fits are."""

    alignment: Alignment
    ties: PairEquations | None

    def by_itself(self) -> tuple[Floats, Floats]:
        """What the tie points say by themselves: parameters [12] and their covariance.

        Against the site's corrections, which are one per image: they close. Without what all tie
        points share behind their guard: it acts as a height, and heights close.
        """
        prior = np.zeros((12, 12))
        for k, fit in enumerate(self.alignment.fits):
            prior[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = rpc_prior(fit)
        about = np.concatenate([parameters_of(fit) for fit in self.alignment.fits])
        sensors = self.alignment.left, self.alignment.right
        lines = {k: s.by_line for k, s in enumerate(sensors) if s.by_line is not None}
        equations = self.ties.equations
        effect = SiteLines(lines, {}).effect(equations.design, equations.lines, (0, 1))
        equations = replace(equations, observed=equations.observed - effect)
        found = estimate(equations.about(about), prior)
        return found.parameters, found.covariance


def _pairs(triplet: Triplet) -> tuple[_AlignedPair, ...]:
    """The alignments of a triplet, A-B, B-C, A-C."""
    found = []
    for pair in (triplet.ab, triplet.bc, triplet.ac):
        alignment, ties = Alignment.read(pair.alignment), read_equations(pair.equations)[0]
        if ties is not None:  # whose parameters are those of the images alone
            left, right = (over_the_image(fit) for fit in alignment.fits)
            alignment = replace(alignment, left_fit=left, right_fit=right)
        found.append(_AlignedPair(alignment, ties))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Ground:
    """n places on level ground that all three images show.

    ``in_c`` [n, 2] px of image C; ``effects``: three of [n, 2, 12], what the parameters of the
    alignments of A-B, B-C and A-C do to the closure in image C.
    """

    in_c: Floats
    effects: tuple[Floats, Floats, Floats]

    @classmethod
    def of(cls, pairs: tuple[_AlignedPair, ...]) -> _Ground:
        ab, _, ac = (pair.alignment for pair in pairs)
        a, b, c = ab.left, ab.right, ac.right
        cols, rows = ab.left_fit.size
        grid = np.meshgrid(np.linspace(0, cols - 1, NODES), np.linspace(0, rows - 1, NODES))
        at = np.stack([axis.ravel() for axis in grid], axis=1)
        height = ab.reference_height

        def to(first: Any, second: Any, where: Floats) -> Floats:
            return np.stack(second.project(*first.localize(*where.T, height), height), axis=1)

        def slopes(first: Any, second: Any, where: Floats) -> Floats:
            moves = [0.5, 0], [-0.5, 0], [0, 0.5], [0, -0.5]
            ends = [to(first, second, where + move) for move in moves]
            return np.stack([ends[0] - ends[1], ends[2] - ends[3]], axis=-1)

        in_b, in_c = to(a, b, at), to(a, c, at)
        seen = _inside(in_b, ab.right_fit.size) & _inside(in_c, ac.right_fit.size)
        at, in_b, in_c = at[seen], in_b[seen], in_c[seen]
        designs = [
            [fit.design(*where.T) for fit, where in zip(pair.alignment.fits, ends)]
            for pair, ends in zip(pairs, ((at, in_b), (in_b, in_c), (at, in_c)))
        ]
        a_to_b, a_to_c, b_to_c = slopes(a, b, at), slopes(a, c, at), slopes(b, c, in_b)
        (a_of_ab, b_of_ab), (b_of_bc, c_of_bc), (a_of_ac, c_of_ac) = designs
        effects = (
            b_to_c @ np.concatenate([-a_to_b @ a_of_ab, b_of_ab], axis=-1),
            np.concatenate([-b_to_c @ b_of_bc, c_of_bc], axis=-1),
            -np.concatenate([-a_to_c @ a_of_ac, c_of_ac], axis=-1),
        )
        return cls(in_c, effects)


def closure_of_refinements(triplet: Triplet) -> tuple[Floats, Floats] | None:
    """Closure and stated uncertainty [2 n] px in image C, of the pairs' refinements by themselves.

    Each pair's own tie points say how its images are off against each other. Round a triplet these
    errors add up to nothing, but for the errors of the three refinements, which are independent. At
    n places of image A that all three images show; None if a pair has no tie points.
    """
    pairs = _pairs(triplet)
    if any(pair.ties is None for pair in pairs):
        return None
    ground = _Ground.of(pairs)
    closure, variance = np.zeros(ground.in_c.shape), np.zeros(ground.in_c.shape)
    for effect, pair in zip(ground.effects, pairs):
        parameters, covariance = pair.by_itself()
        closure += effect @ parameters
        variance += np.einsum("nap,pq,naq->na", effect, covariance, effect)
    return closure.ravel(), np.sqrt(variance).ravel()


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
