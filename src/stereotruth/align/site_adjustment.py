"""The adjustment of a site's images: figures by image and pair."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from ..core.errors import InputError
from ..core.numerics.arrays import Floats
from ..lidar.frames import DEFAULT_EPOCH, Epoch
from ..sensor.rpc import RPC, LineCorrection, SensorModel, of_record, read_correction
from .align import LARGE_SHIFT
from .alignment import Alignment, ViewFit
from .control_points import NoPoints, read_gcps
from .doubts import HEAVY, image_doubts
from .records import ScenePair, covariance_of, read_equations, read_site, rpc_alone
from .shared_errors import plan_slopes
from .site_fit import (
    LEAST_POINTS,
    FixedImages,
    ImageToFit,
    PairFit,
    PairToFit,
    PointsOfImage,
    SiteFit,
    fit_site,
)

log = logging.getLogger("stereotruth")


WHAT = "corrections of the RPCs of a site's images, adjusted together"
UNITS = {
    "parameters": "px, (a_u, a_v, a_1, b_u, b_v, b_1): the correction of the RPC's (col, row) is "
    "(a_u u + a_v v + a_1, b_u u + b_v v + b_1), (u, v) = ((col, row)_rpc - origin) / scale",
    "correction": "px: col and row in the middle of the image, largest over the image",
    "sigma": "px of a coordinate, rms over the image, of its place against the ground",
    "gcps": "px: rms length of measured minus projected by the RPC alone, after the correction, "
    "and by the adjustment without the point",
    "ties, pairs": "px of the epipolar grid at the tie points used: disparity of LiDAR minus that "
    "of the images, and y-parallax, by the adjusted corrections",
    "matched": "share of the places compared that became tie points without a blunder",
    "misfit": "of a pair against all, in the standard deviations that its tie points show",
    "weight": "0 to 1, of a pair in the adjustment",
    "covariance": "px^2 of all parameters, images in ascending order of their names",
}


def _points(rows: Mapping[tuple[Any, ...], None], rpc: RPC, size: tuple[int, int]) -> PointsOfImage:
    """Control points of an image in ascending order, without those that lie elsewhere."""
    ordered = sorted(rows)
    values = np.array([row[1:] for row in ordered], dtype=float).reshape(-1, 5)
    predicted = np.stack(rpc.project(*values[:, :3].T), axis=1)
    near = ((predicted > -LARGE_SHIFT) & (predicted < np.array(size) + LARGE_SHIFT)).all(axis=1)
    return PointsOfImage(
        tuple(row[0] for row, here in zip(ordered, near) if here),
        *values[near, :3].T,
        values[near, 3:],
        predicted[near],
    )


def _images(
    pairs: Sequence[ScenePair], alignments: Mapping[str, Alignment], epoch: Epoch
) -> dict[str, ImageToFit]:
    """All images by name, with the control points that any pair's file has of them."""
    starts: dict[str, tuple[ViewFit, RPC, float]] = {}
    rows: dict[str, dict[tuple[Any, ...], None]] = {}
    for pair in pairs:
        alignment = alignments[pair.scene]
        for name, fit, sensor in zip(pair.names, alignment.fits, (alignment.left, alignment.right)):
            starts.setdefault(name, (rpc_alone(fit), sensor.rpc, alignment.reference_height))
            rows.setdefault(name, {})
        if pair.gcps is None:
            continue
        try:
            points = read_gcps(pair.gcps, pair.scene, pair.names, epoch)
        except NoPoints:
            continue
        for name, at in zip(pair.names, (points.left, points.right)):
            for k in np.flatnonzero(np.isfinite(at[:, 0])):
                ground = float(points.lon[k]), float(points.lat[k]), float(points.height[k])
                rows[name][(points.ids[k], *ground, *at[k].tolist())] = None
    images = {}
    for name, (fit, rpc, height) in starts.items():
        lon, lat = map(float, rpc.localize(*((n - 1) / 2 for n in fit.size), height))
        px_per_m = plan_slopes(SensorModel(rpc), lon, lat, height)
        images[name] = ImageToFit(name, fit, _points(rows[name], rpc, fit.size), px_per_m)
    return images


