"""Heights of the LiDAR: what is off is doubted, and nothing else."""

from __future__ import annotations

import re
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.align.adjustment import Equations, Estimate, estimate
from stereotruth.align.align import align
from stereotruth.align.alignment import GcpResidual
from stereotruth.align.doubts import (
    LIDAR_SIGMA_M,
    doubt_at_gcps,
    doubt_by_rpcs,
    height_by_images,
    height_by_rpcs,
    heights_of_model,
    lines_of_sight,
)
from stereotruth.align.refine import refine
from stereotruth.lidar import geoid_candidates
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore

from ...synthetic.box_scene import HALF, ROOF, points_on, write_points
from ...synthetic.cameras import HEIGHT, LAT, LON, METRES
from ...synthetic.las import write_gtx, write_las
from ...synthetic.real_data import MARSEILLE
from ...synthetic.textured_pair import NONE, start

PIXEL = 0.65


def gcp(number: int, east: float, north: float, height: float) -> GcpResidual:
    nothing = (0.0, 0.0)
    place = LON + east / METRES[0], LAT + north / METRES[1], height
    return GcpResidual(f"G{number:02d}", *place, *[nothing] * 5, True)


def survey(ground: int = 5) -> list[GcpResidual]:
    """The corners of the box's roof, and points on the plane around it."""
    corners = [(i * HALF[0], j * HALF[1], ROOF) for i in (-1, 1) for j in (-1, 1)]
    rng = np.random.default_rng(6)
    marks = [(*rng.uniform(30.0, 80.0, 2), HEIGHT) for _ in range(ground)]
    return [gcp(n, *place) for n, place in enumerate(corners + marks)]


def store_of(folder: Path, cloud: np.ndarray) -> list[PointStore]:
    return [PointStore(write_points(folder, cloud))]


# ------------------------------------------------------------------------ by the control points


@pytest.mark.parametrize("spacing", [0.4, 1.0, 2.0])
def test_right_heights_are_not_doubted(tmp_path, spacing):
    stores = store_of(tmp_path, points_on(True, noise=0.1, spacing=spacing))
    assert doubt_at_gcps(survey(), stores, PIXEL) == ""


@pytest.mark.parametrize("offset", [-49.4, -10.0, -2.0, 1.5, 5.0, 49.4])
def test_an_offset_is_doubted_and_told(tmp_path, offset):
    cloud = points_on(True, noise=0.05, spacing=0.8)
    cloud[:, 2] += offset
    text = doubt_at_gcps(survey(), store_of(tmp_path, cloud), PIXEL)
    told = re.search(r"if it were (\d+\.\d) m (lower|higher)", text)
    assert told[2] == ("lower" if offset > 0 else "higher")
    assert float(told[1]) == pytest.approx(abs(offset), abs=0.11)
    assert "only 0 of 9" in text and "vertical datum" in text


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """EGM2008 of 49.4 m and EGM96 of 45 m all around, on this machine."""
    values = {"us_nga_egm08_25.tif": 49.4, "us_nga_egm96_15.tif": 45.0}
    places = {
        name: write_gtx(tmp_path / f"{name}.gtx", np.full((9, 9), value), 112.0, 28.0, 0.5)
        for name, value in values.items()
    }
    monkeypatch.setattr(geoid_candidates, "_installed", places.get)


def test_orthometric_heights_taken_as_ellipsoidal_fit_their_geoid(tmp_path, installed):
    """The LiDAR lies 49.4 m too low: H in the place of H + N."""
    cloud = points_on(True, noise=0.05, spacing=0.8)
    cloud[:, 2] -= 49.4
    stores = store_of(tmp_path, cloud)
    declared = doubt_at_gcps(survey(), stores, PIXEL)
    assert "EGM" not in declared
    stores[0].attrs["crs"]["heights"] = "ellipsoidal (assumed), in metre"
    text = doubt_at_gcps(survey(), stores, PIXEL)
    assert text.startswith(declared)
    assert "if they are ellipsoidal 49.4 m; EGM2008 height (us_nga_egm08_25.tif) 0.0 m" in text
    assert "EGM96 height (us_nga_egm96_15.tif) 4.4 m" in text


def test_feet_for_metres_are_doubted(tmp_path):
    cloud = points_on(True, spacing=0.8)
    cloud[:, 2] /= 0.3048
    assert "vertical datum" in doubt_at_gcps(survey(9), store_of(tmp_path, cloud), PIXEL)


def test_a_third_of_bad_control_points_doubts_no_lidar(tmp_path):
    stores = store_of(tmp_path, points_on(True, spacing=0.8))
    points = survey()
    bad = [gcp(20 + n, 40.0 + 5 * n, -40.0, HEIGHT + 7.0 * n + 5.0) for n in range(4)]
    assert doubt_at_gcps(points + bad, stores, PIXEL) == ""


