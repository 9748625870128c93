"""Alignment of a pair's RPCs with ground control points (section III-A of the paper).

GCPs are projected by the RPC of each image, and an affine transformation (or a similarity, or a
shift) is fitted that takes the projected to the measured image coordinates. Blunders are left out
and named (see ``robust_fit``); ``estimator="opencv"`` is the paper's way.

Image coordinates are (col, row) in px, (0, 0) at the centre of the upper-left pixel; ground is
WGS 84 longitude, latitude in degrees and ellipsoidal height in m.
"""

from __future__ import annotations

import csv
import json
import logging
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import ArrayLike, NDArray
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from .control_points import ControlPoints, read_gcps
from .errors import InputError
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
from .rpc import SensorModel, read_rpc

__all__ = ["Alignment", "GcpResidual", "ViewFit", "align", "read_gcps", "write_alignment"]

log = logging.getLogger("stereotruth")

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# One more than determines the model is asked for: with fewer, no residual tells of an error.
NEEDED = {model: n + 1 for model, n in MINIMAL.items()}
MAX_LEFT_OUT = 1 / 3  # share of blunders beyond which nobody knows which points are right
MAX_SIGMA = 5.0  # px: beyond, GCPs and image do not belong together
POOR_SIGMA = 2.0  # px
UNCHECKED_SIGMA = 3.0  # px, where there are too few GCPs to find the blunder among them
LARGE_SHIFT = 200.0  # px: RPCs err by some 1 to 50 px
MAX_TILT = 0.05  # beyond, columns and rows are mixed up
LARGE_TILT = 0.005  # change of scale, rotation or shear; RPCs err by less than 0.001
MIN_SPREAD = 10.0  # px: standard deviation of the GCPs along their main axis
MIN_WIDTH_RATIO = 0.05  # of the deviations across and along: below, the GCPs count as collinear
FRAME_MARGIN = 1.0  # px that a measurement may lie outside the pixels of the image
UNITS = {
    "col, row, before, after, leave_one_out, sigma0, rms": "px of the original image",
    "lon, lat": "degrees, WGS 84",
    "height": "m above the WGS 84 ellipsoid",
    "affine": "(col, row)_image = affine @ (col_rpc, row_rpc, 1); px",
    "covariance": "px^2, of (a_u, a_v, a_1, b_u, b_v, b_1) in col = … + a_u u + a_v v + a_1, "
    "row = … + b_u u + b_v v + b_1 with (u, v) = ((col, row)_rpc - origin) / scale",
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
    col: u, v, 1, row: u, v, 1.
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
        """Root mean square length in px over the used GCPs: before, after or leave_one_out."""
        pairs = np.array([getattr(gcp, which) for gcp in self.gcps if gcp.used])
        return float(np.sqrt(np.mean(np.sum(pairs**2, axis=1))))

    def covariance_at(self, col: ArrayLike, row: ArrayLike) -> Floats:
        """Covariance [..., 2, 2] in px² of the corrected (col, row) at image points.

        That is the part of a projected point's error that stems from the GCPs' measurement.
        """
        col, row = np.broadcast_arrays(np.asarray(col, float), np.asarray(row, float))
        image = np.stack([col, row], axis=-1) - self.affine[:, 2]
        rpc = image @ np.linalg.inv(self.affine[:, :2]).T
        u = (rpc - np.array(self.origin)) / self.scale
        basis = np.concatenate([u, np.ones((*u.shape[:-1], 1))], axis=-1)
        blocks = self.covariance.reshape(2, 3, 2, 3)
        return np.einsum("...i,aibj,...j->...ab", basis, blocks, basis)


@dataclass(frozen=True, eq=False)
class Alignment:
    """Aligned sensor models of a pair, with how they were found.

    ``reference_height``: mean of the GCPs that are used in either view, ellipsoidal m.
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
        "sigma0": fit.sigma0,
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
        sigma0=values["sigma0"],
        redundancy=values["redundancy"],
        origin=tuple(values["origin"]),
        scale=values["scale"],
        covariance=np.array(values["covariance"]),
    )


# ----------------------------------------------------------------------------------- refusals


@dataclass(frozen=True, eq=False)
class _View:
    """One view's input: rows of the GCP table that it sees, and where."""

    name: str
    image: Path
    size: tuple[int, int]
    sensor: SensorModel
    index: NDArray[np.intp]
    predicted: Floats
    measured: Floats


def _plural(n: int) -> str:
    return f"{n} GCP" if n == 1 else f"{n} GCPs"


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
            f"{_plural(n)}, the model {model!r} needs {NEEDED[model]} "
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


def _open_view(name: str, image: Path, of: str) -> tuple[SensorModel, tuple[int, int]]:
    """The RPC of an image and its size (cols, rows)."""
    sensor = SensorModel(read_rpc(image))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(image) as dataset:
                return sensor, (dataset.width, dataset.height)
    except RasterioError as error:
        raise InputError(
            f"cannot be opened as the {name} image{of} ({error})",
            file=image,
            remedy="check the file",
        ) from None


def _footprint(sensor: SensorModel, size: tuple[int, int]) -> Floats:
    """(lon_min, lat_min, lon_max, lat_max) of an image over its RPC's heights, widened by half."""
    heights = np.array([-1.0, 0.0, 1.0]) * abs(sensor.rpc.height_scale) + sensor.rpc.height_off
    col, row, height = np.meshgrid([0, size[0] - 1], [0, size[1] - 1], heights)
    lon, lat = sensor.localize(col, row, height)
    if not np.isfinite(lon).any():
        box = sensor.rpc.ground_box
        low, high = np.array(box[:2]), np.array(box[2:4])
    else:
        low = np.array([np.nanmin(lon), np.nanmin(lat)])
        high = np.array([np.nanmax(lon), np.nanmax(lat)])
    margin = (high - low) / 2 + 0.01
    return np.concatenate([low - margin, high + margin])


def _in_box(box: Floats, lon: Floats, lat: Floats) -> Bools:
    turns = np.round((lon - (box[0] + box[2]) / 2) / 360.0)
    lon = lon - 360.0 * turns
    return (lon >= box[0]) & (lon <= box[2]) & (lat >= box[1]) & (lat <= box[3])


def _check_ground(points: ControlPoints, boxes: Iterable[Floats], of: str) -> Bools:
    """bool[n]: near either image's footprint. Refuses the file if most points are elsewhere."""
    boxes = list(boxes)
    near = np.any([_in_box(box, points.lon, points.lat) for box in boxes], axis=0)
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
            f"lon and lat of the GCPs seem to be swapped: {where}{of}",
            file=points.file,
            remedy="exchange the columns lon and lat",
        )
    raise InputError(
        f"the GCPs lie far from the ground that the images show: {where}{of}",
        file=points.file,
        remedy="check that the file is that of this scene, and its coordinates WGS 84 degrees",
    )


