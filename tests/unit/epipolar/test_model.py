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


def evaluate_by_hand(image: dict, col: float, row: float) -> tuple[float, float]:
    """(x, y) from the JSON alone, by the words of its formula."""
    n, box = image["n"], image["spline_domain"]
    s = (col - box["col_min"]) / (box["col_max"] - box["col_min"]) * (n - 3)
    t = (row - box["row_min"]) / (box["row_max"] - box["row_min"]) * (n - 3)

    def spline(c, s: float, t: float) -> float:
        if c is None:
            return 0.0

        def weights(f: float) -> list[float]:
            return [
                (1 - f) ** 3 / 6,
                (3 * f**3 - 6 * f**2 + 4) / 6,
                (-3 * f**3 + 3 * f**2 + 3 * f + 1) / 6,
                f**3 / 6,
            ]

        i0, j0 = min(int(np.floor(s)), n - 4), min(int(np.floor(t)), n - 4)
        w, v = weights(s - i0), weights(t - j0)
        return sum(v[b] * w[a] * c[j0 + b][i0 + a] for a in range(4) for b in range(4))

    result = []
    for name in ("x", "y"):
        c = image[f"{name}_spline"]
        near_s, near_t = min(max(s, 0), n - 3), min(max(t, 0), n - 3)
        value = spline(c, near_s, near_t)
        e = 1e-5
        if near_s != s:
            inner = near_s - e if near_s > 0 else near_s + e
            value += (
                (spline(c, near_s, near_t) - spline(c, inner, near_t))
                / (near_s - inner)
                * (s - near_s)
            )
        if near_t != t:
            inner = near_t - e if near_t > 0 else near_t + e
            value += (
                (spline(c, near_s, near_t) - spline(c, near_s, inner))
                / (near_t - inner)
                * (t - near_t)
            )
        a = image[f"{name}_affine"]
        result.append(a[0] * col + a[1] * row + a[2] + value)
    return result[0], result[1]


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
    far = -9000.0, 20000.0  # continued linearly beyond the domain
    got = evaluate_by_hand(stored["right_to_epipolar"], *far)
    assert np.allclose(got, curved.right_to_epipolar(*far), atol=1e-2)
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


def plain_projection(sensor: dict, lon, lat, height) -> tuple[np.ndarray, np.ndarray]:
    """(col, row) by RPC00B as NGA STDI-0002 writes it, from the JSON alone."""
    rpc = sensor["rpc"]
    x = (lon - rpc["long_off"]) / rpc["long_scale"]
    y = (lat - rpc["lat_off"]) / rpc["lat_scale"]
    z = (height - rpc["height_off"]) / rpc["height_scale"]
    terms = [1, x, y, z, x * y, x * z, y * z, x**2, y**2, z**2, x * y * z, x**3, x * y**2]
    terms += [x * z**2, x**2 * y, y**3, y * z**2, x**2 * z, y**2 * z, z**3]

    def ratio(name: str) -> np.ndarray:
        sums = [
            sum(c * term for c, term in zip(rpc[f"{name}_{part}_coeff"], terms))
            for part in ("num", "den")
        ]
        return sums[0] / sums[1] * rpc[f"{name}_scale"] + rpc[f"{name}_off"]

    image = np.stack([ratio("samp"), ratio("line"), np.ones_like(lon)])
    return tuple(np.array(sensor["affine"]) @ image)


def test_ground_to_epipolar_is_the_plain_formula(curved: EpipolarModel) -> None:
    """Far and near points in any order: blocks within a cell of the spline, across, and outside."""
    stored = json.loads(json.dumps(curved.to_dict()))
    together, apart = ground(1000, seed=1), ground(1000, seed=2)
    together[:2] = [[LON], [LAT]] + (together[:2] - [[LON], [LAT]]) * 0.01
    apart[:2] = [[LON], [LAT]] + (apart[:2] - [[LON], [LAT]]) * 4.0
    points = np.hstack([together, apart])
    got = curved.ground_to_epipolar(*points)
    worst = 0.0
    for k, side in enumerate(("left", "right")):
        col, row = plain_projection(stored[f"{side}_sensor"], *points)
        domain = stored[f"{side}_to_epipolar"]["spline_domain"]
        inside = (col > domain["col_min"]) & (col < domain["col_max"])
        inside &= (row > domain["row_min"]) & (row < domain["row_max"])
        assert inside[:1000].all() and not inside[1000:].all()
        expected = [
            evaluate_by_hand(stored[f"{side}_to_epipolar"], *place)
            for place in zip(col[inside], row[inside])
        ]
        worst = max(worst, np.abs(got[2 * k : 2 * k + 2, inside] - np.transpose(expected)).max())
    assert worst < 1e-4  # measured: 2e-12


def test_a_point_comes_out_the_same_in_any_company(curved: EpipolarModel) -> None:
    points = ground(1500) * [[1], [1], [3]]
    whole = curved.ground_to_epipolar(*points)
    order = np.argsort(points[0])
    assert np.array_equal(curved.ground_to_epipolar(*points[:, order]), whole[:, order])
    for k in range(0, 1500, 97):
        assert np.array_equal(curved.ground_to_epipolar(*points[:, k]), whole[:, k : k + 1])
