from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio

from stereotruth.alignment.align import RPC_SHIFT, align, from_rpcs
from stereotruth.alignment.align_report import write_alignment
from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.control_points import COLUMNS, read_gcps
from stereotruth.alignment.robust_fit import System, find_blunders
from stereotruth.epipolar.rpc import RPC, SensorModel
from stereotruth.errors import InputError

SHARED = Path(__file__).parents[3] / "shared"
MARSEILLE = SHARED / "real" / "marseille"
LON, LAT, HEIGHT = 115.4, 30.2, 60.0
SIZES = {"left": (4000, 3000), "right": (3600, 2800)}
TRUE = {
    "left": np.array([[1.0002, -0.0001, 6.3], [0.0001, 0.9999, -4.1]]),
    "right": np.array([[0.9998, 0.0002, -3.7], [-0.0001, 1.0001, 8.8]]),
}


def linear_rpc(gsd: float, angle_deg: float, size: tuple[int, int]) -> RPC:
    """Parallel rays, no rotation: col to the east, row to the south, parallax along rows."""
    cols, rows = size
    east, north = 111320.0 * np.cos(np.radians(LAT)), 110950.0
    one = np.eye(20)[0]
    samp, line = np.zeros(20), np.zeros(20)
    lon_scale, lat_scale, height_scale = 0.02, 0.02, 500.0
    samp[1] = lon_scale * east / gsd / (cols / 2)
    line[2] = -lat_scale * north / gsd / (rows / 2)
    line[3] = height_scale * np.tan(np.radians(angle_deg)) / gsd / (rows / 2)
    return RPC(
        line_off=(rows - 1) / 2,
        samp_off=(cols - 1) / 2,
        lat_off=LAT,
        long_off=LON,
        height_off=HEIGHT,
        line_scale=rows / 2,
        samp_scale=cols / 2,
        lat_scale=lat_scale,
        long_scale=lon_scale,
        height_scale=height_scale,
        line_num_coeff=line,
        line_den_coeff=one,
        samp_num_coeff=samp,
        samp_den_coeff=one,
    )


RPCS = {
    "left": linear_rpc(0.65, -5.0, SIZES["left"]),
    "right": linear_rpc(0.80, 26.0, SIZES["right"]),
}


def write_image(path: Path, rpc: RPC, size: tuple[int, int]) -> Path:
    def text(value) -> str:
        return " ".join(repr(float(v)) for v in np.atleast_1d(value))

    tags = {name.upper(): text(value) for name, value in rpc.to_dict().items()}
    options = {"count": 1, "dtype": "uint16", "sparse_ok": True, "tiled": True}
    with rasterio.open(path, "w", driver="GTiff", width=size[0], height=size[1], **options) as ds:
        ds.update_tags(ns="RPC", ERR_BIAS="-1", ERR_RAND="-1", **tags)
    return path


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pair")
    return {v: write_image(folder / f"{v}.tif", RPCS[v], SIZES[v]) for v in ("left", "right")}


