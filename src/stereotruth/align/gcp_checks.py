"""Which ground control points are blunders, and what is refused of them before and after the fit.

Blunders are found by least trimmed squares over all minimal samples (Rousseeuw & Van Driessen 2006,
"Computing LTS regression for large data sets"), then by studentised residuals. The result is the
exact least-squares solution (``cv2.solve``) on the other points. ``cv2.estimateAffine2D``, the
paper's way, depends on the order of the points. What is refused names the remedy, and the file if
it is not that of the points.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, in_number
from ..core.numerics.arrays import Bools, Floats
from ..sensor.pair_geometry import GroundOfImages
from ..sensor.rpc import SensorModel
from ..sensor.rpc_files import rpc_file
from .control_points import ControlPoints, TooFewPoints

MINIMAL = {"affine": 3, "similarity": 2, "shift": 1}  # points that determine the model
BLUNDER_FLOOR = 1.25  # px: 5 sigma of a careful measurement (0.25 px)
BLUNDER_SIGMAS = 4.5  # of a Rayleigh distributed length: a good point in 25 000 is beyond
RAYLEIGH_MEDIAN = 1.1774  # median length of a 2-D Gaussian vector of unit sigma
PRIOR_NOISE = 0.5  # px of a measurement, and
PRIOR_TILT = (1.0, 0.0005)  # px plus share of the extent that RPCs may be tilted: for ties only
MAX_SAMPLES = 2000  # minimal samples tried: all of them up to 23 GCPs
# One more than determines the model is asked for: with fewer, no residual tells of an error.
NEEDED = {model: n + 1 for model, n in MINIMAL.items()}
MAX_LEFT_OUT = 1 / 3  # share of blunders beyond which nobody knows which points are right
MAX_SIGMA = 5.0  # px: beyond, GCPs and image do not belong together
UNCHECKED_SIGMA = 3.0  # px, where there are too few GCPs to find the blunder among them
MAX_TILT = 0.05  # beyond, columns and rows are mixed up
MIN_SPREAD = 10.0  # px: standard deviation of the GCPs along their main axis
MIN_WIDTH_RATIO = 0.05  # of the deviations across and along: below, the GCPs count as collinear
FRAME_MARGIN = 1.0  # px that a measurement may lie outside the pixels of the image


@dataclass(frozen=True, eq=False)
class System:
    """Linear system of a view: measured − predicted [n, 2] = design [n, 2, p] @ parameters [p].

    ``embed`` float64[6, p] takes the parameters to those of the affine in normalised coordinates.
    """

    design: Floats
    delta: Floats
    embed: Floats
    origin: Floats
    scale: float
    minimal: int

    @classmethod
    def of(cls, model: str, predicted: Floats, measured: Floats) -> System:
        """The system of a model for projected and measured (col, row) [n, 2] px."""
        # Normalised by the measurements: they lie inside the image, whatever is predicted.
        origin = np.median(measured, axis=0)
        scale = max(float(np.ptp(measured, axis=0).max()) / 2, 1.0)
        if model == "affine":
            embed = np.eye(6)
        elif model == "similarity":
            embed = np.zeros((6, 4))
            embed[[0, 4], 0] = 1.0  # change of scale
            embed[[1, 3], 1] = -1.0, 1.0  # rotation
            embed[2, 2] = embed[5, 3] = 1.0
        else:
            embed = np.zeros((6, 2))
            embed[2, 0] = embed[5, 1] = 1.0
        u = (predicted - origin) / scale
        basis = np.column_stack([u, np.ones(len(u))])
        full = np.zeros((len(u), 2, 6))
        full[:, 0, :3] = full[:, 1, 3:] = basis
        return cls(full @ embed, measured - predicted, embed, origin, scale, MINIMAL[model])

    def solve(self, used: Bools) -> Floats:
        """Exact least squares on the used points."""
        design = np.ascontiguousarray(self.design[used].reshape(-1, self.design.shape[2]))
        good, parameters = cv2.solve(
            design, self.delta[used].reshape(-1, 1).copy(), flags=cv2.DECOMP_SVD
        )
        assert good
        return parameters[:, 0]

    def residuals(self, parameters: Floats) -> Floats:
        """[n, 2] px, measured minus corrected."""
        return self.delta - self.design @ parameters

    def cofactors(self, used: Bools) -> Floats:
        """[p, p]: inverse of the normal matrix of the used points."""
        design = self.design[used].reshape(-1, self.design.shape[2])
        return np.linalg.pinv(design.T @ design)

    def leverages(self, used: Bools) -> Floats:
        """[n, 2, 2]: cofactors of the corrections at all points."""
        q = self.cofactors(used)
        return np.einsum("nap,pq,nbq->nab", self.design, q, self.design)

    def affine(self, parameters: Floats) -> Floats:
        """float64[2, 3] for (col, row, 1) of the RPC."""
        normalised = (self.embed @ parameters).reshape(2, 3)
        linear = normalised[:, :2] / self.scale
        shift = normalised[:, 2] - linear @ self.origin
        return np.column_stack([np.eye(2) + linear, shift])


def trimmed(system: System) -> Bools:
    """The half of the points (and a little more) that agree best: least trimmed squares.

    Each minimal sample starts concentration steps: fit, keep the h points that fit best, repeat.
    Up to n − h blunders do no harm: 6 of 15 points for an affine, 1 of 5, none of 4. Among few
    points a sample with a blunder may fit as well as the good one, by a correction that no RPC
    needs: that is held against it (5 random points, one 20 px off, 0.25 px noise: the blunder alone
    is left out in 99 % of the cases, 96 % without).
    """
    n, k = len(system.delta), system.minimal
    h = (n + k + 1) // 2
    if math.comb(n, k) <= MAX_SAMPLES:
        samples = np.array(list(itertools.combinations(range(n), k)))
    else:
        rng = np.random.default_rng(0)
        samples = np.array([rng.choice(n, k, replace=False) for _ in range(MAX_SAMPLES)])
    kept = np.zeros((len(samples), n))
    np.put_along_axis(kept, samples, 1.0, axis=1)
    normal = np.einsum("nap,naq->npq", system.design, system.design)
    right = np.einsum("nap,na->np", system.design, system.delta)
    p = normal.shape[1]
    for _ in range(20):
        matrix = (kept @ normal.reshape(n, -1)).reshape(-1, p, p)
        ridge = 1e-12 * np.trace(matrix, axis1=1, axis2=2)  # samples on one line or one spot
        matrix = matrix + ridge[:, None, None] * np.eye(p)
        parameters = np.linalg.solve(matrix, (kept @ right)[:, :, None])[:, :, 0]
        misfit = system.delta - np.einsum("nap,kp->kna", system.design, parameters)
        squares = np.sum(misfit**2, axis=2)
        best = np.argsort(squares, axis=1, kind="stable")[:, :h]
        again = np.zeros_like(kept)
        np.put_along_axis(again, best, 1.0, axis=1)
        if (again == kept).all():
            break
        kept = again
    tilt = (parameters @ system.embed.T)[:, [0, 1, 3, 4]]
    allowed = PRIOR_TILT[0] + PRIOR_TILT[1] * system.scale
    cost = np.take_along_axis(squares, best, axis=1).sum(axis=1) / PRIOR_NOISE**2
    cost += np.square(tilt / allowed).sum(axis=1)
    return kept[np.argmin(cost)] > 0


def studentised(system: System, used: Bools) -> Floats:
    """[n] lengths in px of the residuals, brought to the deviation of a measurement.

    A residual of a used point varies by 1 − leverage of the measurement's variance, that of
    another point by 1 + leverage. So a good point far from the others is not taken for a blunder.
    """
    lengths = np.hypot(*system.residuals(system.solve(used)).T)
    leverage = np.trace(system.leverages(used), axis1=1, axis2=2) / 2
    variance = np.where(used, 1 - leverage, 1 + leverage)
    return lengths / np.sqrt(np.maximum(variance, 1e-6))


def find_blunders(system: System) -> tuple[Bools, Floats, float]:
    """Which points are used, the studentised residuals [n] in px, and the threshold in px."""
    n = len(system.delta)
    if n <= system.minimal + 1:  # nothing to tell a blunder from the others
        used = np.ones(n, dtype=bool)
        return used, np.zeros(n), np.inf
    used = trimmed(system)
    for _ in range(30):
        lengths = studentised(system, used)
        sigma = float(np.median(lengths)) / RAYLEIGH_MEDIAN
        # Wider for few points, whose deviation is not well known (as Student's t is).
        threshold = (1 + 1 / (n - system.minimal)) * max(BLUNDER_FLOOR, BLUNDER_SIGMAS * sigma)
        again = lengths <= threshold
        if again.sum() <= system.minimal or (again == used).all():
            break
        used = again
    return used, lengths, threshold


def leave_one_out_residuals(system: System, used: Bools) -> Floats:
    """[n, 2] residuals px of every point by the fit without it, in closed form.

    For a used point (I − H)⁻¹ r, H its 2 × 2 leverage; NaN where the others leave it undetermined.
    """
    residuals = system.residuals(system.solve(used))
    left = np.eye(2) - system.leverages(used)
    out = residuals.copy()
    for i in np.flatnonzero(used):
        determined = np.linalg.eigvalsh(left[i])[0] > 1e-9
        out[i] = np.linalg.solve(left[i], residuals[i]) if determined else np.nan
    return out


@dataclass(frozen=True, eq=False)
class View:
    """One view's input: rows of the GCP table that it sees, and where."""

    name: str
    image: Path
    size: tuple[int, int]
    sensor: SensorModel
    index: NDArray[np.intp]
    predicted: Floats
    measured: Floats


