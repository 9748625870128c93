"""Crowns of a twin: ellipsoids whose tops are the points of leaves that were hit first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from .twin_points import Points
from .twin_roofs import NEIGHBOURS, local_planes, thinned

CLASSES = (3, 4, 5)
ROOFS = (6, 17)  # 17: bridge decks
OBJECT_M = 1.5  # above the ground: less is none
ROUGH_M = 0.2  # rms of neighbours off their plane: more is no roof
SEVERAL = 0.6  # share of the neighbours whose pulses had more returns: more is no roof
SPACING_M = 1.2  # between tops
TREE_M = 6.0  # between trees
RADIUS_M = (1.0, 1.35)
DEPTH_M = 5.0  # of a crown below its top at most
BOTTOM = 0.3  # of a top's height above the ground
LEAF = 0.15  # reflectance of a leaf of style 1
POROSITY = 0.3  # share of the pulses that the top of a crown lets pass


def is_leaf(points: Points) -> np.ndarray:
    """Which points above the ground are leaves, bool[n]; the others are roofs.

    By their class; where the file has no classes of roofs or of plants, by how rough the surface is
    around them and how many pulses went through it, as most of their neighbours say.
    """
    if points.has_class(*CLASSES) and points.has_class(*ROOFS):
        return np.isin(points.label, CLASSES)
    if len(points.xyz) <= NEIGHBOURS:
        return np.zeros(len(points.xyz), bool)
    near = cKDTree(points.xyz).query(points.xyz, NEIGHBOURS)[1]
    _, rough = local_planes(points.xyz, near)
    several = np.mean(~points.single[near], axis=1)
    leaf = (rough > ROUGH_M) | (several > SEVERAL)
    for _ in range(3):
        leaf = np.mean(leaf[near], axis=1) > 0.5
    return leaf


class Crowns(NamedTuple):
    """``ellipsoids`` float64[n, 6] and their ``style`` [n, 2], as in :class:`.surfaces.Surfaces`;
    ``tree`` [n]: number of the tree that one is part of; ``foot`` [n]: z of the ground below."""

    ellipsoids: np.ndarray
    style: np.ndarray
    tree: np.ndarray
    foot: np.ndarray


def crowns_of(points: Points, ground: np.ndarray, rng: np.random.Generator) -> Crowns:
    """The crowns whose leaves are ``points``; ``ground`` [n]: z of the ground below each of them.

    A tree is what lies nearest to the highest top of TREE_M².
    """
    first = np.flatnonzero(points.first)
    top = first[thinned(points.xyz[first], SPACING_M)]
    xyz, foot = points.xyz[top], ground[top]
    tall = xyz[:, 2] - foot
    bottom = np.maximum(foot + BOTTOM * tall, xyz[:, 2] - DEPTH_M)
    half = np.maximum((xyz[:, 2] - bottom) / 2, 0.4)
    radius = rng.uniform(*RADIUS_M, len(top))
    crowns = np.column_stack([xyz[:, :2], xyz[:, 2] - half, radius, half, (radius / half) ** 2])
    light = np.full(len(top), 1.0) if points.tint is None else points.tint[top] / LEAF
    style = np.column_stack([np.clip(light, 0.4, 1.6), np.full(len(top), POROSITY)])
    tree = np.zeros(len(top), np.int64)
    if len(top):
        tree = cKDTree(xyz[thinned(xyz, TREE_M), :2]).query(xyz[:, :2])[1]
    return Crowns(crowns, style, tree, foot)
