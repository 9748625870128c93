"""Two views of a textured hill with known RPCs, and alignments that are off by what is planted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereotruth.align.alignment import Alignment, ViewFit
from stereotruth.sensor.rpc import SensorModel

from .cameras import BACKWARD, FORWARD, HEIGHT, camera

SIZE = (660, 610)  # cols, rows of both images
TRUE = (camera(BACKWARD, size=SIZE), camera(FORWARD, angle=2.0, gsd=0.8, size=SIZE))


def surface(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return HEIGHT + 9.0 * np.sin(east / 80.0) + 7.0 * np.cos(north / 60.0)


def start(left: np.ndarray, right: np.ndarray, sigma: float, model: str = "affine") -> Alignment:
    """The true pair with affine errors [2, 3] for ((u, v, 1) of the frame's half), in px.

    ``sigma`` px: standard deviation of every one of its parameters.
    """
    fits, sensors = [], []
    scale = max(SIZE) / 2
    for name, true, error in zip(("left", "right"), TRUE, (left, right)):
        fit = ViewFit(
            view=name,
            image=f"{name}.tif",
            size=SIZE,
            affine=np.array(true.affine),
            gcps=(),
            sigma0=float("nan"),
            redundancy=0,
            origin=((SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2),
            scale=scale,
            covariance=np.eye(6) * sigma**2,
        )
        fits.append(replace(fit, affine=fit.moved(np.asarray(error).ravel())))
        sensors.append(SensorModel(true.rpc, fits[-1].affine))
    return Alignment("S-1", model, *sensors, *fits, HEIGHT, (), {"inputs": {}})


NONE = np.zeros((2, 3))