def _some(ids: Sequence[str]) -> str:
    return ", ".join(ids[:6]) + (f" and {len(ids) - 6} more" if len(ids) > 6 else "")


def _spreads(points: Floats) -> tuple[float, float]:
    """Standard deviations in px of points [n, 2] along their main axis and across it."""
    if len(points) < 2:
        return 0.0, 0.0
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / np.sqrt(len(points))
    return float(values[0]), float(values[1])


def _defect(model: str, points: Floats) -> str:
    """Why GCPs at these positions [n, 2] cannot carry the model, or an empty string."""
    n, (along, across) = len(points), _spreads(points)
    if n < NEEDED[model]:
        return (
            f"{in_number(n, 'GCP')}, the model {model!r} needs {NEEDED[model]} "
            f"({MINIMAL[model]} determine it, one more shows an error)"
        )
    if model == "shift":
        return ""
    if along < MIN_SPREAD:
        return f"GCPs within {2 * along:.1f} px of one spot, too close for the model {model!r}"
    if model == "affine" and across < MIN_WIDTH_RATIO * along:
        return (
            f"GCPs along one line ({along:.0f} px deviation along, {across:.1f} px across), which "
            "does not determine an affine"
        )
    return ""


def _remedy(model: str, points: Floats) -> str:
    """What to do about a defect, naming the models that these points can carry."""
    simpler = list(MINIMAL)[list(MINIMAL).index(model) + 1 :]
    carried = [other for other in simpler if not _defect(other, points)]
    more = "measure more GCPs, spread over the image"
    if not carried:
        return more
    names = " or ".join(repr(name) for name in carried)
    return f"{more}, or set alignment.model to {names}, which these GCPs can carry"


