"""What a pixel's own points add to the facets: errors with and without them, on exact truth.

    python -m tests.synthetic.own_points

A plane with a box on it, its points with noise, labelled at several densities: once as by the
recipe surface, once with the label of the facet at every pixel.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.status import Status
from stereotruth.labels import recipe
from stereotruth.labels.pixel_labels import facet_labels

from .box_scene import Scene

NOISES_M, DENSITIES = (0.03, 0.08), (12.0, 6.0, 1.0)
WRONG_SURFACE_PX = 1.0  # labels that are off by more are no matter of noise


def of_facets(seen, own, *rest):
    """Labels of which no pixel's own points are the surer ones."""
    return facet_labels(seen, replace(own, surer=np.zeros_like(own.surer)), *rest)


def row(scene: Scene, name: str, how) -> str:
    """Errors of the labels by facets and own points, and the share within σ and 2 σ."""
    inputs = scene.inputs(LabelSettings())
    rows, cols = scene.model.shape
    with patch.object(recipe, "facet_labels", how):
        layers, _ = recipe.label_window(inputs, slice(0, rows), slice(0, cols))
    labelled = np.isin(layers["status"], (Status.LABELLED, Status.LABELLED_BETWEEN))
    error = np.abs(layers["disparity"] - scene.truth)[labelled]
    sigma = layers["uncertainty"][labelled][error < WRONG_SURFACE_PX]
    error = error[error < WRONG_SURFACE_PX]
    within = [100.0 * (error < k * sigma).mean() for k in (1, 2)]
    rms = np.sqrt([(error**2).mean(), (sigma**2).mean()])
    return f"{name:8s} {rms[0]:.4f}  {rms[1]:.4f}  {within[0]:.0f}  {within[1]:.0f}"


def main() -> None:
    print("noise, m  points/m²  labels of  rms error, px  rms σ, px  within σ, %  2 σ, %")
    for noise in NOISES_M:
        for density in DENSITIES:
            with tempfile.TemporaryDirectory() as folder:
                scene = Scene(Path(folder), box=True, noise=noise, spacing=density**-0.5)
                for name, how in (("both", facet_labels), ("facets", of_facets)):
                    print(f"{noise:g}  {density:g}  {row(scene, name, how)}", flush=True)


if __name__ == "__main__":
    main()