def make_gcps(n: int = 15, noise: float = 0.25, seed: int = 1, true=TRUE) -> list[dict]:
    """GCPs spread over the common ground, as rows of the CSV."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(n)))
    cells = rng.permutation(side * side)[:n]
    u, v = (cells % side + 0.5) / side - 0.5, (cells // side + 0.5) / side - 0.5
    jitter = rng.uniform(-0.3, 0.3, (2, n)) / side
    lon, lat = LON + 0.022 * (u + jitter[0]), LAT + 0.014 * (v + jitter[1])
    height = rng.uniform(30, 110, n)
    rows = []
    for i in range(n):
        row = {"id": f"G{i + 1:02d}", "lon": lon[i], "lat": lat[i], "height": height[i]}
        for view in ("left", "right"):
            col_row = SensorModel(RPCS[view], true[view]).project(lon[i], lat[i], height[i])
            col_row = np.array(col_row) + noise * rng.standard_normal(2)
            row[f"{view}_col"], row[f"{view}_row"] = col_row
        rows.append(row)
    return rows


def write_gcps(path: Path, rows: list[dict]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(
            {k: f"{v:.10f}" if isinstance(v, float) else v for k, v in row.items()} for row in rows
        )
    return path


def run(images, tmp_path, rows, **options) -> Alignment:
    file = write_gcps(tmp_path / "gcps.csv", rows)
    options.setdefault("provenance", {})
    return align(images["left"], images["right"], file, scene="Test-1", **options)


def corner_error(affine: np.ndarray, true: np.ndarray, size: tuple[int, int]) -> float:
    c, r = np.array([[0, size[0], 0, size[0]], [0, 0, size[1], size[1]]], float)
    return float(np.abs((affine - true) @ np.array([c, r, np.ones(4)])).max())


# ----------------------------------------------------------------------------------- recovery


@pytest.mark.parametrize("n", [4, 5, 15])
def test_known_affine_is_recovered_from_noise_free_points(images, tmp_path, n):
    result = run(images, tmp_path, make_gcps(n, noise=0.0))
    for fit in result.fits:
        assert corner_error(fit.affine, TRUE[fit.view], fit.size) < 1e-4
        assert not fit.left_out
        assert fit.sigma0 < 1e-4
    assert not result.warnings
    assert np.array_equal(result.left.affine, result.left_fit.affine)


@pytest.mark.parametrize("model", ["similarity", "shift"])
def test_simpler_models_are_recovered(images, tmp_path, model):
    turn = np.array([[1.0003, -0.0004, 5.0], [0.0004, 1.0003, -7.0]])
    moved = np.array([[1.0, 0.0, -9.5], [0.0, 1.0, 2.25]])
    true = dict.fromkeys(TRUE, turn if model == "similarity" else moved)
    result = run(images, tmp_path, make_gcps(8, noise=0.0, true=true), model=model)
    for fit in result.fits:
        assert corner_error(fit.affine, true[fit.view], fit.size) < 1e-4


def test_same_as_opencv_on_clean_points(images, tmp_path):
    """cv2.estimateAffine2D refines by Levenberg-Marquardt to a few 1e-3 px of the exact minimum."""
    result = run(images, tmp_path, make_gcps(15))
    for fit in result.fits:
        predicted = np.array([g.predicted for g in fit.gcps])
        measured = np.array([g.measured for g in fit.gcps])
        theirs, _ = cv2.estimateAffine2D(predicted, measured, refineIters=100)
        assert corner_error(fit.affine, theirs, fit.size) < 0.02


def test_good_points_with_noise_are_never_thrown_away():
    """300 random sets of 4 to 20 points with 0.25 px noise."""
    rng = np.random.default_rng(5)
    thrown = 0
    for k in range(300):
        n = int(rng.integers(4, 21))
        predicted = rng.uniform(0, 3000, (n, 2))
        measured = predicted + [5, -8] + 0.25 * rng.standard_normal((n, 2))
        used, _, _ = find_blunders(System.of("affine", predicted, measured), floor=1.25, seed=k)
        thrown += int((~used).sum())
    assert thrown == 0


def test_order_of_the_points_changes_nothing(images, tmp_path):
    rows = make_gcps(15)
    rows[4]["left_col"] += 20.0
    there = run(images, tmp_path, rows).to_dict()
    back = run(images, tmp_path, rows[::-1]).to_dict()
    for record in (there, back):
        del record["provenance"]
    assert there == back


def test_many_points_are_sampled_reproducibly(images, tmp_path):
    rows = make_gcps(64)
    for i in range(0, 64, 5):
        rows[i]["right_row"] += 15.0 + i
    results = [run(images, tmp_path, rows), run(images, tmp_path, rows[::-1])]
    assert [g.id for g in results[0].right_fit.left_out] == [
        f"G{i + 1:02d}" for i in range(0, 64, 5)
    ]
    assert np.array_equal(results[0].right.affine, results[1].right.affine)


# ----------------------------------------------------------------------------------- blunders


@pytest.mark.parametrize(("n", "blunders"), [(5, 1), (6, 1), (9, 2), (12, 3), (15, 4)])
def test_blunders_in_one_image_are_named_and_left_out_of_it_only(images, tmp_path, n, blunders):
    clean = run(images, tmp_path, make_gcps(n))
    rng = np.random.default_rng(n)
    rows = make_gcps(n)
    bad = rng.permutation(n)[:blunders]
    for i in bad:
        angle = rng.uniform(0, 2 * np.pi)
        rows[i]["left_col"] += 20 * np.cos(angle)
        rows[i]["left_row"] += 20 * np.sin(angle)
    result = run(images, tmp_path, rows)
    names = sorted(f"G{i + 1:02d}" for i in bad)
    assert [g.id for g in result.left_fit.left_out] == names
    assert result.right_fit.left_out == ()
    assert np.array_equal(result.right.affine, clean.right.affine)
    for gcp in result.left_fit.left_out:
        assert 14 < np.hypot(*gcp.after) < 26
        assert "this image only" in gcp.reason
        assert any(gcp.id in text and "left image" in text for text in result.warnings)


def test_wrong_ground_coordinate_is_left_out_of_both(images, tmp_path):
    rows = make_gcps(12)
    rows[7]["lat"] += 15.0 / 110950.0  # 15 m
    result = run(images, tmp_path, rows)
    for fit in result.fits:
        assert [g.id for g in fit.left_out] == ["G08"]
        assert "wrong ground coordinates" in fit.left_out[0].reason


def test_wrong_height_is_left_out_of_the_steep_view_too(images, tmp_path):
    rows = make_gcps(12)
    rows[7]["height"] += 12.0  # 7.3 px at 26 degrees, 1.6 px at 5 degrees
    result = run(images, tmp_path, rows)
    for fit in result.fits:
        assert [g.id for g in fit.left_out] == ["G08"]


def test_opencv_leaves_a_gross_blunder_out_too(images, tmp_path):
    rows = make_gcps(12)
    rows[3]["left_col"] += 20.0
    result = run(images, tmp_path, rows, estimator="opencv")
    assert "G04" in [g.id for g in result.left_fit.left_out]


def test_contradiction_among_four_points_is_refused(images, tmp_path):
    rows = make_gcps(4)
    rows[2]["left_col"] += 40.0
    with pytest.raises(InputError, match=r"left image left.tif.*4 GCPs contradict.*\bG03\b"):
        run(images, tmp_path, rows)


def test_too_many_blunders_are_refused(images, tmp_path):
    rows = make_gcps(14)
    for i in range(5):
        rows[i]["right_col"] += 50.0 * (i + 1)
    with pytest.raises(InputError, match=r"5 of 14 GCPs contradict the others \(G01, G02"):
        run(images, tmp_path, rows)


def test_points_of_another_place_are_refused(images, tmp_path):
    rng = np.random.default_rng(3)
    rows = make_gcps(12)
    for row in rows:
        row["left_col"] += rng.normal(0, 30)
        row["left_row"] += rng.normal(0, 30)
    with pytest.raises(InputError, match=r"contradict|do not fit"):
        run(images, tmp_path, rows)


# --------------------------------------------------------------------------------- statistics


def test_leave_one_out_is_that_of_fits_without_the_point(images, tmp_path):
    rows = make_gcps(9)
    result = run(images, tmp_path, rows)
    for model in ("affine", "similarity", "shift"):
        result = run(images, tmp_path, rows, model=model)
        for k, gcp in enumerate(result.left_fit.gcps):
            without = run(images, tmp_path, rows[:k] + rows[k + 1 :], model=model)
            predicted = without.left.affine @ (*gcp.predicted, 1.0)
            assert np.allclose(gcp.leave_one_out, gcp.measured - predicted, atol=1e-6)
            assert not without.left_fit.left_out


def covariance_at(fit, col, row) -> np.ndarray:
    """Covariance [..., 2, 2] in px² of the corrected (col, row), from the GCPs' measurement."""
    design = fit.design(col, row)
    return design @ fit.covariance @ np.swapaxes(design, -1, -2)


