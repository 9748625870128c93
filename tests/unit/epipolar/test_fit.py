"""The epipolar model on cameras whose epipolar geometry is known, and on real RPCs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rpc import RPC, SensorModel
from stereotruth.epipolar.rpc_files import read_rpc
from stereotruth.errors import InputError

SHARED = Path(__file__).parents[3] / "shared"
MARSEILLE = SHARED / "real" / "marseille"
LON, LAT, HEIGHT = 114.3, 30.6, 60.0  # centre of the camera pairs below
METRES = np.array([111320.0 * np.cos(np.radians(LAT)), 110900.0])  # per degree of lon, lat


def camera(
    tilt: tuple[float, float],
    *,
    gsd: float = 0.65,
    angle: float = 0.0,
    size: tuple[int, int] = (6000, 5000),
    half_height: float = 400.0,
    bend: float = 0.0,
) -> SensorModel:
    """A parallel-ray camera as an RPC: image = turn . ((east, -north) + tilt h) / gsd + centre.

    ``tilt``: metres (east, north) that a point moves on the ground plane per metre of height;
    ``angle``: of the image in degrees. ``bend`` adds a quadratic distortion of that many px at the
    edge (as an agile satellite does), which RPC00B holds exactly: the true epipolar curves are
    then parabolas.
    """
    a = np.radians(angle)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    half = 0.55 * gsd * max(size)  # metres from the centre to the edge of the ground box
    scales = half / METRES
    # normalised image coordinates as linear functions of normalised (lon, lat, height)
    image_scale = max(size) / 2
    ground = np.array([[half, 0.0, tilt[0] * half_height], [0.0, -half, -tilt[1] * half_height]])
    linear = turn @ ground / gsd / image_scale
    samp, line = np.zeros(20), np.zeros(20)
    samp[1:4], line[1:4] = linear
    for numerator, (p, q) in ((samp, linear), (line, linear[::-1])):
        # + bend (p q + q² / 2), spread over the terms LP LH PH, L² P² H²
        pairs = ((0, 1), (0, 2), (1, 2))
        for term, (i, j) in zip((4, 5, 6), pairs):
            numerator[term] += bend / image_scale * (p[i] * q[j] + p[j] * q[i] + q[i] * q[j])
        for term, i in zip((7, 8, 9), range(3)):
            numerator[term] += bend / image_scale * (p[i] * q[i] + q[i] * q[i] / 2)
    one = np.eye(20)[0]
    return SensorModel(
        RPC(
            line_off=(size[1] - 1) / 2,
            samp_off=(size[0] - 1) / 2,
            lat_off=LAT,
            long_off=LON,
            height_off=HEIGHT,
            line_scale=image_scale,
            samp_scale=image_scale,
            lat_scale=scales[1],
            long_scale=scales[0],
            height_scale=half_height,
            line_num_coeff=line,
            line_den_coeff=one,
            samp_num_coeff=samp,
            samp_den_coeff=one,
        )
    )


SIZE = (6000, 5000)
BACKWARD, FORWARD = (0.02, 0.09), (-0.03, -0.49)  # GF-7: -5 and +26 degrees, nearly along track


def ground(n: int = 400, seed: int = 0) -> np.ndarray:
    """Random ground points [3, n] in the middle of the scene, over its height range."""
    t = np.random.default_rng(seed).uniform(-1, 1, (3, n))
    east_north = t[:2] * 1200.0
    return np.vstack(
        [LON + east_north[0] / METRES[0], LAT + east_north[1] / METRES[1], HEIGHT + 400 * t[2]]
    )


def fit(left: SensorModel, right: SensorModel, **options) -> EpipolarModel:
    sizes = {"left_size": SIZE, "right_size": SIZE} | options.pop("sizes", {})
    return fit_epipolar(left, right, **sizes, reference_height=options.pop("h", HEIGHT), **options)


@pytest.mark.parametrize("left_angle", [0.0, 90.0, -90.0, 180.0, 37.0])
@pytest.mark.parametrize("right_angle", [0.0, 180.0, -75.0])
def test_parallel_cameras(left_angle: float, right_angle: float) -> None:
    """Against the analytic geometry, for any turn of either image."""
    left = camera(BACKWARD, angle=left_angle)
    right = camera(FORWARD, angle=right_angle, gsd=0.8)
    model = fit(left, right)
    points = ground()
    x_left, y_left, x_right, y_right = model.ground_to_epipolar(*points)
    assert np.abs(y_left - y_right).max() < 1e-4
    base = np.subtract(BACKWARD, FORWARD)
    ratio = np.hypot(*base) / 0.65
    # the reference surface is plane here, so d is k (h - h_ref) exactly; d grows with height
    assert np.abs(x_left - x_right - ratio * (points[2] - HEIGHT)).max() < 1e-3
    assert model.report["disparity_px_per_m"]["mean"] == pytest.approx(ratio, rel=1e-4)
    a = np.radians(left_angle)
    way = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) @ (base * (1, -1))
    difference = model.report["epipolar_angle_deg"] - np.degrees(np.arctan2(way[1], way[0]))
    assert abs((difference + 180) % 360 - 180) < 1e-3
    # pixels of the left image keep shape, size and handedness
    col, row = np.array([2000.0, 2001.0, 2000.0]), np.array([3000.0, 3000.0, 3001.0])
    x, y = model.left_to_epipolar(col, row)
    slopes = np.array([[x[1] - x[0], x[2] - x[0]], [y[1] - y[0], y[2] - y[0]]])
    assert np.linalg.det(slopes) == pytest.approx(1, abs=1e-4)
    assert np.allclose(slopes @ slopes.T, np.eye(2), atol=1e-4)


@pytest.mark.parametrize("bend", [20.0, 150.0])
@pytest.mark.parametrize("angles", [(0.0, 0.0), (90.0, 93.0), (45.0, 225.0)])
def test_curved_epipolar_lines(bend: float, angles: tuple[float, float]) -> None:
    left = camera(BACKWARD, angle=angles[0], bend=bend)
    right = camera(FORWARD, angle=angles[1], gsd=0.8, bend=-bend)
    model = fit(left, right)
    x_left, y_left, x_right, y_right = model.ground_to_epipolar(*ground())
    assert np.sqrt(np.mean((y_left - y_right) ** 2)) < 0.003
    assert model.report["y_parallax_over_fit_box"]["rms_px"] < 0.01
    assert model.report["y_parallax_over_fit_box"]["max_px"] < 0.05
    points = ground()
    flat = model.ground_to_epipolar(points[0], points[1], HEIGHT)
    assert np.abs(flat[0] - flat[2]).max() < 0.02
    assert np.all(np.sign(x_left - x_right - flat[0] + flat[2]) == np.sign(points[2] - HEIGHT))
    low, high = model.report["scale_left"]
    assert low > 0.9 and high < 1.1  # near-square pixels in spite of the bend


@pytest.mark.parametrize("degrees", [2.0, 5.0])
def test_low_convergence(degrees: float) -> None:
    tangent = np.tan(np.radians(degrees))
    left = camera((0.05, 0.1), bend=60.0)
    right = camera((0.05, 0.1 - tangent), angle=3.0, bend=-40.0)
    model = fit(left, right)
    _, y_left, _, y_right = model.ground_to_epipolar(*ground())
    assert np.abs(y_left - y_right).max() < 0.005
    assert model.report["convergence_angle_deg"] == pytest.approx(degrees, abs=0.15)
    assert model.report["scale_left"][0] > 0.9 and model.report["scale_left"][1] < 1.1


@pytest.mark.parametrize("shift", [(0.0, 0.0), (-1.192, 0.051), (35.0, -60.0)])
def test_real_rpcs_over_their_whole_ground_box(shift: tuple[float, float]) -> None:
    if not (MARSEILLE / "left.tif").is_file():
        pytest.skip("the real scene of ../shared is not here")
    left = SensorModel(read_rpc(MARSEILLE / "left.tif"))
    right = SensorModel(
        read_rpc(MARSEILLE / "right.tif"), np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
    )
    model = fit_epipolar(left, right, (1024, 1024), (1021, 1032), 170.0)
    assert model.report["fit_domain_reason"] == "the ground box is usable"
    rng = np.random.default_rng(3)
    box = np.array(left.rpc.ground_box)
    other = np.array(right.rpc.ground_box)
    low = np.maximum(box, other)[[0, 1, 4]]
    high = np.minimum(box, other)[[2, 3, 5]]
    points = low[:, None] + rng.random((3, 20000)) * (high - low)[:, None]
    _, y_left, _, y_right = model.ground_to_epipolar(*points)
    # measured: 0.0004 px rms, 0.003 px at most (24 km x 23 km x 1050 m, 48000 px)
    assert np.sqrt(np.mean((y_left - y_right) ** 2)) < 0.002
    assert np.abs(y_left - y_right).max() < 0.01


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
    with pytest.raises(InputError, match="no such epipolar model"):
        EpipolarModel.load(path)
    path.write_text(json.dumps(curved.to_dict())[:-100])
    with pytest.raises(InputError, match=r"epipolar.json: not an epipolar model"):
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


def test_the_same_fit_twice(curved: EpipolarModel) -> None:
    again = fit(curved.left, curved.right)
    assert again.to_dict() == curved.to_dict()


def test_grid_covers_the_shared_part_only() -> None:
    left, right = camera(BACKWARD), camera(FORWARD)
    # the right image is cut down to its first 2000 columns, across the epipolar direction
    narrow = fit(left, right, sizes={"right_size": (2000, 5000)})
    full = fit(left, right)
    assert narrow.shape[1] >= 0.8 * full.shape[1]
    assert narrow.shape[0] < 0.5 * full.shape[0]
    corners = full.left_to_epipolar([0, 5999, 0, 5999], [0, 0, 4999, 4999])
    assert np.min(corners) > -250 and full.shape[0] <= np.ptp(corners[1]) + 3


def test_images_that_do_not_overlap() -> None:
    left = camera(BACKWARD)
    values = camera(FORWARD).rpc.to_dict()
    away = SensorModel(RPC.from_dict(values | {"long_off": LON + 1.0}))
    with pytest.raises(InputError, match=r"a.tif: left and right image do not overlap.*b.tif"):
        fit(left, away, names=("a.tif", "b.tif"))


@pytest.mark.parametrize("degrees", [0.0, 0.5])
def test_one_view_twice(degrees: float) -> None:
    left = camera((0.0, 0.1))
    right = camera((0.0, 0.1 + np.tan(np.radians(degrees))))
    with pytest.raises(InputError, match=r"from one direction \(convergence 0"):
        fit(left, right)


def test_an_image_with_another_images_rpc() -> None:
    values = camera(BACKWARD).rpc.to_dict() | {"samp_off": 400000.0}
    with pytest.raises(InputError, match="do not overlap"):
        fit(camera(FORWARD), SensorModel(RPC.from_dict(values)))


def test_a_pole_in_the_ground_box_narrows_the_domain() -> None:
    left, right = camera(BACKWARD), camera(FORWARD)
    values = right.rpc.to_dict()
    pole = np.zeros(20)
    pole[0], pole[1] = 1.0, 1.05  # vanishes at the western edge, outside the image
    # numerator times denominator: the same camera but for the pole
    spoiled = RPC.from_dict(values | {"long_off": LON + 0.01, "samp_den_coeff": pole})
    small = {"left_size": (1500, 1500), "right_size": (1500, 1500)}
    east = SensorModel(spoiled)
    lon, lat = LON + 0.012, LAT
    shifts = []
    for sensor in (left, east):
        col, row = sensor.project(lon, lat, HEIGHT)
        shifts.append(np.array([[1, 0, 750 - col], [0, 1, 750 - row]]))
    model = fit(SensorModel(left.rpc, shifts[0]), SensorModel(spoiled, shifts[1]), sizes=small)
    assert model.report["fit_domain"] == "image footprints"
    assert "denominator" in model.report["fit_domain_reason"]
    assert model.report["y_parallax_over_image_footprints"]["rms_px"] < 0.05


def test_reference_height_outside_the_rpcs_range() -> None:
    model = fit(camera(BACKWARD), camera(FORWARD), h=HEIGHT + 450.0)
    assert model.height_range[1] == HEIGHT + 460.0
    flat = model.ground_to_epipolar(LON, LAT, HEIGHT + 450.0)
    assert abs(flat[0] - flat[2]).max() < 1e-3


def test_a_huge_height_range() -> None:
    model = fit(
        camera(BACKWARD, bend=30.0, half_height=6000.0),
        camera(FORWARD, bend=30.0, half_height=6000.0),
    )
    _, y_left, _, y_right = model.ground_to_epipolar(*ground())
    assert np.abs(y_left - y_right).max() < 0.01
