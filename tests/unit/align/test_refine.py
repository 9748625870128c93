"""Refinement on a textured hilly surface seen by known cameras: what is planted is found."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from stereotruth.align.alignment import Alignment, GcpResidual
from stereotruth.align.doubts import lines_of_sight, scatter_by_heights
from stereotruth.align.figures import draw_refinement
from stereotruth.align.label_uncertainty import label_covariance
from stereotruth.align.refine import refine, write_refinement
from stereotruth.core.errors import InputError
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.box_scene import write_points
from ...synthetic.cameras import HEIGHT, LAT, LON, METRES
from ...synthetic.images import write_image
from ...synthetic.pictures import colours_in, read_picture, share_of
from ...synthetic.textured_pair import NONE, SIZE, TRUE, start, surface


def texture(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Smooth noise on the ground: unlike a few waves, it is itself only where it is."""
    noise = gaussian_filter(np.random.default_rng(4).normal(0, 1, (800, 800)), 1.8, mode="wrap")
    at = np.stack([north, east]) / 0.8 + 400.0  # lattice of 0.8 m
    return 1000.0 + 1500.0 * map_coordinates(noise, at, order=3, mode="grid-wrap")


def render(sensor: SensorModel) -> np.ndarray:
    col, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    height = np.full(col.shape, HEIGHT)
    for _ in range(12):
        lon, lat = sensor.localize(col, row, height)
        east, north = (lon - LON) * METRES[0], (lat - LAT) * METRES[1]
        height = surface(east, north)
    rng = np.random.default_rng(int(sensor.rpc.samp_num_coeff[3] * 1e6) % 1000)
    return np.round(texture(east, north) + rng.normal(0, 5.0, col.shape)).astype(np.uint16)


def lidar(spacing: float = 1.0) -> np.ndarray:
    """lon, lat, height [n, 3] of points on the surface, 0.03 m of noise."""
    rng = np.random.default_rng(0)
    east, north = np.mgrid[-300:300:spacing, -300:300:spacing].reshape(2, -1)
    east, north = np.stack([east, north]) + rng.uniform(-0.3, 0.3, (2, east.size)) * spacing
    height = surface(east, north) + rng.normal(0, 0.03, east.size)
    return np.column_stack([LON + east / METRES[0], LAT + north / METRES[1], height])


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("images")
    return [write_image(folder / f"{n}.tif", None, render(s)) for n, s in zip("lr", TRUE)]


@pytest.fixture(scope="module")
def points(tmp_path_factory) -> Path:
    return write_points(tmp_path_factory.mktemp("points"), lidar())


def relative_error(alignment: Alignment) -> tuple[float, float]:
    """Largest error of the disparity and largest y-parallax over the scene, px.

    Of exact points of the surface, against where the true cameras see them.
    """
    east, north = (c.ravel() for c in np.meshgrid(np.linspace(-180, 180, 9), [-150, 0, 150]))
    ground = LON + east / METRES[0], LAT + north / METRES[1], surface(east, north)
    model = fit_epipolar(alignment.left, alignment.right, SIZE, SIZE, HEIGHT)
    x_left, y_left = model.left_to_epipolar(*TRUE[0].project(*ground))
    x_right, y_right = model.right_to_epipolar(*TRUE[1].project(*ground))
    label = model.ground_to_epipolar(*ground)
    disparity = label[0] - label[2] - (x_left - x_right)
    return float(np.abs(disparity).max()), float(np.abs(y_right - y_left).max())


PLANTED = np.array([[0.2, -0.1, 0.7], [0.1, 0.15, -0.5]])


@pytest.fixture(scope="module")
def found(images, points):
    return refine(start(NONE, PLANTED, 0.5), *images, [points])


def test_a_planted_shift_and_tilt_is_taken_out(found):
    refined, observations = found
    assert max(relative_error(start(NONE, PLANTED, 0.5))) > 0.5
    assert refined.refinement["applied"]
    assert max(relative_error(refined)) < 0.02
    record = refined.refinement
    assert record["used"] > 100
    for name in ("disparity", "y_parallax"):
        assert record["before"][name]["trend_rms"] > 0.3
        assert record["after"][name]["trend_rms"] < 0.02
    assert np.abs(np.median(observations.after[observations.used], axis=0)).max() < 0.02


@pytest.mark.slow
def test_rpcs_alone_are_brought_together(images, points):
    left = np.array([[0.05, 0.0, 9.0], [0.0, -0.05, -6.0]])
    right = np.array([[0.0, 0.1, -8.0], [-0.05, 0.0, 11.0]])
    planted = start(left, right, 10.0)
    refined, _ = refine(planted, *images, [points])
    assert max(relative_error(planted)) > 10.0
    assert max(relative_error(refined)) < 0.03
    model = fit_epipolar(refined.left, refined.right, SIZE, SIZE, HEIGHT)
    middle = model.shape[1] / 2, model.shape[0] / 2
    disparity, x, y = np.sqrt(np.diag(label_covariance(refined, model, *middle)))
    assert disparity < 0.03
    # The common part is seen on slopes only: the uncertainty of the labels' places says so.
    miss = np.subtract(refined.left.project(LON, LAT, HEIGHT), TRUE[0].project(LON, LAT, HEIGHT))
    assert np.abs(miss).max() < 4 * max(x, y)


