"""What strips of the LiDAR that disagree mean for labels: of their disparity at a fixed pixel.

A point that is off by o = (east, north, up) lies off in the grid of the labelled view, and its
disparity is off, by e = J o. Images are aligned to all strips together, so that labels of a strip
are off by e less what the alignment takes of it (:func:`_taken`). This is known of each strip, and
its square is part of the labels' variance as an error of the alignment is
(:mod:`.label_uncertainty`), with the variance of the offset itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..core.numerics.geometry import exact_metres_per_degree
from ..epipolar.model import EpipolarModel
from ..lidar.lattice import CELL_BITS, LATTICE_DEG, cell_key
from ..lidar.point_store import SQUARES
from ..lidar.strips import StripOffsets
from .label_uncertainty import _UPPER, STEP, LabelUncertainty

Floats = NDArray[np.float64]

SQUARE_DEG = (1 << CELL_BITS) * LATTICE_DEG / SQUARES
MOVE_M = 10.0  # over which J is a difference


def with_strips(
    uncertainty: LabelUncertainty,
    strips: StripOffsets,
    model: EpipolarModel,
    view: str = "left",
    shared_px: float = 0.0,
) -> LabelUncertainty:
    """The uncertainty of labels with what the offsets of named strips add to it.

    The same if no strip is named, or if none lies in the pair. Of offsets that are taken out of the
    points, their own uncertainty remains. ``shared_px``: standard deviation of disparity, in
    ``uncertainty``, by errors that near tie points share: as much of it as strips explain counts
    once.
    """
    if not strips.named:
        return uncertainty
    rows, cols = (STEP * np.arange(-(-(n - 1) // STEP) + 1) for n in model.shape)
    x, y = (a.astype(np.float64) for a in np.meshgrid(cols, rows))
    ground = _ground(model, x, y, view)
    shares = _shares(strips, *ground)
    known = shares.sum(axis=0) > 0
    if not known.any():
        return uncertainty
    jacobian = _jacobian(model, *ground, view)
    offsets = np.array([strip.offset_m for strip in strips.strips])
    if strips.taken_out:
        offsets = np.zeros_like(offsets)
    covariance = np.array([strip.covariance_m2 for strip in strips.strips])
    effects = np.einsum("rcij,kj->krci", jacobian, offsets)
    together = np.einsum("krc,krci->rci", shares, np.nan_to_num(effects))
    rest = effects - _taken(together, x, y, known)
    found = np.einsum("krc,krci,krcj->rcij", shares, rest, rest)
    explained = float(np.mean(found[known][:, 0, 0]))
    found += np.einsum("krc,rcia,kab,rcjb->rcij", shares, jacobian, covariance, jacobian)
    found[~known] = found[known].mean(axis=0)
    found[..., 0, 0] -= min(shared_px**2, explained)
    nodes = np.moveaxis(found[..., *_UPPER], -1, 0).round(10)
    return replace(uncertainty, nodes=uncertainty.nodes + nodes, step=STEP)


def _taken(effects: Floats, x: Floats, y: Floats, known: NDArray[np.bool_]) -> Floats:
    """What an alignment takes of ``effects`` [rows, cols, 3] at places: the affine function that
    fits those of disparity best, and the mean of those of place.

    Corrections of the images are affine, and level ground tells disparity alone.
    """
    taken = np.broadcast_to(effects[known].mean(axis=0), effects.shape).copy()
    design = np.stack([np.ones_like(x), x / x.max(), y / y.max()], axis=-1)
    found = np.linalg.lstsq(design[known], effects[known][:, 0], rcond=None)[0]
    taken[..., 0] = design @ found
    return taken


def _ground(model: EpipolarModel, x: Floats, y: Floats, view: str) -> tuple[Floats, Floats]:
    """Longitude and latitude (degrees) of places of a view's grid, at the reference height."""
    height = model.reference_height
    if view == "left":
        return model.left.localize(*model.epipolar_to_left(x, y), height)
    return model.right.localize(*model.epipolar_to_right(x, y), height)


def _shares(strips: StripOffsets, lon: Floats, lat: Floats) -> Floats:
    """Share [strips, rows, cols] of each strip in the points around places, 0 without any.

    Of the 3 by 3 squares of 7 m around each: about as far as between the nodes.
    """
    row, col = (np.floor(np.nan_to_num(v) / SQUARE_DEG).astype(np.int64) for v in (lat, lon))
    counts = np.zeros((len(strips.strips), *lon.shape))
    held = strips.shares
    for number in range(len(strips.strips)):
        own = held[held["strip"] == number]
        keys = cell_key(own["row"], own["col"])
        by_key = np.argsort(keys)
        keys, own = keys[by_key], own[by_key]
        if not keys.size:
            continue
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                r, c = row + down, col + right
                key = cell_key(r // SQUARES, c // SQUARES)
                at = np.minimum(np.searchsorted(keys, key), keys.size - 1)
                found = own["points"][at, r % SQUARES, c % SQUARES]
                counts[number] += np.where(keys[at] == key, found, 0)
    total = counts.sum(axis=0)
    return counts / np.where(total > 0, total, 1.0)


def _jacobian(model: EpipolarModel, lon: Floats, lat: Floats, view: str) -> Floats:
    """Change [rows, cols, 3, 3] of disparity, x and y (px) in a view's grid by a metre to the east,
    to the north and up."""
    height = model.reference_height
    per_degree = exact_metres_per_degree(float(np.nanmean(lat)), height)

    def seen(east: float, north: float, up: float) -> Floats:
        at = lon + east / per_degree[0], lat + north / per_degree[1], height + up
        x_left, y_left, x_right, y_right = model.ground_to_epipolar(
            *(np.broadcast_to(v, lon.shape).reshape(-1) for v in at)
        )
        x, y = (x_left, y_left) if view == "left" else (x_right, y_right)
        return np.stack([x_left - x_right, x, y], axis=-1).reshape(*lon.shape, 3)

    steps = MOVE_M * np.eye(3)
    return np.stack([(seen(*s) - seen(*-s)) / (2 * MOVE_M) for s in steps], axis=-1)
