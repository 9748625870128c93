"""Alignment of a pair's RPCs with ground control points (section III-A of the paper).

GCPs are projected by the RPC of each image, and an affine transformation (or a similarity, or a
shift) is fitted that takes the projected to the measured image coordinates. Blunders are left out
and named (see :mod:`.gcp_checks`).

Image coordinates are (col, row) in px, (0, 0) at the centre of the upper-left pixel; ground is
WGS 84 longitude, latitude in degrees and ellipsoidal height in m.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.numerics.arrays import Bools, Floats
from ..core.products.files import write_table
from ..lidar.frames import DEFAULT_EPOCH, Epoch
from ..sensor.rpc import SensorModel
from .alignment import (
    PAIRS,
    RPC_SHIFT,
    Alignment,
    GcpResidual,
    ViewFit,
    over_the_image,
    rpc_prior,
)
from .control_points import ControlPoints, read_gcps
from .gcp_checks import (
    MINIMAL,
    System,
    View,
    check_frame,
    check_ground,
    check_heights,
    check_swapped,
    find_blunders,
    footprint,
    leave_one_out_residuals,
    refuse_fit,
    refuse_misfit,
    tilt,
)
from .images import open_view

log = logging.getLogger("stereotruth")


POOR_SIGMA = 2.0  # px
# A careful measurement in px, and for how many degrees of freedom it stands beside the residuals
# when these are few: 4 GCPs leave two, and may agree by chance.
CAREFUL_SIGMA = (0.25, 2)
PLACES_BY_RPCS = (
    f"no ground control points: places on the ground are known to about {RPC_SHIFT:g} px only, as "
    "the RPCs give them"
)
LARGE_SHIFT = 200.0  # px: RPCs err by some 1 to 50 px
LARGE_TILT = 0.005  # change of scale, rotation or shear; RPCs err by less than 0.001


@dataclass(frozen=True, eq=False)
class _Trial:
    """The fit of a view while its blunders are looked for.

    ``used`` bool[n] of the view's points; ``lengths`` [n]: their studentised residuals, px;
    ``limit`` px: above, a point is a blunder.
    """

    view: View
    system: System
    used: Bools
    lengths: Floats
    limit: float

    @property
    def left_out(self) -> set[int]:
        """Rows of the table that are left out."""
        return set(self.view.index[~self.used].tolist())

    def fit(self, model: str, points: ControlPoints, out_in_other: set[int]) -> ViewFit:
        """The exact fit to what is used; InputError if that is too little, or does not fit."""
        view, system, used = self.view, self.system, self.used
        refuse_fit(model, view, points, used)
        sigma = refuse_misfit(model, view, system, points, used)
        parameters = system.solve(used)
        after = system.residuals(parameters)
        one_out = leave_one_out_residuals(system, used)
        table = []
        for k, i in enumerate(view.index.tolist()):
            cause = (
                "off in both images: wrong ground coordinates?"
                if i in out_in_other
                else "off in this image only: wrong measurement?"
            )
            pairs = view.measured[k], view.predicted[k], system.delta[k], after[k], one_out[k]
            table.append(
                GcpResidual(
                    points.ids[i],
                    *(float(values[i]) for values in (points.lon, points.lat, points.height)),
                    *(tuple(pair.tolist()) for pair in pairs),
                    used=bool(used[k]),
                    reason="" if used[k] else f"{np.hypot(*after[k]):.1f} px off; {cause}",
                )
            )
        redundancy = 2 * int(used.sum()) - system.design.shape[2]
        careful, weight = CAREFUL_SIGMA
        variance = (redundancy * sigma**2 + weight * careful**2) / (redundancy + weight)
        return ViewFit(
            view=view.name,
            image=view.image.name,
            size=view.size,
            affine=system.affine(parameters),
            gcps=tuple(table),
            sigma0=sigma,
            redundancy=redundancy,
            origin=tuple(system.origin.tolist()),
            scale=system.scale,
            covariance=variance * (system.embed @ system.cofactors(used) @ system.embed.T),
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


def align(
    left_image: str | Path,
    right_image: str | Path,
    gcps_csv: str | Path,
    *,
    names: tuple[str, str] | None = None,
    model: str = "affine",
    scene: str = "",
    strict: bool = False,
    epoch: Epoch = DEFAULT_EPOCH,
    provenance: Mapping[str, Any] | None = None,
) -> Alignment:
    """Correct the RPCs of a pair by ground control points.

    ``model``: affine (6 parameters per image, at least 4 GCPs), similarity (4; 3) or shift (2; 2).
    A GCP is left out of a view if its studentised residual exceeds
    :data:`.gcp_checks.BLUNDER_FLOOR` px and 4.5 times the GCPs' robust deviation; up to a third of
    a view's GCPs. ``names`` of both images in the images sheet are what control points of the long
    form name. ``epoch``: of the city's places, see :func:`.control_points.read_gcps`. The result
    does not depend on the order of the GCPs. ``strict`` makes warnings errors.

    Raises InputError, naming scene, file and remedy: unreadable input, GCPs outside the images or
    elsewhere on the Earth, left and right swapped, too few or collinear GCPs for the model (naming
    one that would work), GCPs that contradict each other.
    """
    if model not in MINIMAL:
        raise InputError(
            f"unknown alignment model {model!r}", remedy=f"one of {', '.join(MINIMAL)}"
        )
    of = f" (scene {scene})" if scene else ""
    images = Path(left_image), Path(right_image)
    points = read_gcps(gcps_csv, scene, names, epoch)
    opened = [open_view(n, image, of) for n, image in zip(("left", "right"), images)]
    sensors = opened[0][0], opened[1][0]
    try:
        fits, doubts = _fit_views(points, images, opened, model)
    except InputError as error:
        file = error.file or points.file
        raise type(error)(error.problem + of, file=file, remedy=error.remedy) from None
    for fit in fits:
        doubts += _doubts(fit, model)
    _tell(fits, model, doubts)
    if strict and doubts:
        raise InputError(
            f"{doubts[0]}" + (f"; {len(doubts) - 1} more" if len(doubts) > 1 else "") + of,
            file=points.file,
            remedy="correct the GCPs, or set strict to false",
        )
    heights = {g.id: g.height for fit in fits for g in fit.gcps if g.used}
    return Alignment(
        scene=scene,
        model=model,
        left=SensorModel(sensors[0].rpc, fits[0].affine),
        right=SensorModel(sensors[1].rpc, fits[1].affine),
        left_fit=fits[0],
        right_fit=fits[1],
        reference_height=round(float(np.mean([heights[name] for name in sorted(heights)])), 3),
        warnings=tuple(doubts),
        provenance=dict(provenance or {}),
    )


def _fit_views(
    points: ControlPoints,
    images: tuple[Path, Path],
    opened: Sequence[tuple[SensorModel, tuple[int, int]]],
    model: str,
) -> tuple[list[ViewFit], list[str]]:
    """The fits of both views, and doubts about the points. What is refused does not name the scene
    yet."""
    near = check_ground(points, [footprint(*item) for item in opened], images)
    check_swapped(points, [sensor for sensor, _ in opened], near)

    doubts = list(points.remarks)
    doubts += [
        text for text in {check_heights(points, sensor): None for sensor, _ in opened} if text
    ]
    for name, ok in zip(points.ids, near):
        if not ok:
            doubts.append(f"GCP {name} left out, its ground coordinates are far from the images")

    trials = []
    for name, image, (sensor, size), measured in zip(
        ("left", "right"), images, opened, (points.left, points.right)
    ):
        seen = np.isfinite(measured[:, 0])
        projected = np.stack(sensor.project(points.lon, points.lat, points.height), axis=1)
        index = np.flatnonzero(seen & near & np.isfinite(projected).all(axis=1))
        view = View(name, image, size, sensor, index, projected[index], measured[index])
        check_frame(points, replace(view, index=np.flatnonzero(seen), measured=measured[seen]))
        refuse_fit(model, view, points, np.ones(len(index), dtype=bool))
        system = System.of(model, view.predicted, view.measured)
        trials.append(_Trial(view, system, *find_blunders(system)))
    if points.frame and points.frame["source"]["legs"]:
        legs = "; ".join(points.frame["source"]["legs"])
        log.info("GCPs of frame %s brought to ITRF2020: %s", points.frame["source"]["frame"], legs)
    _leave_out_of_both(trials)
    out = [trial.left_out for trial in trials]
    fits = [trial.fit(model, points, other) for trial, other in zip(trials, reversed(out))]
    return fits, doubts


def _leave_out_of_both(trials: Sequence[_Trial]) -> None:
    """Hold points that one view leaves out to half the limit in the other.

    A wrong ground coordinate may stand out in one view and be hardly seen in the other (a wrong
    height in the near-vertical one).
    """
    out = [trial.left_out for trial in trials]
    for trial, out_in_other in zip(trials, reversed(out)):
        for j, i in enumerate(trial.view.index):
            if int(i) in out_in_other and trial.lengths[j] > trial.limit / 2:
                trial.used[j] = False


def _tell(fits: Sequence[ViewFit], model: str, doubts: Sequence[str]) -> None:
    """Residuals and doubts in the log."""
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


def from_rpcs(
    left_image: str | Path,
    right_image: str | Path,
    *,
    model: str = "affine",
    scene: str = "",
    provenance: Mapping[str, Any] | None = None,
) -> Alignment:
    """The start of a refinement without ground control points: the RPCs as they are.

    Their covariance is that of :func:`.alignment.rpc_prior`; the reference height is the middle of
    the RPCs' own heights. Raises InputError for unreadable images.
    """
    of = f" (scene {scene})" if scene else ""
    sensors, fits = [], []
    for name, image in (("left", Path(left_image)), ("right", Path(right_image))):
        sensor, size = open_view(name, image, of)
        affine = np.array(sensor.affine)
        fit = ViewFit(
            name, image.name, size, affine, (), math.nan, 0, (0.0, 0.0), 1.0, np.zeros((6, 6))
        )
        fit = over_the_image(fit)
        fits.append(replace(fit, covariance=rpc_prior(fit)))
        sensors.append(sensor)
    log.warning("warning: %s", PLACES_BY_RPCS)
    return Alignment(
        scene=scene,
        model=model,
        left=sensors[0],
        right=sensors[1],
        left_fit=fits[0],
        right_fit=fits[1],
        reference_height=round(float(np.mean([s.rpc.height_off for s in sensors])), 3),
        warnings=(PLACES_BY_RPCS,),
        provenance=dict(provenance or {}),
    )


def write_alignment(alignment: Alignment, json_file: str | Path, csv_file: str | Path) -> None:
    """Write the alignment (JSON) and the residuals of every GCP (CSV, px)."""
    axes = [(name, k, axis) for name in PAIRS for k, axis in enumerate(("col", "row"))]
    rows = []
    for fit in alignment.fits:
        for g in fit.gcps:
            row = {"view": fit.view, "id": g.id, "used": "yes" if g.used else "no"}
            row |= {"lon_deg": f"{g.lon:.10f}", "lat_deg": f"{g.lat:.10f}"}
            row |= {"height_m": f"{g.height:.4f}"}
            row |= {f"{name}_{axis}_px": f"{getattr(g, name)[k]:.4f}" for name, k, axis in axes}
            rows.append(row | {"reason": g.reason})
    columns = ["view", "id", "used", "lon_deg", "lat_deg", "height_m"]
    columns += [f"{name}_{axis}_px" for name, _, axis in axes] + ["reason"]
    write_table(csv_file, rows, columns)
    alignment.save(json_file)
