"""What the covariance of the alignment means for labels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.alignment.label_uncertainty import label_sigma
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.rpc import SensorModel

from ...synthetic.cameras import HEIGHT
from ...synthetic.textured_pair import NONE, SIZE, start


def test_label_sigma_is_the_spread_of_labels():
    """Against labels of alignments whose parameters are drawn from the covariance."""
    planted = start(NONE, NONE, 0.1)
    rng = np.random.default_rng(0)
    root = rng.normal(0, 0.05, (12, 12))
    covariance = root @ root.T
    fits = [
        replace(fit, covariance=covariance[k : k + 6, k : k + 6])
        for fit, k in zip(planted.fits, (0, 6))
    ]
    alignment = replace(
        planted, left_fit=fits[0], right_fit=fits[1], cross_covariance=covariance[:6, 6:]
    )
    model = fit_epipolar(alignment.left, alignment.right, SIZE, SIZE, HEIGHT)
    x, y = np.array([100.0, 350.0, 600.0]), np.array([120.0, 500.0, 300.0])
    ground = *model.epipolar_to_ground(x, y, HEIGHT), HEIGHT
    labels = []
    for _ in range(3000):
        p = root @ rng.normal(0, 1, 12)
        left, right = (
            SensorModel(s.rpc, fit.moved(part))
            for s, fit, part in zip(
                (alignment.left, alignment.right), alignment.fits, (p[:6], p[6:])
            )
        )
        x_left, y_left = model.left_to_epipolar(*left.project(*ground))
        x_right, _ = model.right_to_epipolar(*right.project(*ground))
        labels.append([x_left - x_right, x_left, y_left])
    for sigma, spread in zip(label_sigma(alignment, model, x, y), np.std(labels, axis=0)):
        assert sigma == pytest.approx(spread, rel=0.06)
