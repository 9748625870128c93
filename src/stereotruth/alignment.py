"""Alignment of a pair's RPCs with ground control points (section III-A of the paper).

GCPs are projected by the RPC of each image, and an affine transformation (or a similarity, or a
shift) is fitted that takes the projected to the measured image coordinates. Blunders are left out
and named (see ``robust_fit``); ``estimator="opencv"`` is the paper's way.

Image coordinates are (col, row) in px, (0, 0) at the centre of the upper-left pixel; ground is
WGS 84 longitude, latitude in degrees and ellipsoidal height in m.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .control_points import ControlPoints, read_gcps
from .epipolar import EpipolarModel
from .errors import InputError
from .gcp_checks import (
    View,
    check_frame,
    check_ground,
    check_heights,
    check_swapped,
    footprint,
    open_view,
    refuse_fit,
    refuse_misfit,
    tilt,
)
from .grid_store import replacing
from .provenance import describe, source_digest
from .robust_fit import (
    BLUNDER_FLOOR,
    MINIMAL,
    System,
    find_blunders,
    leave_one_out_residuals,
    opencv_inliers,
    studentised,
)
from .rpc import SensorModel

log = logging.getLogger("stereotruth")

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

POOR_SIGMA = 2.0  # px
# A careful measurement in px, and for how many degrees of freedom it stands beside the residuals
# when these are few: 4 GCPs leave two, and may agree by chance.
CAREFUL_SIGMA = (0.25, 2)
RPC_SHIFT = 10.0  # px, standard deviation of what an RPC without GCPs is off, and
RPC_TILT = 3e-4  # of its scale, rotation and shear
LARGE_SHIFT = 200.0  # px: RPCs err by some 1 to 50 px
LARGE_TILT = 0.005  # change of scale, rotation or shear; RPCs err by less than 0.001
UNITS = {
    "col, row, before, after, leave_one_out, sigma0, rms": "px of the original image",
    "lon, lat": "degrees, WGS 84",
    "height": "m above the WGS 84 ellipsoid",
    "affine": "(col, row)_image = affine @ (col_rpc, row_rpc, 1); px",
    "covariance": "px^2, of (a_u, a_v, a_1, b_u, b_v, b_1) in col = … + a_u u + a_v v + a_1, "
    "row = … + b_u u + b_v v + b_1 with (u, v) = ((col, row)_rpc - origin) / scale",
    "cross_covariance": "px^2, of the left image's parameters (rows) with the right's",
}


@dataclass(frozen=True)
class GcpResidual:
    """One GCP in one view. Pairs are (col, row) in px, measured minus predicted.

    ``predicted`` by the RPC alone; ``before`` and ``after`` the correction; ``leave_one_out`` by
    the correction fitted without this point (NaN if that is undetermined). ``reason`` says why a
    point is not ``used``.
    """

    id: str
    lon: float
    lat: float
    height: float
    measured: tuple[float, float]
    predicted: tuple[float, float]
    before: tuple[float, float]
    after: tuple[float, float]
    leave_one_out: tuple[float, float]
    used: bool
    reason: str = ""


@dataclass(frozen=True, eq=False)
class ViewFit:
    """The fit of one view.

    ``size`` (cols, rows) of the image; ``sigma0`` px per coordinate, from the redundancy of the
    fit (NaN without any); ``covariance`` float64[6, 6] in px² of the affine's parameters in
    normalised coordinates (u, v) = ((col, row)_rpc − origin) / scale, in the order
    col: u, v, 1, row: u, v, 1 (few redundant GCPs may agree by chance: see CAREFUL_SIGMA).
    """

    view: str
    image: str
    size: tuple[int, int]
    affine: Floats
    gcps: tuple[GcpResidual, ...]
    sigma0: float
    redundancy: int
    origin: tuple[float, float]
    scale: float
    covariance: Floats

    @property
    def left_out(self) -> tuple[GcpResidual, ...]:
        """The GCPs that did not take part."""
        return tuple(gcp for gcp in self.gcps if not gcp.used)

    def rms(self, which: str) -> float:
        """Root mean square length in px over the used GCPs: before, after or leave_one_out.

        NaN without any.
        """
        pairs = np.array([getattr(gcp, which) for gcp in self.gcps if gcp.used])
        if not pairs.size:
            return math.nan
        return float(np.sqrt(np.mean(np.sum(pairs**2, axis=1))))

    def covariance_at(self, col: ArrayLike, row: ArrayLike) -> Floats:
        """Covariance [..., 2, 2] in px² of the corrected (col, row) at image points.

        That is the part of a projected point's error that stems from the GCPs' measurement.
        """
        design = self.design(col, row)
        return design @ self.covariance @ np.swapaxes(design, -1, -2)

    def design(self, col: ArrayLike, row: ArrayLike) -> Floats:
        """[..., 2, 6]: change of the corrected (col, row) with the parameters of ``covariance``."""
        col, row = np.broadcast_arrays(np.asarray(col, float), np.asarray(row, float))
        image = np.stack([col, row], axis=-1) - self.affine[:, 2]
        rpc = image @ np.linalg.inv(self.affine[:, :2]).T
        u = (rpc - np.array(self.origin)) / self.scale
        basis = np.concatenate([u, np.ones((*u.shape[:-1], 1))], axis=-1)
        design = np.zeros((*basis.shape[:-1], 2, 6))
        design[..., 0, :3] = design[..., 1, 3:] = basis
        return design

    def moved(self, parameters: Floats) -> Floats:
        """The affine float64[2, 3] plus small parameters [6] in the order of ``covariance``."""
        change = parameters.reshape(2, 3)
        linear = change[:, :2] / self.scale
        shift = change[:, 2] - linear @ np.array(self.origin)
        return self.affine + np.column_stack([linear, shift])


@dataclass(frozen=True, eq=False)
class Alignment:
    """Aligned sensor models of a pair, with how they were found.

    ``reference_height``: mean of the GCPs that are used in either view (without any: of the RPCs,
    after refinement of the tie points), ellipsoidal m.
    ``cross_covariance`` float64[6, 6] of the left fit's parameters with the right's, px²;
    ``refinement``: what `refine` observed and changed, empty before.
    """

    scene: str
    model: str
    left: SensorModel
    right: SensorModel
    left_fit: ViewFit
    right_fit: ViewFit
    reference_height: float
    warnings: tuple[str, ...]
    provenance: dict[str, Any]
    cross_covariance: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    refinement: dict[str, Any] = field(default_factory=dict)

    @property
    def covariance(self) -> Floats:
        """float64[12, 12] px² of the parameters of both fits, left first."""
        left, right = (fit.covariance for fit in self.fits)
        return np.block([[left, self.cross_covariance], [self.cross_covariance.T, right]])

    def label_sigma(
        self, model: EpipolarModel, x: ArrayLike, y: ArrayLike
    ) -> tuple[Floats, Floats, Floats]:
        """Standard uncertainty in px that the alignment gives to labels at epipolar (x, y).

        Of the disparity, and of the label's own x and y in the left grid. For points at the
        reference height; NaN where the model has no ground.
        """
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        height = model.reference_height
        left = np.stack(model.epipolar_to_left(x, y), axis=-1)
        ground = model.left.localize(left[..., 0], left[..., 1], height)
        right = np.stack(model.right.project(*ground, height), axis=-1)
        effects = [
            image.slopes(at[..., 0], at[..., 1]) @ fit.design(at[..., 0], at[..., 1])
            for image, at, fit in zip(
                (model.left_image, model.right_image), (left, right), self.fits
            )
        ]
        disparity = np.concatenate([effects[0][..., 0, :], -effects[1][..., 0, :]], axis=-1)
        of_left = self.left_fit.covariance
        variances = [np.einsum("...i,ij,...j->...", disparity, self.covariance, disparity)]
        for axis in (0, 1):
            e = effects[0][..., axis, :]
            variances.append(np.einsum("...i,ij,...j->...", e, of_left, e))
        return tuple(np.sqrt(np.maximum(v, 0.0)) for v in variances)

    @property
    def fits(self) -> tuple[ViewFit, ViewFit]:
        """Left and right."""
        return self.left_fit, self.right_fit

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready; what is undetermined is null."""
        views = {
            name: sensor.to_dict() | _fit_to_dict(fit)
            for name, sensor, fit in (
                ("left", self.left, self.left_fit),
                ("right", self.right, self.right_fit),
            )
        }
        return {
            "what": "RPCs of a stereo pair, corrected by ground control points",
            "units": UNITS,
            "scene": self.scene,
            "model": self.model,
            "reference_height": self.reference_height,
            **views,
            "cross_covariance": self.cross_covariance.tolist(),
            "refinement": self.refinement,
            "warnings": list(self.warnings),
            "provenance": self.provenance,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Alignment:
        """The inverse of :meth:`to_dict`."""
        return cls(
            scene=values["scene"],
            model=values["model"],
            left=SensorModel.from_dict(values["left"]),
            right=SensorModel.from_dict(values["right"]),
            left_fit=_fit_from_dict("left", values["left"]),
            right_fit=_fit_from_dict("right", values["right"]),
            reference_height=values["reference_height"],
            warnings=tuple(values["warnings"]),
            provenance=values["provenance"],
            cross_covariance=np.array(values["cross_covariance"]),
            refinement=values["refinement"],
        )

    def save(self, path: str | Path) -> None:
        """Write JSON; the file appears when it is whole."""
        text = json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"
        with replacing(path) as scratch:
            scratch.write_text(text, encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Alignment:
        """Read what :meth:`save` wrote. Raises InputError if it cannot be used."""
        try:
            return cls.from_dict(json.loads(Path(path).read_text(encoding="utf-8")))
        except FileNotFoundError as error:
            raise InputError(
                "no such alignment", file=path, remedy="run the align stage"
            ) from error
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"not an alignment ({error})", file=path, remedy="run the align stage again"
            ) from error


def _fit_to_dict(fit: ViewFit) -> dict[str, Any]:
    def pair(values: tuple[float, float]) -> list[float | None]:
        return [float(v) if math.isfinite(v) else None for v in values]

    gcps = [
        {
            "id": g.id,
            "lon": g.lon,
            "lat": g.lat,
            "height": g.height,
            "measured": pair(g.measured),
            "predicted": pair(g.predicted),
            "before": pair(g.before),
            "after": pair(g.after),
            "leave_one_out": pair(g.leave_one_out),
            "used": g.used,
            "reason": g.reason,
        }
        for g in fit.gcps
    ]
    rms = {which: fit.rms(which) for which in ("before", "after", "leave_one_out")}
    return {
        "image": fit.image,
        "size": list(fit.size),
        "gcps": gcps,
        "left_out": [g.id for g in fit.left_out],
        "rms": {name: value if math.isfinite(value) else None for name, value in rms.items()},
        "sigma0": fit.sigma0 if math.isfinite(fit.sigma0) else None,
        "redundancy": fit.redundancy,
        "origin": list(fit.origin),
        "scale": fit.scale,
        "covariance": fit.covariance.tolist(),
    }


def _fit_from_dict(view: str, values: Mapping[str, Any]) -> ViewFit:
    def gcp(record: Mapping[str, Any]) -> GcpResidual:
        pairs = {
            name: tuple(math.nan if v is None else v for v in record[name])
            for name in ("measured", "predicted", "before", "after", "leave_one_out")
        }
        return GcpResidual(**{**record, **pairs})

    return ViewFit(
        view=view,
        image=values["image"],
        size=tuple(values["size"]),
        affine=np.array(values["affine"]),
        gcps=tuple(gcp(record) for record in values["gcps"]),
        sigma0=math.nan if values["sigma0"] is None else values["sigma0"],
        redundancy=values["redundancy"],
        origin=tuple(values["origin"]),
        scale=values["scale"],
        covariance=np.array(values["covariance"]),
    )


# ------------------------------------------------------------------------------------ one view


def _view_fit(
    view: View,
    system: System,
    points: ControlPoints,
    used: Bools,
    reasons: Mapping[int, str],
    sigma: float,
) -> ViewFit:
    """The exact fit on the used points, with its figures."""
    parameters = system.solve(used)
    affine = system.affine(parameters)
    after = system.residuals(parameters)
    one_out = leave_one_out_residuals(system, used)
    cofactors = system.embed @ system.cofactors(used) @ system.embed.T
    redundancy = 2 * int(used.sum()) - system.design.shape[2]
    careful, weight = CAREFUL_SIGMA
    variance = (redundancy * sigma**2 + weight * careful**2) / (redundancy + weight)
    table = []
    for k, i in enumerate(view.index):
        table.append(
            GcpResidual(
                id=points.ids[i],
                lon=float(points.lon[i]),
                lat=float(points.lat[i]),
                height=float(points.height[i]),
                measured=tuple(view.measured[k].tolist()),
                predicted=tuple(view.predicted[k].tolist()),
                before=tuple(system.delta[k].tolist()),
                after=tuple(after[k].tolist()),
                leave_one_out=tuple(one_out[k].tolist()),
                used=bool(used[k]),
                reason=reasons.get(int(i), ""),
            )
        )
    return ViewFit(
        view=view.name,
        image=view.image.name,
        size=view.size,
        affine=affine,
        gcps=tuple(table),
        sigma0=sigma,
        redundancy=redundancy,
        origin=tuple(system.origin.tolist()),
        scale=system.scale,
        covariance=variance * cofactors,
    )


def _doubts(fit: ViewFit, model: str) -> list[str]:
    """Warnings about a fit that is taken all the same."""
    found = []
    for gcp in fit.left_out:
        found.append(f"{fit.view} image: GCP {gcp.id} left out, {gcp.reason}")
    # At the GCPs themselves: the affine's constant part is that at pixel (0, 0).
    shift = np.median([g.before for g in fit.gcps if g.used], axis=0)
    if np.hypot(*shift) > LARGE_SHIFT:
        found.append(
            f"{fit.view} image: the RPC is off by {np.hypot(*shift):.0f} px; check that heights "
            "are ellipsoidal and that RPC and image belong together"
        )
    if (change := tilt(fit.affine)) > LARGE_TILT:
        found.append(
            f"{fit.view} image: the {model} changes scale or angle by {100 * change:.2f} %, more "
            "than RPCs err; check the GCPs at the ends, or take a simpler alignment.model"
        )
    if fit.sigma0 > POOR_SIGMA:
        found.append(f"{fit.view} image: GCPs fit by {fit.sigma0:.1f} px (sigma) only")
    return found


# ------------------------------------------------------------------------------------ the pair


def align(
    left_image: str | Path,
    right_image: str | Path,
    gcps_csv: str | Path,
    *,
    model: str = "affine",
    scene: str = "",
    blunder_floor: float = BLUNDER_FLOOR,
    estimator: str = "robust",
    seed: int = 0,
    strict: bool = False,
    provenance: Mapping[str, Any] | None = None,
) -> Alignment:
    """Correct the RPCs of a pair by ground control points.

    ``model``: affine (6 parameters per image, at least 4 GCPs), similarity (4; 3) or shift (2; 2).
    A GCP is left out of a view if its studentised residual exceeds ``blunder_floor`` px and 4.5
    times the GCPs' robust deviation; up to a third of a view's GCPs. ``estimator`` "opencv" takes
    the inliers of OpenCV's RANSAC at its defaults, as in the paper. ``seed`` is for the samples
    among more than 23 GCPs. The result does not depend on the order of the GCPs. ``strict``
    makes warnings errors.

    Raises InputError, naming scene, file and remedy: unreadable input, GCPs outside the images or
    elsewhere on the Earth, left and right swapped, too few or collinear GCPs for the model (naming
    one that would work), GCPs that contradict each other.
    """
    if model not in MINIMAL:
        raise InputError(
            f"unknown alignment model {model!r}", remedy=f"one of {', '.join(MINIMAL)}"
        )
    if estimator not in ("robust", "opencv"):
        raise InputError(f"unknown estimator {estimator!r}", remedy="one of robust, opencv")
    of = f" (scene {scene})" if scene else ""
    images = Path(left_image), Path(right_image)
    points = read_gcps(gcps_csv, scene)
    opened = [open_view(n, image, of) for n, image in zip(("left", "right"), images)]
    sensors = opened[0][0], opened[1][0]
    near = check_ground(points, (footprint(*item) for item in opened), of)
    check_swapped(points, sensors, near, of)

    doubts = [text for text in {check_heights(points, sensor): None for sensor in sensors} if text]
    for name, ok in zip(points.ids, near):
        if not ok:
            doubts.append(f"GCP {name} left out, its ground coordinates are far from the images")

    views, systems, used, lengths, limits = [], [], [], [], []
    for name, image, (sensor, size), measured in zip(
        ("left", "right"), images, opened, (points.left, points.right)
    ):
        seen = np.isfinite(measured[:, 0])
        projected = np.stack(sensor.project(points.lon, points.lat, points.height), axis=1)
        index = np.flatnonzero(seen & near & np.isfinite(projected).all(axis=1))
        view = View(name, image, size, sensor, index, projected[index], measured[index])
        check_frame(points, replace(view, index=np.flatnonzero(seen), measured=measured[seen]), of)
        everything = np.ones(len(index), dtype=bool)
        refuse_fit(model, view, points, everything, of)
        system = System.of(model, view.predicted, view.measured)
        if estimator == "opencv":
            kept = opencv_inliers(model, view.predicted, view.measured, blunder_floor)
            length, limit = studentised(system, kept), np.inf
        else:
            kept, length, limit = find_blunders(system, floor=blunder_floor, seed=seed)
        views.append(view)
        systems.append(system)
        used.append(kept)
        lengths.append(length)
        limits.append(limit)

    # A wrong ground coordinate may stand out in one view and be hardly seen in the other (a wrong
    # height in the near-vertical one): what is out in one has to be twice as good in the other.
    out = [set(view.index[~kept].tolist()) for view, kept in zip(views, used)]
    for k in (0, 1):
        for j, i in enumerate(views[k].index):
            if int(i) in out[1 - k] and lengths[k][j] > limits[k] / 2:
                used[k][j] = False

    fits = []
    out = [set(view.index[~kept].tolist()) for view, kept in zip(views, used)]
    for k, (view, system, kept) in enumerate(zip(views, systems, used)):
        refuse_fit(model, view, points, kept, of)
        sigma = refuse_misfit(model, view, system, points, kept, of)
        misses = np.hypot(*system.residuals(system.solve(kept)).T)
        reasons = {}
        for j, i in enumerate(view.index):
            if not kept[j]:
                both = int(i) in out[1 - k]
                cause = (
                    "off in both images: wrong ground coordinates?"
                    if both
                    else ("off in this image only: wrong measurement?")
                )
                reasons[int(i)] = f"{misses[j]:.1f} px off; {cause}"
        fits.append(_view_fit(view, system, points, kept, reasons, sigma))
        doubts += _doubts(fits[-1], model)

    for fit in fits:
        log.info(
            "%s image: %d of %d GCPs; rms %.3f px before, %.3f px after the %s, %.3f px leaving "
            "one out",
            fit.view,
            sum(g.used for g in fit.gcps),
            len(fit.gcps),
            fit.rms("before"),
            fit.rms("after"),
            model,
            fit.rms("leave_one_out"),
        )
    for text in doubts:
        log.warning("warning: %s", text)
    if strict and doubts:
        raise InputError(
            f"{doubts[0]}" + (f"; {len(doubts) - 1} more" if len(doubts) > 1 else "") + of,
            file=points.file,
            remedy="correct the GCPs, or set strict to false",
        )
    heights = {g.id: g.height for fit in fits for g in fit.gcps if g.used}
    if provenance is None:
        settings = {"model": model, "estimator": estimator, "blunder_floor_px": blunder_floor}
        provenance = describe([points.file, *images], settings, source_digest("alignment"))
    return Alignment(
        scene=scene,
        model=model,
        left=SensorModel(sensors[0].rpc, fits[0].affine),
        right=SensorModel(sensors[1].rpc, fits[1].affine),
        left_fit=fits[0],
        right_fit=fits[1],
        reference_height=round(float(np.mean([heights[name] for name in sorted(heights)])), 3),
        warnings=tuple(doubts),
        provenance=dict(provenance),
    )


def from_rpcs(
    left_image: str | Path,
    right_image: str | Path,
    *,
    model: str = "affine",
    scene: str = "",
    provenance: Mapping[str, Any] | None = None,
) -> Alignment:
    """The start of a refinement without ground control points: the RPCs as they are.

    Their covariance is that of RPC_SHIFT and RPC_TILT; the reference height is the middle of the
    RPCs' own heights. Raises InputError for unreadable images.
    """
    of = f" (scene {scene})" if scene else ""
    sensors, fits = [], []
    for name, image in (("left", Path(left_image)), ("right", Path(right_image))):
        sensor, size = open_view(name, image, of)
        scale = max(size) / 2
        tilt_variance = (RPC_TILT * scale) ** 2
        fits.append(
            ViewFit(
                view=name,
                image=image.name,
                size=size,
                affine=np.array(sensor.affine),
                gcps=(),
                sigma0=math.nan,
                redundancy=0,
                origin=((size[0] - 1) / 2, (size[1] - 1) / 2),
                scale=scale,
                covariance=np.diag([tilt_variance, tilt_variance, RPC_SHIFT**2] * 2),
            )
        )
        sensors.append(sensor)
    doubt = (
        f"no ground control points: places on the ground are known to about {RPC_SHIFT:g} px only, "
        "as the RPCs give them"
    )
    log.warning("warning: %s", doubt)
    if provenance is None:
        provenance = describe(
            [left_image, right_image], {"model": model}, source_digest("alignment")
        )
    return Alignment(
        scene=scene,
        model=model,
        left=sensors[0],
        right=sensors[1],
        left_fit=fits[0],
        right_fit=fits[1],
        reference_height=round(float(np.mean([s.rpc.height_off for s in sensors])), 3),
        warnings=(doubt,),
        provenance=dict(provenance),
    )