def test_control_points_beside_the_lidar_say_nothing(tmp_path):
    cloud = points_on(True, spacing=0.8)
    cloud[:, 2] += 20.0
    stores = store_of(tmp_path, cloud)
    outside = [gcp(n, 300.0 + 10 * n, 0.0, HEIGHT) for n in range(9)]
    assert doubt_at_gcps(outside, stores, PIXEL) == ""
    assert doubt_at_gcps(outside + survey()[:2], stores, PIXEL) == ""
    assert doubt_at_gcps(outside + survey()[:3], stores, PIXEL) != ""


# ----------------------------------------------------------------------------------- by the RPCs


def test_an_epipolar_model_serves_the_heights_of_the_lidar(tmp_path):
    pair = start(NONE, NONE, 1.0)  # the RPCs hold for 60 ± 400 m
    sensors = pair.left, pair.right
    cloud = points_on(False, spacing=2.0)
    low, high = heights_of_model(store_of(tmp_path / "right", cloud), sensors)
    assert low < cloud[:, 2].min() - 9.0 and cloud[:, 2].max() + 9.0 < high
    assert high - low < 1.3 * np.ptp(cloud[:, 2]) + 25.0
    cloud[:5, 2] += 3000.0  # birds do not stretch it beyond what the RPCs hold for
    _, above = heights_of_model(store_of(tmp_path / "birds", cloud), sensors)
    assert high < above < 1000.0
    cloud[:, 2] += 5000.0
    assert heights_of_model(store_of(tmp_path / "above", cloud), sensors) is None


def test_heights_outside_those_of_the_rpcs_are_doubted(tmp_path):
    pair = start(NONE, NONE, 1.0)  # the RPCs hold for 60 ± 400 m
    sensors = pair.left, pair.right
    cloud = points_on(False, spacing=2.0)
    assert doubt_by_rpcs(store_of(tmp_path / "right", cloud), sensors) == ""
    cloud[:50, 2] += 3000.0  # a flock of birds
    assert doubt_by_rpcs(store_of(tmp_path / "birds", cloud), sensors) == ""
    cloud[:, 2] += 700.0
    text = doubt_by_rpcs(store_of(tmp_path / "wrong", cloud), sensors)
    assert "at 760 m" in text and "-340 to 460 m" in text


# ------------------------------------------------------------------------------- by the estimate


