"""The corrected RPCs of a pair, with residuals and covariance: what an alignment's file holds.

:meth:`Alignment.read` is the only reader of such files, whichever stage made them.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..core.products.files import atomic_file, read_perhaps_edited, read_record, sealed
from ..sensor.rpc import LineCorrection, SensorModel

log = logging.getLogger("stereotruth")


RPC_SHIFT = 10.0  # px, standard deviation of what an RPC without control points is off, and
RPC_TILT = 3e-4  # of its scale, rotation and shear
UNITS = {
    "col, row, before, after, leave_one_out, sigma0, rms": "px of the original image",
    "lon, lat": "degrees, WGS 84",
    "height": "m above the WGS 84 ellipsoid",
    "model_heights": "m above the WGS 84 ellipsoid, lowest and highest that the epipolar model "
    "is fitted to",
    "affine": "(col, row)_image = affine @ (col_rpc, row_rpc, 1); px",
    "covariance": "px^2, of (a_u, a_v, a_1, b_u, b_v, b_1) in col = … + a_u u + a_v v + a_1, "
    "row = … + b_u u + b_v v + b_1 with (u, v) = ((col, row)_rpc - origin) / scale",
    "cross_covariance": "px^2, of the left image's parameters (rows) with the right's",
}
OF_MISFITS = {
    "lines_covariance": "px^2, at equal steps of the left image from its first line to its last: "
    "of the corrections by line (col, row) of the left image's line, and (col, row) of the right "
    "image's that shows the same ground",
    "shared_px": "px, standard deviation of disparity by errors that near tie points share and no "
    "correction fits",
}
PAIRS = ("measured", "predicted", "before", "after", "leave_one_out")  # of a GcpResidual


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
    col: u, v, 1, row: u, v, 1 (few redundant GCPs may agree by chance: see
    :data:`.align.CAREFUL_SIGMA`).
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


def over_the_image(fit: ViewFit) -> ViewFit:
    """The fit with parameters that are those of the image alone: from its middle, by half a side.

    Its covariance is left as it was, in the parameters that the fit had.
    """
    cols, rows = fit.size
    return replace(fit, origin=((cols - 1) / 2, (rows - 1) / 2), scale=max(cols, rows) / 2)


def rpc_prior(fit: ViewFit) -> Floats:
    """Covariance [6, 6] px² of what an RPC is off, in the fit's own coordinates."""
    tilt = (RPC_TILT * fit.scale) ** 2
    return np.diag([tilt, tilt, RPC_SHIFT**2] * 2)


@dataclass(frozen=True, eq=False)
class Alignment:
    """Aligned sensor models of a pair, with how they were found.

    ``reference_height``: mean of the GCPs that are used in either view (without any: of the RPCs,
    after refinement of the tie points), ellipsoidal m.
    ``cross_covariance`` float64[6, 6] of the left fit's parameters with the right's, px²;
    ``model_heights``: ellipsoidal m, over which the pair's epipolar model is fitted: those of the
    LiDAR that `refine` saw, and a margin; None: all that both RPCs cover;
    ``refinement``: what `refine` observed and changed, empty before. ``lines_covariance`` [k, 4, 4]
    and ``shared_px``: see OF_MISFITS; None and 0 without any.
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
    model_heights: tuple[float, float] | None = None
    refinement: dict[str, Any] = field(default_factory=dict)
    lines_covariance: Floats | None = None
    shared_px: float = 0.0

    @property
    def covariance(self) -> Floats:
        """float64[12, 12] px² of the parameters of both fits, left first."""
        left, right = (fit.covariance for fit in self.fits)
        return np.block([[left, self.cross_covariance], [self.cross_covariance.T, right]])

    def of_lines(self, view: str) -> Floats:
        """float64[2, 2] px² of the (col, row) of a view by its correction by line, mean of all."""
        if self.lines_covariance is None:
            return np.zeros((2, 2))
        own = slice(0, 2) if view == "left" else slice(2, 4)
        return self.lines_covariance[:, own, own].mean(axis=0)

    @property
    def fits(self) -> tuple[ViewFit, ViewFit]:
        """Left and right."""
        return self.left_fit, self.right_fit

    @property
    def middle(self) -> tuple[float, float, float]:
        """(lon, lat, height) of what the middle of the left image shows, degrees and m."""
        cols, rows = self.left_fit.size
        height = self.reference_height
        lon, lat = self.left.localize((cols - 1) / 2, (rows - 1) / 2, height)
        return float(lon), float(lat), height

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready; what is undetermined is null."""
        sensors = self.left, self.right
        views = {f.view: s.to_dict() | _fit_to_dict(f) for f, s in zip(self.fits, sensors)}
        misfits: dict[str, Any] = {}
        if self.lines_covariance is not None:
            misfits["lines_covariance"] = self.lines_covariance.tolist()
        if self.shared_px:
            misfits["shared_px"] = self.shared_px
        return {
            "what": "RPCs of a stereo pair, corrected by ground control points",
            "units": UNITS | {name: OF_MISFITS[name] for name in misfits},
            "scene": self.scene,
            "model": self.model,
            "reference_height": self.reference_height,
            "model_heights": None if self.model_heights is None else list(self.model_heights),
            **views,
            "cross_covariance": self.cross_covariance.tolist(),
            **misfits,
            "refinement": self.refinement,
            "warnings": list(self.warnings),
            "provenance": self.provenance,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Alignment:
        """The inverse of :meth:`to_dict`."""
        heights = values.get("model_heights")  # which a file that a user made may do without
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
            model_heights=None if heights is None else tuple(heights),
            refinement=values["refinement"],
            lines_covariance=(
                np.array(values["lines_covariance"]) if "lines_covariance" in values else None
            ),
            shared_px=values.get("shared_px", 0.0),
        )

    def save(self, path: str | Path) -> None:
        """Write JSON; the file appears when it is whole."""
        with atomic_file(path) as scratch:
            scratch.write_text(sealed(self.to_dict()), encoding="utf-8")

    @classmethod
    def read(cls, path: str | Path) -> Alignment:
        """Read what :meth:`save` wrote, or what a user made of it for ``alignment.fixed``.

        A file that is not as it was written is told in the log. Raises InputError if it cannot be
        used, or says why the pair has no alignment.
        """

        def values_of(file: str | Path) -> dict[str, Any]:
            values, is_as_written = read_perhaps_edited(file)
            if not is_as_written:
                log.warning("%s: edited since it was made; its values are used as they are", file)
            if "refused" in values:
                raise InputError(
                    values["refused"],
                    file=file,
                    remedy="remove the pair from the scenes sheet, or correct the image's RPC, "
                    "file or control points",
                )
            return values

        return read_record(path, cls.from_dict, what="alignment", stage="align", read=values_of)