def test_a_good_alignment_is_left_as_it_is(images, points):
    good = start(NONE, NONE, 0.01)
    refined, _ = refine(good, *images, [points])
    assert not refined.refinement["applied"]
    assert "do not contradict" in refined.refinement["reason"]
    assert refined.refinement["before"] == refined.refinement["after"]
    for before, after in ((good.left, refined.left), (good.right, refined.right)):
        assert (before.affine == after.affine).all()


@pytest.mark.slow
def test_changed_ground_does_not_draw_the_result(images, points, tmp_path):
    """An eighth of the right image has moved, a tenth of the LiDAR is 1.5 m too high."""
    col, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    changed = render(TRUE[1])
    moved = np.roll(changed, 3, axis=1)
    part = (col > SIZE[0] / 2) & (row < SIZE[1] / 4)
    changed[part] = moved[part]
    right = write_image(tmp_path / "changed.tif", None, changed)
    cloud = lidar()
    north = (cloud[:, 1] - LAT) * METRES[1]
    cloud[north < -140.0, 2] += 1.5
    store = write_points(tmp_path, cloud)
    refined, observations = refine(start(NONE, PLANTED, 0.5), images[0], right, [store])
    assert max(relative_error(refined)) < 0.03
    # Well inside what has moved, and where the LiDAR is too high, no tie point has a say.
    found = observations.ties.right + observations.ties.shift
    moved = (found[:, 0] > SIZE[0] / 2 + 24) & (found[:, 1] < SIZE[1] / 4 - 24)
    left, used = observations.ties.left, observations.used
    lat = refined.left.localize(*left.T, observations.ties.height)[1]
    raised = (lat - LAT) * METRES[1] < -160.0
    assert raised.sum() > 5
    assert not used[moved].any() and not used[raised].any()


def test_what_both_images_share_stays_as_the_gcps_say(images, points):
    """GCPs that are sure of the left image: all of the relative error goes to the right one."""
    planted = start(NONE, PLANTED, 0.5)
    sure = replace(planted, left_fit=replace(planted.left_fit, covariance=np.eye(6) * 1e-8))
    refined, _ = refine(sure, *images, [points])
    assert np.abs(refined.left.affine - TRUE[0].affine)[:, 2].max() < 1e-3
    assert max(relative_error(refined)) < 0.02


@pytest.mark.slow
def test_no_tie_point_lies_under_a_mask(images, points, tmp_path):
    cloud = np.zeros(SIZE[::-1], np.uint8)
    cloud[:, : SIZE[0] // 3] = 1
    lake = np.zeros(SIZE[::-1], np.uint8)
    lake[SIZE[1] * 3 // 4 :] = 255
    masks = [write_image(tmp_path / f"{n}.tif", None, m) for n, m in (("l", cloud), ("r", lake))]
    refined, observations = refine(start(NONE, PLANTED, 0.5), *images, [points], masks=masks)
    assert refined.refinement["applied"]
    assert refined.refinement["used"] > 50
    assert observations.ties.left[:, 0].min() >= SIZE[0] // 3
    found = observations.ties.right + observations.ties.shift
    assert found[:, 1].max() < SIZE[1] * 3 // 4


def test_too_little_to_see_is_said(images, tmp_path):
    cloud = lidar()
    corner = cloud[(cloud[:, 0] > LON + 190 / METRES[0])]
    store = write_points(tmp_path, corner)
    planted = start(NONE, PLANTED, 0.5)
    with pytest.raises(InputError, match="without ground control points"):
        refine(planted, *images, [store])


def gcp() -> GcpResidual:
    nothing = (0.0, 0.0)
    return GcpResidual("G1", LON, LAT, HEIGHT, *[nothing] * 5, True)


def with_gcp(alignment: Alignment) -> Alignment:
    """What was fitted to ground control points, so that it can stand without a refinement."""
    fits = [replace(fit, gcps=(gcp(),)) for fit in alignment.fits]
    return replace(alignment, left_fit=fits[0], right_fit=fits[1])


def test_lidar_of_another_datum_changes_nothing(images, tmp_path):
    cloud = lidar()
    cloud[:, 2] += 25.0
    store = write_points(tmp_path, cloud)
    planted = with_gcp(start(NONE, NONE, 0.05))
    refined, _ = refine(planted, *images, [store])
    assert not refined.refinement["applied"]
    assert refined.refinement["reason"]
    assert refined.refinement["reason"] in refined.warnings[0]  # so that alignment.json says it
    assert (refined.right.affine == planted.right.affine).all()


@pytest.mark.slow
def test_more_than_the_gcps_explain_is_doubted(images, points, tmp_path):
    cloud = lidar()
    cloud[:, 2] += 1.0
    store = write_points(tmp_path, cloud)
    refined, _ = refine(with_gcp(start(NONE, NONE, 0.05)), *images, [store])
    assert refined.refinement["applied"]
    assert len(refined.warnings) == 1 and "vertical datum" in refined.warnings[0]
    with pytest.raises(InputError, match="vertical datum"):
        refine(with_gcp(start(NONE, NONE, 0.05)), *images, [store], strict=True)
    assert "+1.0" in refined.warnings[0] or "+0.9" in refined.warnings[0]


@pytest.mark.slow
@pytest.mark.parametrize(("metres", "doubted"), [(0.4, False), (-30.0, True)])
def test_heights_without_control_points_are_held_against_the_rpcs(
    images, tmp_path, metres, doubted
):
    """RPCs that are a px off; a fault of 0.4 m is as likely an error of theirs."""
    cloud = lidar()
    cloud[:, 2] += metres
    store = write_points(tmp_path, cloud)
    left = np.array([[0.0, 0.0, 0.8], [0.0, 0.0, -1.1]])
    right = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.6]])
    refined, _ = refine(start(left, right, 10.0), *images, [store])
    found = refined.refinement["lidar_height"]
    assert found["offset_m"] == pytest.approx(metres, abs=3.0)
    (text,) = refined.warnings
    assert ("vertical datum" in text) == doubted
    assert doubted or f"less than {found['told_from_m']:.0f} m cannot be told" in text
    # The labels' disparities are right all the same, as tie points alone would have them.
    raised = refined.left.project(LON, LAT, HEIGHT + metres)
    assert np.abs(np.subtract(raised, TRUE[0].project(LON, LAT, HEIGHT))).max() < 1.0


