"""The epipolar model: its maps, their inverses, and what its JSON says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.epipolar.model import EpipolarModel

from ...synthetic.cameras import BACKWARD, FORWARD, LAT, LON, camera
from ...synthetic.wide_pair import fit, ground


def evaluate_by_hand(image: dict, col: float, row: float) -> list[float]:
    """[x, y] from the JSON alone, by the words of its formula, inside the domain."""
    n, box, places = image["n"], image["spline_domain"], []
    for at, axis in ((col, "col"), (row, "row")):
        s = (at - box[f"{axis}_min"]) / (box[f"{axis}_max"] - box[f"{axis}_min"]) * (n - 3)
        first = min(int(np.floor(s)), n - 4)
        f = s - first
        w = (1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3
        places.append((first, np.array(w) / 6))
    (i, across), (j, down) = places
    found = []
    for name in ("x", "y"):
        a, spline = image[f"{name}_affine"], image[f"{name}_spline"]
        patch = np.zeros((4, 4)) if spline is None else np.array(spline)[j : j + 4, i : i + 4]
        found.append(a[0] * col + a[1] * row + a[2] + down @ patch @ across)
    return found


@pytest.fixture(scope="module")
def curved() -> EpipolarModel:
    return fit(
        camera(BACKWARD, angle=90.0, bend=80.0),
        camera(FORWARD, angle=92.0, gsd=0.8, bend=-50.0),
    )


def test_the_json_is_enough(curved: EpipolarModel, tmp_path: Path) -> None:
    curved.save(tmp_path / "epipolar.json")
    stored = json.loads((tmp_path / "epipolar.json").read_text())
    for col, row in ((0.0, 0.0), (3000.3, 1234.5), (5999.0, 4999.0)):
        for side in ("left", "right"):
            expected = getattr(curved, f"{side}_to_epipolar")(col, row)
            got = evaluate_by_hand(stored[f"{side}_to_epipolar"], col, row)
            assert np.allclose(got, expected, atol=1e-7)
    way = np.array([-9000.0, 20000.0])  # continued linearly beyond the domain
    beyond = [np.array(curved.right_to_epipolar(*(k * way))) for k in (1.0, 1.1, 1.2)]
    assert np.allclose(beyond[2] - beyond[1], beyond[1] - beyond[0], atol=1e-6)
    again = EpipolarModel.load(tmp_path / "epipolar.json")
    assert np.array_equal(again.ground_to_epipolar(*ground()), curved.ground_to_epipolar(*ground()))
    assert again.shape == curved.shape and again.to_dict() == curved.to_dict()
    assert [p.name for p in tmp_path.iterdir()] == ["epipolar.json"]


def test_a_spoiled_json_is_refused(curved: EpipolarModel, tmp_path: Path) -> None:
    path = tmp_path / "epipolar.json"
    with pytest.raises(InputError, match=r"epipolar\.json"):
        EpipolarModel.load(path)
    path.write_text(json.dumps(curved.to_dict())[:-100])
    with pytest.raises(InputError, match=r"epipolar\.json"):
        EpipolarModel.load(path)
    curved.save(path)
    path.write_text(path.read_text().replace("across", "along"))
    with pytest.raises(InputError, match=r"epipolar\.json"):
        EpipolarModel.load(path)


def test_inverse_maps(curved: EpipolarModel) -> None:
    rng = np.random.default_rng(1)
    # also well outside the images and the splines' domain
    col, row = rng.uniform(-20000, 26000, 2000), rng.uniform(-20000, 25000, 2000)
    for side in ("left", "right"):
        x, y = getattr(curved, f"{side}_to_epipolar")(col, row)
        again = np.array(getattr(curved, f"epipolar_to_{side}")(x, y))
        near = (np.abs(col - 3000) < 4000) & (np.abs(row - 2500) < 4000)
        assert np.abs(again - (col, row))[:, near].max() < 1e-8
        assert np.nanmax(np.abs(again - (col, row))) < 1e-6
    assert np.isnan(curved.epipolar_to_left(np.nan, 3.0)).all()
    assert np.isnan(curved.left_to_epipolar(np.inf, 3.0)).all()


def test_ground_goes_through_the_sensors(curved: EpipolarModel) -> None:
    points = ground(1500)
    x_left, y_left, x_right, y_right = curved.ground_to_epipolar(*points)
    assert np.array_equal(curved.left_to_epipolar(*curved.left.project(*points)), (x_left, y_left))
    assert np.array_equal(
        curved.right_to_epipolar(*curved.right.project(*points)), (x_right, y_right)
    )
    lon, lat = curved.epipolar_to_ground(x_left, y_left, points[2])
    assert np.abs(np.subtract((lon, lat), points[:2])).max() < 1e-11


def test_a_point_comes_out_the_same_in_any_company(curved: EpipolarModel) -> None:
    near = ground(1500)
    near[:2] = [[LON], [LAT]] + (near[:2] - [[LON], [LAT]]) * 0.01  # all in one cell of the splines
    points = np.hstack([near, ground(1500) * [[1], [1], [3]]])
    whole = curved.ground_to_epipolar(*points)
    order = np.argsort(points[0])
    assert np.array_equal(curved.ground_to_epipolar(*points[:, order]), whole[:, order])
    for k in range(0, 1500, 97):
        assert np.array_equal(curved.ground_to_epipolar(*points[:, k]), whole[:, k : k + 1])