def read_fixed(files: Mapping[str, str | Path]) -> FixedImages | None:
    """Corrections of images by name from files of :func:`adjust_site` that were put aside.

    Raises InputError for a file without the image.
    """
    if not files:
        return None
    parameters: dict[str, Floats] = {}
    by_line: dict[str, LineCorrection] = {}
    blocks = []
    for file in sorted({Path(path) for path in files.values()}):
        names = sorted(name for name, path in files.items() if Path(path) == file)
        values = read_site(file)
        for name in names:
            if name not in values["images"]:
                raise InputError(
                    f"alignment.fixed: {name}: the file has no image of this name",
                    file=file,
                    remedy="name a copy of results/adjust/<city>.json that has it",
                )
            parameters[name] = np.array(values["images"][name]["parameters"])
            if (lines := read_correction(values["images"][name])) is not None:
                by_line[name] = lines
        blocks.append(covariance_of(values, names))
    return FixedImages(parameters, block_diag(*blocks), by_line)


def adjust_site(
    city: str,
    scenes: Sequence[ScenePair],
    *,
    fixed: Mapping[str, str | Path] | None = None,
    strict: bool = False,
    epoch: Epoch = DEFAULT_EPOCH,
    provenance: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Adjust the images of a city's pairs that share images; JSON-ready figures and corrections.

    ``fixed``: files of earlier adjustments by name of an image, whose corrections stay as they are.
    An image that hurts is named in ``doubts``; one that neither tie points nor control points
    place has the sentence in ``refused``. ``strict`` makes doubts errors.

    Raises InputError for unreadable input.
    """
    scenes = sorted(scenes, key=lambda pair: pair.scene)
    alignments = {pair.scene: Alignment.read(pair.alignment) for pair in scenes}
    images = _images(scenes, alignments, epoch)
    pairs = [
        PairToFit(pair.scene, pair.left, pair.right, *read_equations(pair.equations))
        for pair in scenes
    ]
    held = read_fixed({k: v for k, v in (fixed or {}).items() if k in images})
    fit = fit_site(list(images.values()), pairs, held)
    by_pair = {pair.scene: _pair_figures(pair, fit.pairs.get(pair.scene)) for pair in pairs}
    by_image = {
        name: _image_figures(images[name], pairs, fit, held is not None and name in held.parameters)
        for name in fit.names
    }
    for name, doubts in image_doubts(by_image, by_pair).items():
        by_image[name]["doubts"] = doubts
        for text in doubts:
            log.warning("warning: image %s: %s", name, text)
    hurting = [name for name in fit.names if by_image[name]["doubts"]]
    if strict and hurting:
        raise InputError(
            f"image {hurting[0]} of {city}: {by_image[hurting[0]]['doubts'][0]}",
            remedy="remove the image's pairs, correct its RPC or control points, or set strict to "
            "false",
        )
    return {
        "what": WHAT,
        "units": UNITS,
        "city": city,
        "images": by_image,
        "pairs": by_pair,
        "gcp_sigma_px": round(fit.point_sigma, 4),
        "scatter_of_pairs": round(fit.scatter, 4),
        "covariance": {"images": list(fit.names), "values": fit.covariance.tolist()},
        "provenance": dict(provenance or {}),
    }


def residual_figures(values: Floats) -> dict[str, Any]:
    """Medians and root mean squares of residuals [n, 2] px, along and across the rows."""
    if not len(values):
        return {}
    return {
        name: {
            "median": round(float(np.median(values[:, k])), 4),
            "rms": round(float(np.sqrt(np.mean(values[:, k] ** 2))), 4),
        }
        for k, name in enumerate(("disparity", "y_parallax"))
    }


def _pair_figures(pair: PairToFit, fit: PairFit | None) -> dict[str, Any]:
    figures: dict[str, Any] = {"left": pair.left, "right": pair.right, "reason": pair.reason}
    if pair.ties is None or fit is None:
        return figures | {"places": 0, "tie_points": 0, "used": 0, "matched": 0.0}
    used = int(fit.used.sum())
    misfits: dict[str, Any] = {"shared_px": round(fit.shared_px, 6)} if fit.shared_px else {}
    if fit.lines_covariance is not None:
        misfits["lines_covariance"] = fit.lines_covariance.tolist()
    return figures | {
        "places": pair.ties.places,
        "tie_points": len(fit.used),
        "used": used,
        "matched": round(used / pair.ties.places, 3),
        "misfit": round(fit.misfit, 3),
        "weight": round(fit.weight, 3),
        **misfits,
        **residual_figures(fit.residuals[fit.used]),
    }


def _image_figures(
    image: ImageToFit, pairs: Sequence[PairToFit], fit: SiteFit, is_fixed: bool
) -> dict[str, Any]:
    name, points = image.name, image.points
    parameters, covariance = fit.parameters[name], fit.covariance_of(name)
    used = fit.used[name]
    grid = np.meshgrid(*(np.linspace(0, n - 1, 9) for n in image.start.size))
    nodes = image.start.design(*(axis.ravel() for axis in grid))  # places all over the image
    own = [pair for pair in pairs if name in (pair.left, pair.right)]
    fits = {pair.scene: fit.pairs[pair.scene] for pair in own if pair.scene in fit.pairs}
    residuals = [one.residuals[one.used] for one in fits.values() if one.weight > HEAVY]
    heavy = sum(one.weight > HEAVY for one in fits.values())
    refused = ""
    if not is_fixed and not heavy and used.sum() < LEAST_POINTS:
        reasons = sorted({pair.reason for pair in own if pair.reason})
        refused = f"neither tie points nor control points ({int(used.sum())}) place it: " + (
            "; ".join(reasons) or "its tie points contradict those of all other pairs"
        )

    def rms(pairs: Floats) -> float | None:
        lengths = np.hypot(*pairs[used].T)
        known = lengths[np.isfinite(lengths)]
        return round(float(np.sqrt(np.mean(known**2))), 4) if len(known) else None

    variance = np.einsum("nap,pq,naq->na", nodes, covariance, nodes)
    return {
        "file": image.start.image,
        "size": list(image.start.size),
        "origin": list(image.start.origin),
        "scale": image.start.scale,
        "fixed": is_fixed,
        "parameters": parameters.tolist(),
        "affine": image.start.moved(parameters).tolist(),
        **of_record(fit.by_line.get(name)),
        "correction": {
            "col": round(float(parameters[2]), 4),
            "row": round(float(parameters[5]), 4),
            "largest": round(float(np.hypot(*(nodes @ parameters).T).max()), 4),
        },
        "sigma": round(float(np.sqrt(variance.mean())), 4),
        "gcps": {
            "count": len(points.ids),
            "used": int(used.sum()),
            "left_out": [points.ids[k] for k in np.flatnonzero(~used)],
            "before": rms(points.measured - points.predicted),
            "after": rms(fit.residuals[name]),
            "leave_one_out": rms(fit.leave_one_out[name]),
            "points": _table(points, fit, name),
        },
        "ties": {
            "pairs": len(own),
            "pairs_with_ties": heavy,
            "used": sum(int(one.used.sum()) for one in fits.values()),
            **residual_figures(np.concatenate([np.zeros((0, 2)), *residuals])),
        },
        "refused": refused,
        "doubts": [],
    }


def _table(points: PointsOfImage, fit: SiteFit, name: str) -> list[dict[str, Any]]:
    """The control points of an image with their residuals, px, JSON-ready."""
    rows = zip(fit.residuals[name], fit.leave_one_out[name], fit.used[name])
    return [
        {
            "id": points.ids[k],
            "lon": float(points.lon[k]),
            "lat": float(points.lat[k]),
            "height": float(points.height[k]),
            "measured": points.measured[k].tolist(),
            "predicted": points.predicted[k].tolist(),
            "before": (points.measured[k] - points.predicted[k]).tolist(),
            "after": after.tolist(),
            "leave_one_out": one_out.tolist(),
            "used": bool(used),
            "reason": "" if used else f"{np.hypot(*after):.1f} px off the site's adjustment",
        }
        for k, (after, one_out, used) in enumerate(rows)
    ]