def prior_of(alignment: Alignment) -> Floats:
    """Covariance [12, 12] of both fits; what a simpler model keeps fixed may be off as RPCs are."""
    prior = alignment.covariance.copy()
    if alignment.model == "affine":
        return prior
    free = np.zeros((6, 6))
    free[[0, 1, 3, 4], [0, 1, 3, 4]] = 1.0
    if alignment.model == "similarity":
        for turn in ([1, 0, 0, 0, 1, 0], [0, -1, 0, 1, 0, 0]):
            free -= np.outer(turn, turn) / 2.0
    for k, fit in enumerate(alignment.fits):
        own = slice(6 * k, 6 * k + 6)
        prior[own, own] += free * (RPC_TILT * fit.scale) ** 2
    return prior


def parameters_of(fit: ViewFit) -> Floats:
    """[6] of a fit's affine against none, in the order of ``covariance`` and its coordinates."""
    change = fit.affine - np.eye(2, 3)
    at_origin = change[:, 2] + change[:, :2] @ np.array(fit.origin)
    return np.column_stack([change[:, :2] * fit.scale, at_origin]).ravel()


def with_corrections(
    alignment: Alignment,
    parameters: Floats,
    by_line: tuple[LineCorrection | None, LineCorrection | None] = (None, None),
) -> Alignment:
    """The alignment with both affines moved by parameters [12], and corrections by line."""
    fits, sensors = [], []
    for fit, sensor, own, lines in zip(
        alignment.fits,
        (alignment.left, alignment.right),
        (parameters[:6], parameters[6:]),
        by_line,
    ):
        affine = fit.moved(own)
        sensors.append(SensorModel(sensor.rpc, affine, lines))
        gcps = []
        for gcp in fit.gcps:
            at = affine @ (*gcp.predicted, 1.0)
            after = np.array(gcp.measured) - (at if lines is None else np.array(lines.add(*at)))
            gcps.append(replace(gcp, after=tuple(after.tolist())))
        fits.append(replace(fit, affine=affine, gcps=tuple(gcps)))
    return replace(
        alignment,
        left=sensors[0],
        right=sensors[1],
        left_fit=fits[0],
        right_fit=fits[1],
    )


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _fit_to_dict(fit: ViewFit) -> dict[str, Any]:
    gcps = [
        asdict(g) | {name: [_finite(v) for v in getattr(g, name)] for name in PAIRS}
        for g in fit.gcps
    ]
    return {
        "image": fit.image,
        "size": list(fit.size),
        "gcps": gcps,
        "left_out": [g.id for g in fit.left_out],
        "rms": {which: _finite(fit.rms(which)) for which in PAIRS[2:]},
        "sigma0": _finite(fit.sigma0),
        "redundancy": fit.redundancy,
        "origin": list(fit.origin),
        "scale": fit.scale,
        "covariance": fit.covariance.tolist(),
    }


def gcp_of(record: Mapping[str, Any]) -> GcpResidual:
    """A point of an alignment's file; what is null there is undetermined."""
    pairs = {name: tuple(math.nan if v is None else v for v in record[name]) for name in PAIRS}
    return GcpResidual(**{**record, **pairs})


def _fit_from_dict(view: str, values: Mapping[str, Any]) -> ViewFit:
    return ViewFit(
        view=view,
        image=values["image"],
        size=tuple(values["size"]),
        affine=np.array(values["affine"]),
        gcps=tuple(gcp_of(record) for record in values["gcps"]),
        sigma0=math.nan if values["sigma0"] is None else values["sigma0"],
        redundancy=values["redundancy"],
        origin=tuple(values["origin"]),
        scale=values["scale"],
        covariance=np.array(values["covariance"]),
    )