def _check_heights(points: ControlPoints, sensor: SensorModel) -> str:
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


def _check_swapped(
    points: ControlPoints, sensors: tuple[SensorModel, SensorModel], near: Bools, of: str
) -> None:
    """Refuse a pair whose GCPs fit only with left and right exchanged."""
    both = near & points.in_left & points.in_right
    if both.sum() < 3:
        return
    ground = points.lon[both], points.lat[both], points.height[both]
    projected = [np.stack(sensor.project(*ground), axis=1) for sensor in sensors]

    def misfit(measured: tuple[Floats, Floats]) -> float:
        """Median distance from the median shift, the worse of both images."""
        worst = 0.0
        for there, here in zip(projected, measured):
            delta = here - there
            worst = max(worst, float(np.median(np.hypot(*(delta - np.median(delta, axis=0)).T))))
        return worst

    given = misfit((points.left[both], points.right[both]))
    exchanged = misfit((points.right[both], points.left[both]))
    if given > 10.0 and exchanged < given / 5:
        raise InputError(
            "left_image and right_image seem to be swapped in the scenes sheet: the GCPs miss by "
            f"{given:.0f} px as given, by {exchanged:.1f} px with the two exchanged{of}",
            file=points.file,
            remedy="exchange the columns left_image and right_image of this scene; left is the "
            "backward view (or exchange the left and right columns of the GCP file, if it is that)",
        )