def test_covariance_predicts_the_spread_over_many_measurements(images, tmp_path):
    """Deviations at a corner over 200 sets of noise, against the predicted: within 20 %."""
    errors, predicted = [], []
    at = (3900.0, 100.0)
    for seed in range(200):
        rng = np.random.default_rng(seed)
        rows = make_gcps(15, noise=0.0)
        for row in rows:
            row["left_col"] += 0.25 * rng.standard_normal()
            row["left_row"] += 0.25 * rng.standard_normal()
        fit = run(images, tmp_path, rows).left_fit
        rpc = np.linalg.solve(TRUE["left"][:, :2], np.array(at) - TRUE["left"][:, 2])
        errors.append(fit.affine @ (*rpc, 1.0) - at)
        predicted.append(covariance_at(fit, *at))
    spread = np.std(errors, axis=0)
    expected = np.sqrt(np.mean(predicted, axis=0).diagonal())
    assert np.allclose(spread, expected, rtol=0.2)
    assert covariance_at(fit, np.zeros((3, 2)), 5.0).shape == (3, 2, 2, 2)


def test_json_keeps_everything(images, tmp_path):
    rows = make_gcps(10)
    rows[2]["left_col"] += 20.0
    rows[3]["right_col"] = rows[3]["right_row"] = ""
    result = run(images, tmp_path, rows)
    paths = [tmp_path / f"residuals.{ext}" for ext in ("json", "csv", "png")]
    write_alignment(result, *paths)
    again = Alignment.load(paths[0])
    assert again.to_dict() == result.to_dict()
    assert np.array_equal(again.left.packed(), result.left.packed())
    heights = [row["height"] for row in rows]  # each is used in one view at least
    assert again.reference_height == pytest.approx(np.mean(heights), abs=1e-3)
    assert json.loads(paths[0].read_text())["left"]["left_out"] == ["G03"]
    with paths[1].open() as stream:
        table = list(csv.DictReader(stream))
    assert len(table) == 19
    assert [row["id"] for row in table if row["used"] == "no"] == ["G03"]
    assert abs(float(table[0]["before_col_px"])) > 3 > abs(float(table[0]["after_col_px"]))
    assert cv2.imread(str(paths[2])).shape[0] > 800
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        ["gcps.csv", *(p.name for p in paths)]
    )


