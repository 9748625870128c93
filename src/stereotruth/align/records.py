"""Equations of a pair's tie points, and adjusted images of a site: values, files, pairs by them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.numerics.arrays import Bools, Floats, Ints
from ..core.numerics.statistics import median_and_nmad
from ..core.products.files import atomic_file, read_record, sealed
from ..sensor.rpc import LineCorrection, SensorModel, read_correction
from .alignment import Alignment, ViewFit, gcp_of, over_the_image

MEANING = (
    "observed [along, across the epipolar rows; px] = design [2, 12] @ parameters + error, one row "
    "per tie point; parameters: (a_u, a_v, a_1, b_u, b_v, b_1) of the left image, then of the "
    "right, of the correction of the RPC's (col, row) by (a_u u + a_v v + a_1, b_u u + b_v v + "
    "b_1), px, (u, v) being px from the image's middle in halves of its longer side; own: px, "
    "standard deviation of the match by itself; site: tie points of one part of the scene; at: "
    "(col, row) px in the left image, there: in the right one; in_plan: of the left and the right "
    "image, by edges of roofs: observed [col, row; px] = design [2, 6] @ parameters of the image + "
    "error of this covariance [px^2], and px_per_m @ (east, north; m) of an error that all share"
)


@dataclass(frozen=True, eq=False)
class Equations:
    """Observations [n] of what the corrections change: observed = design · parameters + errors.

    ``design`` [n, 2, 12], ``observed`` [n, 2] px, along and across the rows. ``own`` [n] px: the
    matches' own standard deviations, which count as ratios only (poor matches are poorer than that,
    and biased where the surface is not what the points say). Observations of one ``site`` int[n]
    share errors. ``at``, ``there`` [n, 2] px: place in the left and in the right image.
    """

    design: Floats
    observed: Floats
    own: Floats
    site: Ints
    at: Floats
    there: Floats

    @property
    def lines(self) -> Floats:
        """[n, 2] px: lines of the left and of the right image."""
        return np.column_stack([self.at[:, 1], self.there[:, 1]])

    def part(self, chosen: Bools) -> Equations:
        """Those that are ``chosen`` [n]."""
        return Equations(*(getattr(self, f.name)[chosen] for f in fields(self)))

    def about(self, parameters: Floats) -> Equations:
        """The same of parameters that are counted from given ones [12]."""
        return replace(self, observed=self.observed - self.design @ parameters)


@dataclass(frozen=True, eq=False)
class PlanObservation:
    """The place of an image in plan, in px of (col, row): observed = design @ parameters + error.

    ``design`` [2, 6] of the parameters of :func:`.alignment.parameters_of`, ``observed`` [2],
    ``covariance`` [2, 2] px² of the image's own error; ``px_per_m`` [2, 2]: by what a metre to the
    east and to the north moves a place, and so the error that all images have in common.
    """

    design: Floats
    observed: Floats
    covariance: Floats
    px_per_m: Floats


@dataclass(frozen=True, eq=False)
class PairEquations:
    """What the tie points of a pair say of its images, whatever alignment they were found with.

    ``equations``: of the parameters [12] of :func:`.alignment.parameters_of` of both images, left
    first.
    ``start`` [12]: those of the alignment by control points or RPCs; ``linearised_at`` [12]: those
    with which the tie points were matched. ``places``: where the images were compared, with and
    without a match. ``common_px``: see :func:`.adjustment.estimate`. ``in_plan``: the
    place of the left and of the right image in plan, if edges of roofs tell it.
    """

    equations: Equations
    start: Floats
    linearised_at: Floats
    places: int
    common_px: float
    in_plan: tuple[PlanObservation, ...] = ()


def spreads_of(
    before: Floats, after: Floats, at: Floats, size: tuple[int, int]
) -> dict[str, dict[str, dict[str, float]]]:
    """Figures of residuals [n, 2] px of disparity and y-parallax ``before`` and ``after``.

    ``at`` [n, 2] px in the left image of ``size`` (cols, rows), over which a trend is a plane.
    """
    return {
        word: {
            name: _spread_of(values[:, k], at, size)
            for k, name in enumerate(("disparity", "y_parallax"))
        }
        for word, values in (("before", before), ("after", after))
    }


def _spread_of(values: Floats, at: Floats, size: tuple[int, int]) -> dict[str, float]:
    median, nmad = median_and_nmad(values)
    middle, half = np.array(size) / 2, max(size) / 2
    design = np.column_stack([(at - middle) / half, np.ones(len(values))])
    plane = np.linalg.lstsq(design, values, rcond=None)[0]
    figures = {
        "median": median,
        "nmad": nmad,
        "rms": float(np.sqrt(np.mean(values**2))),
        "trend_rms": float(np.sqrt(np.mean((design @ plane) ** 2))),
        "trend_over_half_the_image_col": float(plane[0]),
        "trend_over_half_the_image_row": float(plane[1]),
    }
    return {name: round(value, 4) for name, value in figures.items()}


def write_equations(path: str | Path, ties: PairEquations | None, reason: str) -> None:
    """Write the equations as JSON; without any, the ``reason`` why there are none."""
    values: dict[str, Any] = {"what": "equations of tie points of a pair", "meaning": MEANING}
    values["reason"] = reason if ties is None else ""
    if ties is not None:
        values |= {
            "places": ties.places,
            "common_px": ties.common_px,
            "start": ties.start.tolist(),
            "linearised_at": ties.linearised_at.tolist(),
            **{name: array.tolist() for name, array in vars(ties.equations).items()},
            "in_plan": [
                {name: array.tolist() for name, array in vars(seen).items()}
                for seen in ties.in_plan
            ],
        }
    with atomic_file(path) as scratch:
        scratch.write_text(re.sub(r"\n {2,}", " ", sealed(values)), encoding="utf-8")


def read_equations(path: str | Path) -> tuple[PairEquations | None, str]:
    """What :func:`write_equations` was given. Raises InputError if the file is damaged."""
    return read_record(path, _from_dict, what="equations of tie points", stage="refine")


def _from_dict(values: dict[str, Any]) -> tuple[PairEquations | None, str]:
    if "design" not in values:
        return None, values["reason"]
    names = ("design", "observed", "own", "site", "at", "there")
    equations = Equations(*(np.array(values[name]) for name in names))
    about = (np.array(values[name]) for name in ("start", "linearised_at"))
    in_plan = tuple(
        PlanObservation(**{name: np.array(rows) for name, rows in seen.items()})
        for seen in values["in_plan"]
    )
    return PairEquations(equations, *about, values["places"], values["common_px"], in_plan), ""


@dataclass(frozen=True, eq=False)
class SiteLines:
    """``corrections`` by number of the images that have one; ``covariance`` [k, 4, 4] px² by scene,
    see :class:`.line_fit.LineFit`."""

    corrections: Mapping[int, LineCorrection]
    covariance: Mapping[str, Floats]

    def effect(self, design: Floats, lines: Floats, images: tuple[int, int]) -> Floats | float:
        """[n, 2] px: what the corrections of a pair's ``images`` change, along and across.

        ``design`` [n, 2, 12] of the affines, ``lines`` [n, 2] px.
        """
        total: Floats | float = 0.0
        for k, image in enumerate(images):
            if image in self.corrections:
                shift = self.corrections[image].at(lines[:, k])
                for axis in (0, 1):
                    total = total + design[:, :, 6 * k + 2 + 3 * axis] * shift[axis, :, None]
        return total


@dataclass(frozen=True)
class ScenePair:
    """A scene and the names of its images, its refined alignment, equations and control points."""

    scene: str
    left: str
    right: str
    alignment: Path
    equations: Path
    gcps: Path | None = None

    @property
    def names(self) -> tuple[str, str]:
        """Of both images."""
        return self.left, self.right


def rpc_alone(fit: ViewFit) -> ViewFit:
    """A fit that corrects nothing, with the parameters of the image alone."""
    return over_the_image(replace(fit, affine=np.eye(2, 3), gcps=()))


def read_site(path: str | Path) -> dict[str, Any]:
    """What :func:`.site_adjustment.adjust_site` found.

    Raises InputError if it is damaged or something else.
    """

    def checked(values: dict[str, Any]) -> dict[str, Any]:
        return values | {name: values[name] for name in ("images", "pairs", "covariance")}

    return read_record(path, checked, what="adjusted images", stage="adjust")


def covariance_of(site: Mapping[str, Any], names: Sequence[str]) -> Floats:
    """[6 n, 6 n] px² of the parameters of some images of an adjusted site."""
    order = site["covariance"]["images"]
    index = np.concatenate([6 * order.index(name) + np.arange(6) for name in names])
    return np.array(site["covariance"]["values"])[np.ix_(index, index)]


def pair_alignment(site: Mapping[str, Any], scene: ScenePair) -> dict[str, Any]:
    """The record of :class:`.alignment.Alignment` of a pair by its images' adjusted corrections,
    JSON-ready.

    ``site``: what :func:`.site_adjustment.adjust_site` found, or an earlier one that has both
    images. Of a pair whose image is refused it has the sentence ``refused`` alone, which
    :meth:`.alignment.Alignment.read` raises.
    """
    figures = [site["images"][name] for name in scene.names]
    for name, image in zip(scene.names, figures):
        if image["refused"]:
            return {"refused": f"scene {scene.scene}: image {name}: {image['refused']}"}
    base = Alignment.read(scene.alignment)
    covariance = covariance_of(site, scene.names)
    fits, sensors, warnings = [], [], list(base.warnings)
    for k, (name, image, fit, sensor) in enumerate(
        zip(scene.names, figures, base.fits, (base.left, base.right))
    ):
        own = slice(6 * k, 6 * k + 6)
        start = rpc_alone(fit)
        affine = start.moved(np.array(image["parameters"]))
        gcps = tuple(gcp_of(row) for row in image["gcps"]["points"])
        fits.append(
            replace(
                start,
                affine=affine,
                gcps=gcps,
                sigma0=site["gcp_sigma_px"] if gcps else np.nan,
                redundancy=2 * sum(g.used for g in gcps),
                covariance=covariance[own, own],
            )
        )
        sensors.append(SensorModel(sensor.rpc, affine, read_correction(image)))
        warnings += [f"image {name}: {text}" for text in image["doubts"]]
    of_pair = site["pairs"].get(scene.scene, {})
    lines = of_pair.get("lines_covariance")
    return replace(
        base,
        left=sensors[0],
        right=sensors[1],
        left_fit=fits[0],
        right_fit=fits[1],
        cross_covariance=covariance[:6, 6:],
        lines_covariance=None if lines is None else np.array(lines),
        shared_px=of_pair.get("shared_px", 0.0),
        warnings=tuple(warnings),
        refinement=_refinement(site, scene) | {"remark": base.refinement.get("remark", "")},
    ).to_dict()


def _refinement(site: Mapping[str, Any], scene: ScenePair) -> dict[str, Any]:
    """The record of the refinement: the pair's tie points before and after the adjustment."""
    record = {"applied": True, "reason": ""}
    ties, reason = read_equations(scene.equations)
    if ties is None:
        return record | {"tie_points": 0, "without_own_tie_points": reason}
    equations = ties.equations
    used = site["pairs"].get(scene.scene, {}).get("used")  # none of a pair that came later
    figures = [site["images"][name] for name in scene.names]
    images = [np.array(of["parameters"]) for of in figures]
    corrections = {k: one for k, of in enumerate(figures) if (one := read_correction(of))}
    by_line = SiteLines(corrections, {}).effect(equations.design, equations.lines, (0, 1))
    size = tuple(site["images"][scene.left]["size"])
    before = equations.about(ties.start).observed
    after = equations.about(np.concatenate(images)).observed - by_line
    return record | {
        "tie_points": len(equations.own),
        "used": used,
        "sites": int(np.unique(equations.site).size),
        **spreads_of(before, after, equations.at, size),
        "meaning": "px of the epipolar grid at the tie points: disparity of LiDAR minus that of "
        "the images, and y-parallax; before: by control points or RPCs, after: by the adjustment "
        "of all images of the site",
    }