def footprint(sensor: SensorModel, size: tuple[int, int]) -> Floats:
    """(lon_min, lat_min, lon_max, lat_max) of an image over its RPC's heights, widened by half."""
    middle, half = sensor.rpc.height_off, abs(sensor.rpc.height_scale)
    box = np.array(GroundOfImages([sensor], [size]).box((middle - half, middle + half)))
    margin = (box[2:] - box[:2]) / 2 + 0.01
    return box + np.concatenate([-margin, margin])


def _in_box(box: Floats, lon: Floats, lat: Floats) -> Bools:
    turns = np.round((lon - (box[0] + box[2]) / 2) / 360.0)
    lon = lon - 360.0 * turns
    return (lon >= box[0]) & (lon <= box[2]) & (lat >= box[1]) & (lat <= box[3])


def check_ground(points: ControlPoints, boxes: Sequence[Floats], images: Sequence[Path]) -> Bools:
    """bool[n]: near either image's footprint (``boxes``, left and right).

    Refuses the file if most points are elsewhere, an RPC if it is alone with its ground.
    """
    inside = [_in_box(box, points.lon, points.lat) for box in boxes]
    near = np.any(inside, axis=0)
    shares = [
        float(np.mean(here[seen])) if seen.any() else 1.0 for here, seen in zip(inside, points.seen)
    ]
    if min(shares) == 0.0 and max(shares) > 0.5:
        wrong = int(np.argmin(shares))
        box = boxes[wrong]
        raise InputError(
            f"this RPC leads to ground about lon {(box[0] + box[2]) / 2:.4f}, lat "
            f"{(box[1] + box[3]) / 2:.4f}; the other image and the GCPs are elsewhere",
            file=rpc_file(images[wrong]),
            remedy="check that RPC and image belong together, and the image to this scene",
        )
    if 2 * near.sum() > len(near):
        return near
    swapped = np.any([_in_box(box, points.lat, points.lon) for box in boxes], axis=0)
    low, high = boxes[0][:2], boxes[0][2:]
    where = (
        f"lon {np.median(points.lon):.4f}, lat {np.median(points.lat):.4f} in the middle, while "
        f"the left image shows about lon {(low[0] + high[0]) / 2:.4f}, "
        f"lat {(low[1] + high[1]) / 2:.4f}"
    )
    if 2 * swapped.sum() > len(near):
        raise InputError(
            f"lon and lat of the GCPs seem to be swapped: {where}",
            remedy="exchange the columns lon and lat",
        )
    raise InputError(
        f"the GCPs lie far from the ground that the images show: {where}",
        remedy="check that the file is that of this scene, and its coordinates WGS 84 degrees",
    )


