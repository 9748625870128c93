"""A pair of a site by the adjusted corrections of its images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.products.files import atomic_file, read_record, sealed
from ..sensor.rpc import SensorModel, read_correction
from .aligned_pair import Alignment, GcpResidual, ViewFit, over_the_image
from .equations import spread_of
from .site_line_corrections import SiteLines
from .tie_equations import read_equations


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
    """What :func:`write_site` wrote. Raises InputError if it is damaged or something else."""

    def checked(values: dict[str, Any]) -> dict[str, Any]:
        return values | {name: values[name] for name in ("images", "pairs", "covariance")}

    return read_record(path, checked, what="adjusted images", stage="adjust")


def write_site(values: Mapping[str, Any], path: str | Path) -> None:
    """Write what :func:`.site_adjustment.adjust_site` found, as JSON."""
    with atomic_file(path) as scratch:
        scratch.write_text(sealed(values), encoding="utf-8")


def pair_alignment(site: Mapping[str, Any], scene: ScenePair) -> dict[str, Any]:
    """alignment.json of a pair by its images' adjusted corrections, JSON-ready.

    ``site``: what :func:`.site_adjustment.adjust_site` found, or an earlier one that has both
    images.
    Of a pair whose image is refused it has the sentence ``refused`` alone, which
    :meth:`.Alignment.load` raises.
    """
    figures = [site["images"][name] for name in scene.names]
    for name, image in zip(scene.names, figures):
        if image["refused"]:
            return {"refused": f"scene {scene.scene}: image {name}: {image['refused']}"}
    base = Alignment.load(scene.alignment)
    order = site["covariance"]["images"]
    index = np.concatenate([6 * order.index(name) + np.arange(6) for name in scene.names])
    covariance = np.array(site["covariance"]["values"])[np.ix_(index, index)]
    fits, sensors, warnings = [], [], list(base.warnings)
    for k, (name, image, fit, sensor) in enumerate(
        zip(scene.names, figures, base.fits, (base.left, base.right))
    ):
        own = slice(6 * k, 6 * k + 6)
        start = rpc_alone(fit)
        affine = start.moved(np.array(image["parameters"]))
        gcps = tuple(
            GcpResidual(**{k: tuple(v) if isinstance(v, list) else v for k, v in row.items()})
            for row in image["gcps"]["points"]
        )
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
    spreads = {}
    for word, parameters, lines in (
        ("before", ties.start, 0.0),
        ("after", np.concatenate(images), by_line),
    ):
        values = equations.observed - equations.design @ parameters - lines
        spreads[word] = {
            name: spread_of(values[:, k], equations.at, size)
            for k, name in enumerate(("disparity", "y_parallax"))
        }
    return record | {
        "tie_points": len(equations.own),
        "used": used,
        "sites": int(np.unique(equations.site).size),
        **spreads,
        "meaning": "px of the epipolar grid at the tie points: disparity of LiDAR minus that of "
        "the images, and y-parallax; before: by control points or RPCs, after: by the adjustment "
        "of all images of the site",
    }