# ----------------------------------------------------------------------------------- refusals


def change(rows, **cells):
    rows[5].update(cells)
    return rows


def collinear(n: int = 12) -> list[dict]:
    rows = make_gcps(n, noise=0.0)
    for k, row in enumerate(rows):
        row["lon"], row["lat"] = LON + 0.001 * (k - n / 2), LAT + 0.0005 * (k - n / 2)
        row["height"] = HEIGHT
        for view in ("left", "right"):
            there = SensorModel(RPCS[view], TRUE[view]).project(row["lon"], row["lat"], HEIGHT)
            row[f"{view}_col"], row[f"{view}_row"] = map(float, there)
    return rows


@pytest.mark.parametrize(
    ("rows", "options", "message"),
    [
        (make_gcps(3), {}, r"3 GCPs.*'affine' needs 4.*'similarity' or 'shift'"),
        (make_gcps(2), {"model": "similarity"}, r"2 GCPs.*'similarity' needs 3.*to 'shift'"),
        (make_gcps(1), {"model": "shift"}, r"1 GCP,.*'shift' needs 2.*measure more GCPs"),
        (collinear(), {}, r"along one line.*'similarity' or 'shift'"),
        (change(make_gcps(), left_col=4100.0), {}, r"GCP G06 .*left\.tif of 4000 x 3000 px"),
        (change(make_gcps(), lon=LAT, lat=LON), {}, r"point G06.*seem to be swapped"),
        (
            [{**row, "lon": row["lon"] - 3} for row in make_gcps()],
            {},
            r"far from the ground.*lon 112\.\d+.*lon 115\.4",
        ),
        ([{**row, "lon": 512345.0} for row in make_gcps()], {}, r"no degrees.*projected"),
        (change(make_gcps(), height=123456.0), {}, r"123456 m is not of this Earth"),
        (change(make_gcps(), right_row=""), {}, r"G06: only one of right_col, right_row"),
        (change(make_gcps(), id="G03"), {}, r"lines 4 and 7 both have the id 'G03'"),
        (change(make_gcps(), id=""), {}, r"line 7: the id is empty"),
        (change(make_gcps(), lat="abc"), {}, r"line 7, point G06: lat 'abc' is no number"),
        (change(make_gcps(), lat="nan"), {}, r"lat 'nan' is no number"),
        (change(make_gcps(), height=""), {}, r"height is empty"),
        (
            change(make_gcps(), left_col="", left_row="", right_col="", right_row=""),
            {},
            r"point G06 is measured in neither image",
        ),
        ([], {}, r"no points in the file"),
        (
            [{**row, "left_row": 2999 - row["left_row"]} for row in make_gcps()],
            {},
            r"left image.*scale or angle by 200 %.*rows from the top",
        ),
        ([{**row, "height": row["height"] / 0.3048} for row in make_gcps()], {}, r"do not fit"),
        (
            [{**row, "right_col": "", "right_row": ""} for row in make_gcps()],
            {},
            r"right image right\.tif: 0 GCPs",
        ),
        (make_gcps(), {"model": "cubic"}, r"unknown alignment model 'cubic'"),
        (change(make_gcps(), left_col=500.0), {"strict": True}, r"GCP G06 left out.*strict"),
    ],
)
def test_refusals_name_file_and_remedy(images, tmp_path, rows, options, message):
    with pytest.raises(InputError, match=message) as caught:
        run(images, tmp_path, rows, **options)
    assert "Remedy: " in str(caught.value)
    if "unknown alignment model" not in message:
        assert str(caught.value).startswith(str(tmp_path / "gcps.csv"))
        assert "Test-1" in str(caught.value)