def check_heights(points: ControlPoints, sensor: SensorModel) -> str:
    """A warning if heights leave the RPC's range by more than half of it, else nothing."""
    low, high = sensor.rpc.ground_box[4:]
    margin = (high - low) / 4
    outside = (points.height < low - margin) | (points.height > high + margin)
    if not outside.any():
        return ""
    ids = [name for name, out in zip(points.ids, outside) if out]
    return (
        f"heights of {_some(ids)} are outside the {low:.0f} to {high:.0f} m of the RPC: are they "
        "ellipsoidal metres?"
    )


def misfits_of_sides(
    points: ControlPoints, sensors: Sequence[SensorModel], near: Bools | None = None
) -> tuple[float, float]:
    """How far GCPs miss a pair as it is given, and with both images exchanged, px.

    Median distance from the median shift, the worse of both images; NaN of fewer than three GCPs
    (``near`` [n], default all) that both images show.
    """
    both = np.logical_and(*points.seen)
    both = both if near is None else both & near
    if both.sum() < 3:
        return np.nan, np.nan
    ground = points.lon[both], points.lat[both], points.height[both]
    projected = [np.stack(sensor.project(*ground), axis=1) for sensor in sensors]

    def misfit(measured: tuple[Floats, Floats]) -> float:
        worst = 0.0
        for there, here in zip(projected, measured):
            delta = here - there
            worst = max(worst, float(np.median(np.hypot(*(delta - np.median(delta, axis=0)).T))))
        return worst

    left, right = points.left[both], points.right[both]
    return misfit((left, right)), misfit((right, left))


def fit_exchanged(given: float, exchanged: float) -> bool:
    """Whether GCPs with these misfits (px) belong to the pair with left and right exchanged."""
    return given > 10.0 and exchanged < given / 5


def check_swapped(points: ControlPoints, sensors: Sequence[SensorModel], near: Bools) -> None:
    """Refuse a pair whose GCPs fit only with left and right exchanged."""
    given, exchanged = misfits_of_sides(points, sensors, near)
    if fit_exchanged(given, exchanged):
        raise InputError(
            "left_image and right_image seem to be swapped in the scenes sheet: the GCPs miss by "
            f"{given:.0f} px as given, by {exchanged:.1f} px with the two exchanged",
            remedy="exchange the columns left_image and right_image of this scene; left is the "
            "backward view (or exchange the left and right columns of the GCP file, if it is that)",
        )