def _check_frame(points: ControlPoints, view: _View, of: str) -> None:
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
            f"{view.size[1]} px (cols x rows)" + (f", and {others} more" if others else "") + of,
            file=points.file,
            remedy="correct the measurement, or leave both cells empty where the image does not "
            "show the point",
        )


# ------------------------------------------------------------------------------------ one view


def _refuse_fit(model: str, view: _View, points: ControlPoints, used: Bools, of: str) -> None:
    """Refuse a view whose used GCPs cannot carry the model."""
    defect = _defect(model, view.predicted[used])
    if not defect:
        return
    out = [points.ids[i] for i in view.index[~used]]
    rest = f" after {_some(out)} were left out" if out else ""
    raise InputError(
        f"{view.name} image {view.image.name}: {defect}{rest}{of}",
        file=points.file,
        remedy=_remedy(model, view.predicted[used]),
    )


def _refuse_misfit(
    model: str, view: _View, system: System, points: ControlPoints, used: Bools, of: str
) -> float:
    """Refuse GCPs that contradict each other; sigma0 in px of those used."""
    n, kept = len(used), int(used.sum())
    redundancy = 2 * kept - system.design.shape[2]
    residuals = system.residuals(system.solve(used))[used]
    sigma = float(np.sqrt(np.sum(residuals**2) / redundancy))
    where = f"{view.name} image {view.image.name}"
    if n - kept > MAX_LEFT_OUT * n:
        out = [points.ids[i] for i in view.index[~used]]
        raise InputError(
            f"{where}: {len(out)} of {n} GCPs contradict the others ({_some(out)}){of}",
            file=points.file,
            remedy="check these GCPs, and that the file belongs to these images",
        )
    if n <= system.minimal + 2 and sigma > UNCHECKED_SIGMA:
        delta = system.delta
        far = np.hypot(*(delta - np.median(delta, axis=0)).T)
        suspect = points.ids[view.index[int(np.argmax(far))]]
        raise InputError(
            f"{where}: the {n} GCPs contradict each other by {sigma:.1f} px, and so few do not "
            f"tell which is wrong ({suspect} differs most from the others' shift){of}",
            file=points.file,
            remedy=f"check {suspect} first; measure more GCPs: among "
            f"{system.minimal + 3} or more a blunder is found and left out",
        )
    if sigma > MAX_SIGMA:
        raise InputError(
            f"{where}: the GCPs do not fit the image (sigma {sigma:.1f} px after the {model} "
            f"correction){of}",
            file=points.file,
            remedy="check that GCP file, image and RPC belong together, and that heights are "
            "metres above the ellipsoid",
        )
    if (tilt := _tilt(system.affine(system.solve(used)))) > MAX_TILT:
        raise InputError(
            f"{where}: the GCPs ask for a change of scale or angle by {100 * tilt:.0f} %{of}",
            file=points.file,
            remedy="check that columns count from the left and rows from the top, and that GCP "
            "file, image and RPC belong together",
        )
    return sigma


def _tilt(affine: Floats) -> float:
    """Largest relative change of a distance by the linear part of an affine."""
    return float(np.linalg.norm(affine[:, :2] - np.eye(2), ord=2))


