"""How bright crowns and shadows are, against what the city's spec says."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from stereocities.cities import ViewSpec
from stereocities.render import _shade_rows, prepare
from stereocities.surfaces import direction_of_sun

from ...synthetic.small_cities import GROUND, ONE_BOX
from ...synthetic.wooded_cities import shown_by


def test_shadows_of_a_view_fall_away_from_its_own_sun() -> None:
    """The shadow of one box of 50 m by 40° of elevation: its length and direction."""
    views = {"left": (200.0, 40.0), "right": (140.0, 40.0)}
    city = replace(ONE_BOX, **{view: ViewSpec(sun_deg=sun) for view, sun in views.items()})
    x, y, _, _, height = city.single_box
    for view, (azimuth, elevation) in views.items():
        scene = city.scenes[0]
        camera = getattr(prepare(city, scene), view)
        assert camera.surfaces.sun == pytest.approx(direction_of_sun(azimuth, elevation))
        half = np.empty((2 * camera.rows, 2 * (camera.cols + 4)), np.float32)
        _shade_rows(camera.surfaces, camera.horizon, camera.shown, camera.cam, 0.0, half)
        shown = shown_by(city, view, 1.0)
        at = np.rint(np.column_stack([shown["row"], shown["col"]])).astype(int)
        bright = half[2 * at[:, 0], 2 * at[:, 1] + 4]
        frame = prepare(city, scene).frame
        xyz = frame.from_geodetic(np.column_stack([shown[n] for n in ("lon", "lat", "height")]))
        long = height / math.tan(math.radians(elevation))
        away = math.radians(azimuth + 180.0)
        end = np.array([x, y]) + 0.9 * long * np.array([math.sin(away), math.cos(away)])
        beside = np.array([x, y]) - 0.9 * long * np.array([math.sin(away), math.cos(away)])
        ground = shown["surface"] == GROUND
        dark = np.hypot(*(xyz[:, :2] - end).T) < 4
        lit = np.hypot(*(xyz[:, :2] - beside).T) < 4
        assert (ground & dark).sum() > 20 and (ground & lit).sum() > 20
        assert np.median(bright[ground & dark]) < 0.5 * np.median(bright[ground & lit])