def check_frame(points: ControlPoints, view: View) -> None:
    """Refuse measurements outside the image."""
    limit = np.array(view.size) - 0.5 + FRAME_MARGIN
    outside = ~((view.measured >= -0.5 - FRAME_MARGIN) & (view.measured <= limit)).all(axis=1)
    if outside.any():
        first = int(np.flatnonzero(outside)[0])
        name = points.ids[view.index[first]]
        others = int(outside.sum()) - 1
        col, row = view.measured[first]
        raise InputError(
            f"GCP {name} (line {points.line[view.index[first]]}) is measured at col {col:.1f}, row "
            f"{row:.1f}, outside the {view.name} image {view.image.name} of {view.size[0]} x "
            f"{view.size[1]} px (cols x rows)" + (f", and {others} more" if others else ""),
            remedy="correct the measurement, or leave both cells empty where the image does not "
            "show the point",
        )


def _where(view: View) -> str:
    """The view's name, with the files that may be at fault beside the GCPs."""
    rpc = rpc_file(view.image)
    beside = "" if rpc == view.image else f" (RPC: {rpc.name})"
    return f"{view.name} image {view.image.name}{beside}"


def refuse_fit(model: str, view: View, points: ControlPoints, used: Bools) -> None:
    """Refuse a view whose used GCPs cannot carry the model."""
    defect = _defect(model, view.predicted[used])
    if not defect:
        return
    out = [points.ids[i] for i in view.index[~used]]
    rest = f" after {_some(out)} were left out" if out else ""
    raise TooFewPoints(
        f"{_where(view)}: {defect}{rest}",
        remedy=_remedy(model, view.predicted[used]),
    )


def refuse_misfit(
    model: str, view: View, system: System, points: ControlPoints, used: Bools
) -> float:
    """Refuse GCPs that contradict each other; sigma0 in px of those used."""
    n, kept = len(used), int(used.sum())
    redundancy = 2 * kept - system.design.shape[2]
    residuals = system.residuals(system.solve(used))[used]
    sigma = float(np.sqrt(np.sum(residuals**2) / redundancy))
    where = _where(view)
    if n - kept > MAX_LEFT_OUT * n:
        out = [points.ids[i] for i in view.index[~used]]
        raise InputError(
            f"{where}: {len(out)} of {n} GCPs contradict the others ({_some(out)})",
            remedy="check these GCPs, and that the file belongs to these images and their RPCs",
        )
    if n <= system.minimal + 2 and sigma > UNCHECKED_SIGMA:
        delta = system.delta
        far = np.hypot(*(delta - np.median(delta, axis=0)).T)
        suspect = points.ids[view.index[int(np.argmax(far))]]
        raise InputError(
            f"{where}: the {n} GCPs contradict each other by {sigma:.1f} px, and so few do not "
            f"tell which is wrong ({suspect} differs most from the others' shift)",
            remedy=f"check {suspect} first; measure more GCPs: among "
            f"{system.minimal + 3} or more a blunder is found and left out",
        )
    if sigma > MAX_SIGMA:
        raise InputError(
            f"{where}: the GCPs do not fit the image (sigma {sigma:.1f} px after the {model} "
            f"correction)",
            remedy="check that GCP file, image and RPC belong together, and that heights are "
            "metres above the ellipsoid",
        )
    if (change := tilt(system.affine(system.solve(used)))) > MAX_TILT:
        raise InputError(
            f"{where}: the GCPs ask for a change of scale or angle by {100 * change:.0f} %",
            remedy="check that columns count from the left and rows from the top, and that GCP "
            "file, image and RPC belong together",
        )
    return sigma


def tilt(affine: Floats) -> float:
    """Largest relative change of a distance by the linear part of an affine."""
    return float(np.linalg.norm(affine[:, :2] - np.eye(2), ord=2))