def test_too_few_after_blunders_names_them(images, tmp_path):
    rows = make_gcps(5)
    rows[1]["left_row"] += 30.0
    rows[0]["right_col"] = rows[0]["right_row"] = ""
    result = run(images, tmp_path, rows)  # four are left in each view
    assert [g.id for g in result.left_fit.left_out] == ["G02"]
    rows[0]["left_col"] = rows[0]["left_row"] = ""
    with pytest.raises(InputError, match="neither"):
        run(images, tmp_path, rows)


def test_without_gcps_the_rpcs_stand_with_their_uncertainty(images, tmp_path):
    alignment = from_rpcs(images["left"], images["right"], scene="S-1")
    assert (alignment.left.affine == np.eye(2, 3)).all()
    middle = covariance_at(alignment.left_fit, SIZES["left"][0] / 2, SIZES["left"][1] / 2)
    assert np.sqrt(np.diag(middle)) == pytest.approx([RPC_SHIFT] * 2, rel=1e-3)
    assert "no ground control points" in alignment.warnings[0]
    files = [tmp_path / name for name in ("a.json", "r.csv", "f.png")]
    write_alignment(alignment, *files)
    again = Alignment.load(files[0])
    assert again.to_dict() == alignment.to_dict()
    assert np.isnan(again.left_fit.sigma0) and np.isnan(again.left_fit.rms("after"))


def test_swapped_images_are_recognised(images, tmp_path):
    file = write_gcps(tmp_path / "gcps.csv", make_gcps())
    with pytest.raises(InputError, match="left_image and right_image seem to be swapped"):
        align(images["right"], images["left"], file, scene="Test-1")


