"""What is off is doubted, and nothing else: heights of the LiDAR, images of a site."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from stereocities.rpcs import draw_bias
from stereotruth.align.adjustment import Estimate, estimate
from stereotruth.align.align import align
from stereotruth.align.alignment import GcpResidual
from stereotruth.align.doubts import (
    CHANCE_OF_SITE,
    LIDAR_SIGMA_M,
    NORMAL,
    doubt_at_gcps,
    doubt_by_rpcs,
    height_by_images,
    height_by_rpcs,
    heights_of_model,
    image_doubts,
    lines_of_sight,
    stand_out,
)
from stereotruth.align.records import Equations
from stereotruth.align.refine import refine
from stereotruth.lidar import geoid
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


def test_right_heights_are_not_doubted(tmp_path):
    stores = store_of(tmp_path, points_on(True, noise=0.1, spacing=1.0))
    assert doubt_at_gcps(survey(), stores, PIXEL) == ""


@pytest.mark.parametrize("offset", [-49.4, 1.5])
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
    monkeypatch.setattr(geoid, "_installed", places.get)


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
    assert "by 49.4 m if they are ellipsoidal, by 0.0 m if they are above EGM2008 height" in text
    assert "by 4.4 m if they are above EGM96 height (us_nga_egm96_15.tif)" in text


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
        contradictions.append(found.contradiction / found.freedom)
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
        nothing, np.eye(12) * 1e-4, nothing, nothing, nothing, nothing, 0.0, 12, 0.0,
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


# --------------------------------------------------------------------------- on the real scene


@pytest.mark.slow
@pytest.mark.skipif(not MARSEILLE.is_dir(), reason="the real scene is not beside the project")
@pytest.mark.parametrize("offset", [0.0, 1.0])
def test_a_fault_of_the_datum_of_a_real_scene_is_doubted(tmp_path, offset):
    """Planted in the point cloud of a real pair with control points."""
    parts = [laspy.read(file) for file in sorted((MARSEILLE / "lidar").glob("*.laz"))]
    xyz = np.concatenate([np.asarray(part.xyz)[::3] for part in parts])
    xyz[:, 2] += offset
    write_las(tmp_path / "points.las", xyz=xyz, system=parts[0].header.parse_crs())
    ingest(tmp_path / "points.las", tmp_path / "points.points")
    images = MARSEILLE / "left.tif", MARSEILLE / "right.tif"
    aligned = align(*images, MARSEILLE / "gcps.csv", provenance={})
    refined = refine(aligned, *images, [tmp_path / "points.points"])[0]
    if not offset:
        assert refined.warnings == ()
        assert abs(refined.refinement["lidar_height"]["offset_m"]) < 0.15
        return
    told = re.search(r"if it were (\d+\.\d) m (lower|higher)", " ".join(refined.warnings))
    assert told[2] == ("lower" if offset > 0 else "higher")
    assert float(told[1]) == pytest.approx(abs(offset), abs=0.3)


# ------------------------------------------------------------------------- images of a site


def image(length: float = 10.0, refused: str = "") -> dict[str, Any]:
    """Figures of an image whose correction has a length, px."""
    correction = {"col": 0.6 * length, "row": -0.8 * length}
    gcps = {"left_out": []}
    return {"refused": refused, "fixed": False, "correction": correction, "gcps": gcps}


def pair(left: str, right: str, matched: float) -> dict[str, Any]:
    """Figures of a pair."""
    points = round(200 * matched)
    return {
        "left": left, "right": right, "matched": matched, "tie_points": points, "weight": 1.0,
        "reason": "" if points else "no shift stands out",
    }  # fmt: skip


def lengths_of(shifts: np.ndarray) -> np.ndarray:
    """Of corrections [n, 2] px, as they are compared."""
    return np.hypot(*shifts.T) ** NORMAL


@pytest.mark.parametrize("count", [4, 24])
def test_few_sites_without_a_fault_name_an_rpc(count):
    """Errors of RPCs are normal in col and row: one site in twenty, or a few more."""
    rng = np.random.default_rng(count)
    sites = [stand_out(lengths_of(rng.normal(0, 8, (count, 2))), 0.3).any() for _ in range(2000)]
    assert 0.5 * CHANCE_OF_SITE < np.mean(sites) < 2.0 * CHANCE_OF_SITE


def test_an_rpc_off_by_15_px_more_is_named_in_most_sites():
    """Of twelve images whose RPCs are off as the simulator's are, 6 to 16 px."""
    rng, named = np.random.default_rng(4), 0
    for _ in range(200):
        shifts = [
            (draw_bias(900, 900, int(seed), "left") - np.eye(2, 3)) @ (449.5, 449.5, 1.0)
            for seed in rng.integers(1 << 31, size=12)
        ]
        shifts = np.array(shifts)
        shifts[5] += np.sign(shifts[5] @ (0.8, 0.6)) * np.array([12.0, 9.0])
        named += np.flatnonzero(stand_out(lengths_of(shifts), 0.3)).tolist() == [5]
    assert named / 200 > 0.8


def test_two_large_corrections_do_not_hide_each_other():
    rng = np.random.default_rng(3)
    lengths = rng.normal(10.0, 2.0, 16)
    lengths[[4, 9]] = 31.0, 32.0
    assert np.flatnonzero(stand_out(lengths, 0.5)).tolist() == [4, 9]


def test_few_or_even_corrections_name_nobody():
    assert not stand_out(np.array([3.0, 90.0]), 0.5).any()
    assert not stand_out(np.array([0.2, 0.2, 9.0]), 0.3).any()  # as an image and its crop are
    assert not stand_out(np.array([1.0, 1.01, 1.0, 1.02, 1.3]), 0.5).any()
    assert not stand_out(np.zeros(0), 0.5).any()


def test_the_partner_of_a_poor_image_is_not_named():
    """B has two pairs, and one of them is with A, of which nothing matches."""
    names = "ABCD"
    pairs = [("A", "B", 0.2), ("A", "C", 0.25), ("A", "D", 0.3), ("B", "C", 0.8), ("C", "D", 0.85)]
    doubts = image_doubts(
        {name: image() for name in names}, {f"{a}-{b}": pair(a, b, m) for a, b, m in pairs}
    )
    assert {name for name, texts in doubts.items() if texts} == {"A"}
    assert "30 % match at best" in doubts["A"][0]


def test_a_refused_image_has_no_part_in_the_usual_correction():
    """Its correction is none, as nothing places it: not a small one."""
    lengths = dict(zip("ABCDEFGH", (0.0, 0.0, 10.0, 10.5, 9.5, 10.2, 9.8, 14.5)))
    images = {name: image(length) for name, length in lengths.items()}
    pairs = {f"{a}-{b}": pair(a, b, 0.8) for a, b in zip("ABCDEFG", "BCDEFGH")}
    assert image_doubts(images, pairs)["H"] == []
    for name in "AB":
        images[name] = image(0.0, "neither tie points nor control points place it")
    assert "off by 14.5 px, where 10.1 px" in image_doubts(images, pairs)["H"][0]