def estimated(shifts: np.ndarray, sigma: float, rng: np.random.Generator, noise: float = 0.05):
    """An estimate from tie points that see the shifts [4] of both images, on a hilly scene."""
    n = 900
    u, v = rng.uniform(-1, 1, (2, n))
    basis = np.column_stack([u, v, np.ones(n)])
    design = np.zeros((n, 2, 12))
    slope = rng.normal(0, 0.3, (n, 2, 2))  # of the ground: the common part is seen by it
    for axis in (0, 1):
        for own, sign in ((0, -1.0), (6, 1.0)):
            for k in (0, 1):
                part = slice(own + 3 * k, own + 3 * k + 3)
                design[:, axis, part] = basis * (sign * (axis == k) + slope[:, axis, k, None] / 2)
    truth = np.zeros(12)
    truth[[2, 5, 8, 11]] = shifts
    observed = design @ truth + rng.normal(0, noise, (n, 2))
    prior = np.eye(12) * sigma**2
    where = np.column_stack([u, v])
    equations = Equations(design, observed, np.full(n, noise), np.arange(n) // 9, where, where)
    return estimate(equations, prior)


@pytest.mark.slow
def test_a_fault_of_height_is_measured_with_an_honest_deviation():
    """Errors drawn from the prior, a fault of 2 m on top."""
    rng = np.random.default_rng(5)
    pair = start(NONE, NONE, 0.1)
    ratios, told, contradictions = [], [], []
    for fault in [2.0] * 60 + [0.0] * 60:
        shifts = rng.normal(0, 0.1, 4) - fault * lines_of_sight(pair).ravel()
        found = estimated(shifts, 0.1, rng)
        height = height_by_images(pair, found)
        ratios.append((height.offset_m - fault) / np.hypot(height.sigma_m, -0.0))
        told.append(height.doubtful)
        contradictions.append(found.contradiction / found.contradiction_freedom)
    # The deviation has the LiDAR's own in it, which these points do not have.
    own = np.sqrt(height.sigma_m**2 - LIDAR_SIGMA_M**2)
    scatter = np.std(ratios) * height.sigma_m
    assert 0.8 < scatter / own < 1.25
    assert all(told[:60]) and not any(told[60:])
    # Tilts are not drawn: four of the twelve parameters vary as the prior says.
    assert np.mean(contradictions[60:]) == pytest.approx(4 / 12, rel=0.3)
    assert np.mean(contradictions[:60]) > 3.0


def with_shifts(shifts: np.ndarray):
    """A pair without control points, and the same refined by shifts [4] of both images."""
    planted = np.zeros((2, 2, 3))
    planted[:, :, 2] = shifts.reshape(2, 2)
    return start(NONE, NONE, 10.0), start(*planted, 10.0)


def sure() -> Estimate:
    nothing = np.zeros(12)
    return Estimate(
        nothing, np.eye(12) * 1e-4, nothing, nothing, nothing, nothing, 0.0, 12, 0.0, 12,
        np.eye(12), np.eye(12), nothing, np.zeros((0, 2)),
    )  # fmt: skip


def test_errors_of_rpcs_are_seldom_taken_for_a_fault_of_height():
    """Errors without direction, of whatever size: 1 % of the scenes are doubted, as is said."""
    rng = np.random.default_rng(1)
    doubted = 0
    for _ in range(600):
        shifts = rng.normal(0, 10 ** rng.uniform(0.0, 1.3), 4)
        doubted += height_by_rpcs(*with_shifts(shifts), sure()).doubtful
    assert doubted <= 14


def test_a_geoid_is_told_by_rpcs_of_two_pixels():
    rng = np.random.default_rng(2)
    pair = start(NONE, NONE, 10.0)
    told = []
    for _ in range(100):
        shifts = rng.normal(0, 2.0, 4) - 45.0 * lines_of_sight(pair).ravel()
        height = height_by_rpcs(*with_shifts(shifts), sure())
        assert height.offset_m == pytest.approx(45.0, abs=12.0)
        told.append(height.doubtful)
    assert np.mean(told) > 0.9


def test_what_is_not_known_of_the_images_tells_no_fault():
    """Tie points that leave a part of the shifts open: an offset within it is not doubted."""
    pair = start(NONE, NONE, 10.0)
    shifts = -20.0 * lines_of_sight(pair).ravel()
    known = sure()
    assert height_by_rpcs(*with_shifts(shifts), known).doubtful
    open_ = Estimate(**{**vars(known), "covariance": np.eye(12) * 8.0**2})
    assert not height_by_rpcs(*with_shifts(shifts), open_).doubtful


# --------------------------------------------------------------------------- on the real scene


@pytest.mark.slow
@pytest.mark.skipif(not MARSEILLE.is_dir(), reason="the real scene is not beside the project")
class TestMarseille:
    """Datum faults planted in the point cloud of a real pair, with its control points."""

    @pytest.fixture(scope="class")
    def cloud(self) -> tuple[np.ndarray, pyproj.CRS]:
        parts = [laspy.read(file) for file in sorted((MARSEILLE / "lidar").glob("*.laz"))]
        xyz = np.concatenate([np.asarray(part.xyz)[::3] for part in parts])
        return xyz, parts[0].header.parse_crs()

    def refined(self, cloud, folder: Path, change):
        xyz, crs = cloud
        changed = np.column_stack([xyz[:, :2], change(xyz[:, 2])])
        write_las(folder / "points.las", xyz=changed, system=crs)
        ingest(folder / "points.las", folder / "points.points")
        images = MARSEILLE / "left.tif", MARSEILLE / "right.tif"
        aligned = align(*images, MARSEILLE / "gcps.csv", provenance={})
        return refine(aligned, *images, [folder / "points.points"])[0]

    def test_as_it_is_nothing_is_doubted(self, cloud, tmp_path):
        found = self.refined(cloud, tmp_path, lambda z: z)
        assert found.warnings == ()
        assert abs(found.refinement["lidar_height"]["offset_m"]) < 0.15

    @pytest.mark.parametrize("offset", [-49.4, -10.0, 1.0, 3.0, 60.0])
    def test_an_offset_is_doubted(self, cloud, tmp_path, offset):
        found = self.refined(cloud, tmp_path, lambda z: z + offset)
        doubts = [text for text in found.warnings if "vertical datum" in text]
        assert doubts
        told = re.search(r"if it were (\d+\.\d) m (lower|higher)", " ".join(doubts))
        assert told[2] == ("lower" if offset > 0 else "higher")
        assert float(told[1]) == pytest.approx(abs(offset), abs=0.3)

    def test_feet_for_metres_are_doubted(self, cloud, tmp_path):
        found = self.refined(cloud, tmp_path, lambda z: z / 0.3048)
        assert any("height unit" in text for text in found.warnings)