def test_swapped_lon_lat_is_recognised_where_both_are_possible(tmp_path, images):
    """Near lon 30, lat 30 either could be either: only the images tell."""
    rpc = RPC.from_dict(RPCS["left"].to_dict() | {"long_off": 35.0})
    pair = [write_image(tmp_path / f"{v}.tif", rpc, SIZES["left"]) for v in ("left", "right")]
    rows = make_gcps()
    for row in rows:
        row["lon"], row["lat"] = row["lat"], row["lon"] - 80.4
    with pytest.raises(InputError, match="lon and lat of the GCPs seem to be swapped"):
        align(*pair, write_gcps(tmp_path / "gcps.csv", rows))


def test_single_point_elsewhere_is_left_out(images, tmp_path):
    rows = make_gcps()
    rows[5]["lon"] -= 1.0
    result = run(images, tmp_path, rows)
    assert len(result.left_fit.gcps) == 14
    assert any("G06 left out" in text for text in result.warnings)


def test_large_shift_and_tilt_are_doubted(images, tmp_path):
    true = {**TRUE, "left": TRUE["left"] + [[0.008, 0, 250.0], [0, 0, 0]]}
    result = run(images, tmp_path, make_gcps(true=true))
    assert any("off by" in text for text in result.warnings)
    assert any("scale or angle" in text for text in result.warnings)


# -------------------------------------------------------------------------------------- files


def test_files_of_spreadsheets_are_read(tmp_path):
    file = tmp_path / "gcps.csv"
    text = (
        "id, lon ,lat,height,left_col,left_row,right_col,right_row\r\n"
        ' B , 115.1,30.2, 5e1 ,"1.5", 2.5,,\r\n\r\n'
        "A,115.3,30.4,70,,,10,-0.25\r\n,,,,,,,\r\n"
    )
    file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    points = read_gcps(file)
    assert points.ids == ("A", "B")
    assert points.line == (4, 2)
    assert points.lon.tolist() == [115.3, 115.1]
    assert points.height.tolist() == [70.0, 50.0]
    assert points.left[1].tolist() == [1.5, 2.5]
    assert points.in_left.tolist() == [False, True]
    assert points.in_right.tolist() == [True, False]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "the file is empty"),
        ("id;lon;lat;height;left_col;left_row;right_col;right_row\n", "not separated by commas"),
        ("id,lon,lat,height,left_col,left_row,right_col\n", "'right_row' is missing"),
        (",".join(COLUMNS) + ",note\n", "'note' is unknown"),
        (",".join(COLUMNS) + "\nA,1,2,3,4,5,6\n", "line 2 has 7 cells for 8 columns"),
    ],
)
def test_malformed_files_are_refused(tmp_path, content, message):
    file = tmp_path / "gcps.csv"
    file.write_text(content)
    with pytest.raises(InputError, match=message):
        read_gcps(file, "Test-1")


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_gcps(tmp_path / "none.csv")
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00i")
    with pytest.raises(InputError, match="UTF-8"):
        read_gcps(tmp_path / "x.csv")
    with pytest.raises(InputError, match="no such alignment"):
        Alignment.load(tmp_path / "none.json")
    (tmp_path / "x.json").write_text("{}")
    with pytest.raises(InputError, match="not an alignment"):
        Alignment.load(tmp_path / "x.json")


# ---------------------------------------------------------------------------------- real scene


@pytest.mark.skipif(not MARSEILLE.is_dir(), reason="the shared real scene is not here")
def test_marseille():
    """Measured independently: right image off by (-1.192, 0.051) px, left by almost nothing."""
    result = align(MARSEILLE / "left.tif", MARSEILLE / "right.tif", MARSEILLE / "gcps.csv")
    middle = np.array([512.0, 512.0, 1.0])
    assert np.allclose(result.left.affine @ middle - 512, 0.0, atol=0.05)
    assert np.allclose(result.right.affine @ middle - 512, (-1.192, 0.051), atol=0.02)
    assert not result.warnings
    assert 79 < result.reference_height < 315
    with pytest.raises(InputError, match="swapped"):
        align(MARSEILLE / "right.tif", MARSEILLE / "left.tif", MARSEILLE / "gcps.csv")
