"""The epipolar model on cameras whose epipolar geometry is known, and on real RPCs."""

from __future__ import annotations

import numpy as np
import pytest

from stereocities import sites
from stereocities.sites import drawn_site
from stereotruth.core.errors import InputError
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.sensor.rpc import RPC, SCALARS, VECTORS, SensorModel
from stereotruth.sensor.rpc_files import read_rpc

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, camera
from ...synthetic.real_data import MARSEILLE
from ...synthetic.wide_pair import fit, ground


@pytest.mark.parametrize(
    ("left_angle", "right_angle"), [(0.0, 0.0), (90.0, -75.0), (37.0, 180.0), (-90.0, 0.0)]
)
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


@pytest.mark.parametrize(("bend", "angles"), [(150.0, (90.0, 93.0)), (20.0, (45.0, 225.0))])
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


def test_low_convergence() -> None:
    degrees = 2.0
    tangent = np.tan(np.radians(degrees))
    left = camera((0.05, 0.1), bend=60.0)
    right = camera((0.05, 0.1 - tangent), angle=3.0, bend=-40.0)
    model = fit(left, right)
    _, y_left, _, y_right = model.ground_to_epipolar(*ground())
    assert np.abs(y_left - y_right).max() < 0.005
    assert model.report["convergence_angle_deg"] == pytest.approx(degrees, abs=0.15)
    assert model.report["scale_left"][0] > 0.9 and model.report["scale_left"][1] < 1.1


@pytest.mark.parametrize("shift", [(0.0, 0.0), (35.0, -60.0)])
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
    with pytest.raises(InputError, match=r"a.tif: .*b.tif"):
        fit(left, away, names=("a.tif", "b.tif"))


@pytest.mark.parametrize("degrees", [0.0, 0.5])
def test_one_view_twice(degrees: float) -> None:
    left = camera((0.0, 0.1))
    right = camera((0.0, 0.1 + np.tan(np.radians(degrees))))
    with pytest.raises(InputError, match="convergence 0"):
        fit(left, right)


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


def test_a_huge_height_range() -> None:
    model = fit(
        camera(BACKWARD, bend=30.0, half_height=6000.0),
        camera(FORWARD, bend=30.0, half_height=6000.0),
    )
    _, y_left, _, y_right = model.ground_to_epipolar(*ground())
    assert np.abs(y_left - y_right).max() < 0.01


def test_small_images_with_a_wide_range_of_heights_keep_their_rows(monkeypatch) -> None:
    """Crops of 700 px whose RPCs cover 1200 m of height, of two passes: rows shrank to a tenth, or
    the model could not be inverted."""
    monkeypatch.setattr(sites, "RPC_MARGIN_M", 600.0)
    sites.camera_of.cache_clear()
    site = drawn_site(1, 4242, images=2, side_px=700, seasons=False)
    sensors, sizes = [], []
    for image in site.images:
        seen = sites.camera_of(site, image)
        values = dict(zip(SCALARS, seen.rpc.numbers)) | dict(zip(VECTORS, seen.rpc.coefficients))
        sensors.append(SensorModel(RPC(**values)))
        sizes.append((seen.cols, seen.rows))
    sites.camera_of.cache_clear()
    model = fit_epipolar(*sensors, *sizes, sensors[0].rpc.height_off)
    for view in ("left", "right"):
        low, high = model.report[f"scale_{view}"]
        assert low > 0.85 and high < 1.15
    assert model.shape[0] > 0.85 * sizes[0][1]
    assert model.report["y_parallax_over_image_footprints"]["rms_px"] < 0.1