def _view_fit(
    view: _View,
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
        redundancy=2 * int(used.sum()) - system.design.shape[2],
        origin=tuple(system.origin.tolist()),
        scale=system.scale,
        covariance=sigma**2 * cofactors,
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
    if (tilt := _tilt(fit.affine)) > LARGE_TILT:
        found.append(
            f"{fit.view} image: the {model} changes scale or angle by {100 * tilt:.2f} %, more "
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
    opened = [_open_view(n, image, of) for n, image in zip(("left", "right"), images)]
    sensors = opened[0][0], opened[1][0]
    near = _check_ground(points, (_footprint(*item) for item in opened), of)
    _check_swapped(points, sensors, near, of)

    doubts = [text for text in {_check_heights(points, sensor): None for sensor in sensors} if text]
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
        view = _View(name, image, size, sensor, index, projected[index], measured[index])
        _check_frame(points, replace(view, index=np.flatnonzero(seen), measured=measured[seen]), of)
        everything = np.ones(len(index), dtype=bool)
        _refuse_fit(model, view, points, everything, of)
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
        _refuse_fit(model, view, points, kept, of)
        sigma = _refuse_misfit(model, view, system, points, kept, of)
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


# -------------------------------------------------------------------------------------- output


def write_alignment(
    alignment: Alignment, json_file: str | Path, csv_file: str | Path, png_file: str | Path
) -> None:
    """Write the alignment (JSON), the residuals of every GCP (CSV, px) and their figure (PNG)."""
    with replacing(csv_file) as scratch:
        _write_table(alignment, scratch)
    with replacing(png_file) as scratch:
        _draw(alignment, scratch)
    alignment.save(json_file)


def _write_table(alignment: Alignment, path: Path) -> None:
    pairs = ("measured", "predicted", "before", "after", "leave_one_out")
    header = ["view", "id", "used", "lon_deg", "lat_deg", "height_m"]
    header += [f"{name}_{axis}_px" for name in pairs for axis in ("col", "row")] + ["reason"]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for fit in alignment.fits:
            for g in fit.gcps:
                numbers = [f"{v:.4f}" for name in pairs for v in getattr(g, name)]
                ground = [f"{g.lon:.10f}", f"{g.lat:.10f}", f"{g.height:.4f}"]
                writer.writerow(
                    [fit.view, g.id, "yes" if g.used else "no", *ground, *numbers, g.reason]
                )


def _nice(value: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten below a positive value."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step for step in (1.0, 2.0, 5.0) if step * power <= value * 1.0000001) * power


def _draw(alignment: Alignment, path: Path) -> None:
    """Vectors of the residuals on both images' frames, before and after the correction."""
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 10.5), layout="constrained")
    axes = figure.subplots(2, 2)
    figure.suptitle(
        f"{alignment.scene or 'alignment'}: residuals of the ground control points, measured − "
        f"projected ({alignment.model})"
    )
    for k, fit in enumerate(alignment.fits):
        cols, rows = fit.size
        side = max(cols, rows)
        for ax, which, word in zip(axes[:, k], ("before", "after"), ("RPC alone", "corrected")):
            used = [g for g in fit.gcps if g.used]
            at = np.array([g.measured for g in used])
            vector = np.array([getattr(g, which) for g in used])
            longest = max(float(np.hypot(*vector.T).max()), 1e-3)
            key = _nice(longest)
            # image px of the frame per px of residual: the longest takes an eighth of the frame
            width = {"angles": "xy", "scale_units": "xy", "scale": longest * 8 / side}
            arrows = ax.quiver(*at.T, *vector.T, color="C0", width=0.005, zorder=3, **width)
            ax.quiverkey(arrows, 0.80, 1.03, key, f"{key:g} px", labelpos="E", coordinates="axes")
            ax.plot(*at.T, "o", color="black", markersize=3, zorder=4)
            for g in fit.gcps:
                ax.annotate(
                    g.id,
                    g.measured,
                    xytext=(4, 4),
                    textcoords="offset points",
                    fontsize=8,
                    color="0.25" if g.used else "C3",
                )
                if not g.used:
                    ax.plot(*g.measured, "x", color="C3", markersize=9, mew=2, zorder=4)
            out = f", {len(fit.left_out)} left out (×)" if fit.left_out else ""
            ax.set_title(
                f"{fit.view}, {word}: rms {fit.rms(which):.3f} px{out}", loc="left", fontsize=10
            )
            ax.add_patch(
                matplotlib.patches.Rectangle((-0.5, -0.5), cols, rows, fill=False, color="0.6")
            )
            ax.set_xlim(-0.06 * side, cols + 0.06 * side)
            ax.set_ylim(rows + 0.06 * side, -0.06 * side)
            ax.set_aspect("equal")
            ax.set_xlabel("col (px)")
            ax.set_ylabel("row (px)")
    figure.savefig(path, dpi=110)