@pytest.mark.parametrize(("metres", "told"), [(0.15, False), (0.4, True)])
def test_heights_that_scatter_more_than_lidar_tell_of_other_ground(metres, told):
    """As of images that were cut, with the RPCs of before: no point says where they look."""
    alignment, rng = start(NONE, NONE, 10.0), np.random.default_rng(1)
    px_per_m = np.linalg.norm(np.subtract(*lines_of_sight(alignment)))
    along, across = rng.normal(0, 1, (2, 80)) * [[np.hypot(0.02, px_per_m * metres)], [0.02]]
    scatter, explained = scatter_by_heights(alignment, along, across)
    assert (scatter > explained) == told


@pytest.mark.slow
def test_lidar_beside_its_place_is_doubted(images, tmp_path):
    """What the disparities do not see: the common part is told by the slopes."""
    cloud = lidar()
    cloud[:, 0] += 2.0 / METRES[0]
    store = write_points(tmp_path, cloud)
    refined, _ = refine(with_gcp(start(NONE, NONE, 0.05)), *images, [store])
    assert len(refined.warnings) == 1 and "coordinate system" in refined.warnings[0]
    assert abs(refined.refinement["lidar_height"]["offset_m"]) < 0.3


@pytest.mark.slow
def test_the_order_of_the_stores_changes_nothing(images, tmp_path):
    cloud = lidar()
    half = cloud[:, 0] < LON
    a, b = (write_points(tmp_path / n, cloud[h], n) for n, h in (("a", half), ("b", ~half)))
    planted = start(NONE, PLANTED, 0.5)
    one, other = (refine(planted, *images, stores)[0] for stores in ([a, b], [b, a]))
    assert one.to_dict() == other.to_dict()


@pytest.mark.slow
def test_json_keeps_the_refinement(found, images, tmp_path):
    refined, observations = found
    files = [tmp_path / name for name in ("a.json", "o.csv", "f.png")]
    write_refinement(refined, observations, *files[:2])
    draw_refinement(refined, *files[1:], images[0])
    again = Alignment.read(files[0])
    assert again.to_dict() == refined.to_dict()
    assert (again.covariance == refined.covariance).all()
    with files[1].open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == refined.refinement["tie_points"]
    assert sum(row["used"] == "yes" for row in rows) == refined.refinement["used"]
    picture = read_picture(files[2])
    assert picture.shape[:2] == pytest.approx((15.0 * 110, 11.5 * 110), rel=0.1)
    upper, over_image, lower = np.split(
        picture, (np.array([0.36, 0.72]) * len(picture)).astype(int)
    )
    assert share_of(upper, "C0") > 1e-3  # arrows of the sites
    assert min(colours_in(over_image), colours_in(lower)) > 2e-3  # tie points, histograms
    unrefined = replace(refined, refinement={"applied": False, "reason": "x"})
    write_refinement(unrefined, None, *files[:2])
    draw_refinement(unrefined, *files[1:], images[0])
    assert len(files[1].read_text().splitlines()) == 1
    assert colours_in(read_picture(files[2])) == 0  # nothing but its title
