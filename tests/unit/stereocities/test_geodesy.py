"""The local frame."""

from __future__ import annotations

import numpy as np
import pyproj

from stereocities.camera import LocalFrame


def test_local_frame_agrees_with_pyproj() -> None:
    frame = LocalFrame(113.4, 24.2, 36.0)
    xyz = np.random.default_rng(0).uniform(-3000, 3000, (500, 3))
    lonlath = frame.to_geodetic(xyz)
    to_ecef = pyproj.Transformer.from_crs(4979, 4978, always_xy=True)
    np.testing.assert_allclose(
        np.array(to_ecef.transform(*lonlath.T)).T, frame.to_ecef(xyz), atol=1e-7
    )
    np.testing.assert_allclose(frame.from_geodetic(lonlath), xyz, atol=1e-7)
