"""Planted faults in surface models of a town that is a formula; sums of errors against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio.transform import from_origin
from rasterio.warp import reproject
from scipy.ndimage import gaussian_filter

from stereobench.scores.paired import compare_folders
from stereotruth.core.errors import InputError
from stereotruth.evaluate.surface_models import score
from stereotruth.evaluate.surface_models.reference import RasterReference
from stereotruth.evaluate.surface_models.score import (
    OPEN,
    SOLID,
    HeightErrors,
    score_surface_model,
    write_verdict,
)

from ....synthetic.analytic_town import (
    CELL_M,
    EPSG,
    NORTH,
    SIDE,
    TO_WGS84,
    WEST,
    Points,
    Town,
    write,
)
from ....synthetic.exact_surface import write_heights

TOWN = Town(trees=True)
SHIFT = (2.37, -1.41, 0.83)


@pytest.fixture(scope="module")
def points() -> Points:
    return Points(TOWN)


@pytest.fixture(scope="module")
def judge(points, tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")

    def judged(heights, reference=points, sigmas=False, **options):
        """``sigmas``: with standard uncertainties, which take most of the time."""
        with pytest.MonkeyPatch.context() as patch:
            if not sigmas:
                patch.setattr(score, "GROUPS", 2)  # of the jackknife: too few for them
            model = write(folder / "model.tif", heights)
            return score_surface_model(model, reference, **options).figures()

    return judged


@pytest.fixture(scope="module")
def exact(judge):
    return judge(TOWN.heights())


def off(found: dict) -> float:
    return found["errors"][OPEN]["mean_absolute_m"]


def test_an_exact_model_lies_where_it_is_and_has_the_points_noise(exact):
    moved = exact["registration"]
    assert moved["edges"] > 100
    for name in ("east_m", "north_m"):
        assert abs(moved[name]) < 0.03
    assert abs(moved["up_m"]) < 0.01
    errors = exact["errors"]
    assert errors["ground, off steps"]["nmad_m"] == pytest.approx(0.03, abs=0.01)
    assert errors["buildings, off steps"]["nmad_m"] == pytest.approx(0.03, abs=0.01)
    assert errors[SOLID]["known_share"] > 0.99
    # sharp edges between cells of 0.5 m: a quarter of a cell on the ramp, as much by its place
    assert 0.05 < exact["edges"]["position_error_m"] < 0.25
    assert abs(exact["edges"]["outward_m"]) < 0.05
    assert exact["edges"]["missing_share"] == 0
    assert exact["edges"]["resolution_m"] == pytest.approx(CELL_M, abs=0.1)


@pytest.mark.slow
def test_a_planted_shift_a_tilt_and_wide_roofs_are_told_apart(judge):
    x = (np.arange(round(SIDE / CELL_M)) + 0.5) * CELL_M
    model = TOWN.heights(*SHIFT[:2], wider_m=1.0) + SHIFT[2] + 0.004 * (x - SIDE / 2)
    found = judge(model, sigmas=True)
    moved = found["registration"]
    for name, planted in zip(("east_m", "north_m", "up_m"), SHIFT):
        error = moved[name] - planted
        assert abs(error) < 0.05
        assert 0 < moved[f"sigma_{name}"] < 0.05
        assert abs(error) < 5 * moved[f"sigma_{name}"] + 0.01
    assert moved["tilt_east_m_per_km"] == pytest.approx(4.0, abs=0.2)
    assert abs(moved["tilt_north_m_per_km"]) < 0.2
    assert found["as_delivered"]["mean_absolute_m"] > 0.8
    assert found["edges"]["outward_m"] == pytest.approx(1.0, abs=0.1)
    assert found["edges"]["resolution_m"] == pytest.approx(CELL_M, abs=0.1)


@pytest.mark.slow
def test_hills_without_roofs_tell_the_shift_too(judge):
    hills = Town(boxes=0, hills_m=3.0)
    model = hills.heights(*SHIFT[:2]) + SHIFT[2]
    found = judge(model, Points(hills), sigmas=True)["registration"]
    assert found["edges"] == 0
    for name, planted in zip(("east_m", "north_m", "up_m"), SHIFT):
        assert abs(found[name] - planted) < 0.05
        assert abs(found[name] - planted) < 5 * found[f"sigma_{name}"] + 0.01


@pytest.mark.slow
def test_a_blur_shows_at_the_edges_and_hardly_elsewhere(judge, exact):
    found = judge(gaussian_filter(TOWN.heights(), 1.0 / CELL_M))
    # of a sharp edge: the mean of |Φ⁻¹(p)| over p from 0.1 to 0.9; cells blur it a little more
    assert found["edges"]["position_error_m"] == pytest.approx(0.5586, abs=0.08)
    assert abs(found["edges"]["outward_m"]) < 0.05
    more = found["edges"]["position_error_m"] - exact["edges"]["position_error_m"]
    assert more > 5 * abs(off(found) - off(exact))
    assert found["edges"]["resolution_m"] == pytest.approx(np.hypot(2.3548, CELL_M), abs=0.1)
    assert abs(found["registration"]["east_m"]) < 0.05


@pytest.mark.slow
def test_models_of_other_grids_compare_by_tiles_of_the_ground(points, tmp_path):
    """A model against itself a row and a column further is level; a blurred one is not."""
    heights = TOWN.heights()
    folders = {}
    for name, of in (
        ("exact", heights), ("cut", heights[20:, 30:]), ("blurred", gaussian_filter(heights, 2)),
    ):  # fmt: skip
        west, north = (WEST + 15, NORTH - 10) if name == "cut" else (WEST, NORTH)
        model = write_heights(tmp_path / f"{name}.tif", of, west, north, CELL_M, EPSG)
        folders[name] = tmp_path / name
        write_verdict(score_surface_model(model, points), folders[name], name)
    level = compare_folders([folders["exact"]], [folders["cut"]])
    told = compare_folders([folders["exact"]], [folders["blurred"]])
    assert [": level" in line for line in level] == [True, True, True]
    assert [": worse" in line for line in told[1:]] == [True, True]


def test_lost_roofs_are_missing_edges_and_bare_trees_stand_apart(judge, exact):
    heights = Town().heights()  # as in winter
    half = heights.shape[1] // 2
    heights[:, :half] = Town(boxes=0).heights()[:, :half]
    found = judge(heights)
    edges = found["edges"]
    assert 0.35 < edges["missing_share"] < 0.65
    # of the rest
    assert edges["position_error_m"] == pytest.approx(exact["edges"]["position_error_m"], abs=0.05)
    assert found["errors"]["trees"]["mean_m"] == pytest.approx(-6.0, abs=0.3)


@pytest.mark.slow
def test_a_reference_raster_serves_and_degrees_too(exact, tmp_path):
    """The model in degrees, by nearest neighbours; the reference in UTM, finer, unclassified."""
    n = round(SIDE / 0.4)
    row, col = np.mgrid[:n, :n]
    truth, _ = TOWN.surface((col + 0.5) * 0.4, (row + 0.5) * 0.4)
    options = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": -9999.0}
    with rasterio.open(
        tmp_path / "truth.tif", "w", width=n, height=n, crs=EPSG,
        transform=from_origin(WEST, NORTH, 0.4, 0.4), **options,
    ) as target:  # fmt: skip
        target.write(truth.astype(np.float32), 1)
    model = write(tmp_path / "model.tif", TOWN.heights(*SHIFT[:2]) + SHIFT[2])
    with rasterio.open(model) as source:
        west, south, east, north = rasterio.warp.transform_bounds(source.crs, 4326, *source.bounds)
        transform = from_origin(west, north, 4e-6, 4e-6)
        out = np.full(
            (round((north - south) / 4e-6), round((east - west) / 4e-6)), -9999.0, np.float32
        )
        reproject(rasterio.band(source, 1), out, dst_transform=transform, dst_crs=4326,
                  dst_nodata=-9999.0)  # fmt: skip
    size = {"width": out.shape[1], "height": out.shape[0]}
    degrees = tmp_path / "degrees.tif"
    with rasterio.open(degrees, "w", crs=4326, transform=transform, **size, **options) as target:
        target.write(out, 1)
    found = score_surface_model(degrees, RasterReference(tmp_path / "truth.tif")).figures()
    for name, planted in zip(("east_m", "north_m", "up_m"), SHIFT):
        assert abs(found["registration"][name] - planted) < 0.05
    assert found["edges"]["edges"] > 100
    assert "trees" not in found["errors"]  # nothing tells them


def test_what_cannot_be_judged_is_refused(judge, points, tmp_path):
    with pytest.raises(InputError, match="no raster"):
        score_surface_model(tmp_path / "none.tif", points)
    away = write(tmp_path / "away.tif", np.full((200, 200), np.nan))
    with pytest.raises(InputError, match="no place has both"):
        score_surface_model(away, points)
    options = {"driver": "GTiff", "count": 1, "dtype": "float32", "width": 20, "height": 20}
    for name, given, words in (
        ("bare", {"transform": from_origin(WEST, NORTH, 1, 1)}, "coordinate system"),
        ("turned", {"crs": EPSG, "transform": rasterio.Affine(1, 0.5, WEST, 0.5, -1, NORTH)},
         "north-up"),
        ("levelled", {"crs": "EPSG:32650+5773", "transform": from_origin(WEST, NORTH, 1, 1)},
         "EGM96"),
    ):  # fmt: skip
        path = tmp_path / f"{name}.tif"
        with rasterio.open(path, "w", **options, **given) as target:
            target.write(np.zeros((20, 20), np.float32), 1)
        with pytest.raises(InputError, match=words):
            score_surface_model(path, points)


def test_figures_are_those_of_all_errors():
    rng = np.random.default_rng(0)
    errors = rng.normal(0.4, 1.3, 20_000)
    errors[:3000] = np.nan
    of = HeightErrors()
    for part in np.array_split(errors, 7):
        of.add(part)
    known = errors[3000:]
    found = of.figures()
    assert found["points"] == 20_000
    assert found["known_share"] == pytest.approx(0.85)
    assert found["mean_m"] == pytest.approx(known.mean(), abs=1e-4)
    assert found["mean_absolute_m"] == pytest.approx(np.abs(known).mean(), abs=1e-4)
    assert found["rms_m"] == pytest.approx(np.sqrt((known**2).mean()), abs=1e-4)
    median = np.median(known)
    assert found["median_m"] == pytest.approx(median, abs=0.006)
    assert found["nmad_m"] == pytest.approx(1.4826 * np.median(np.abs(known - median)), abs=0.02)
    assert found["le90_m"] == pytest.approx(np.quantile(np.abs(known), 0.9), abs=0.01)
    assert found["share_over_1_m"] == pytest.approx((np.abs(known) > 1).mean(), abs=1e-4)


@pytest.mark.slow
def test_holes_and_spikes_are_counted(judge):
    heights, rng = TOWN.heights(), np.random.default_rng(0)
    heights[100:220, 150:300] = np.nan
    share = 120 * 150 / heights.size
    spikes = rng.random(heights.shape) < 0.002
    found = judge(np.where(spikes, heights + 25.0, heights))
    assert 1 - found["errors"][SOLID]["known_share"] == pytest.approx(share, abs=0.01)
    # a cell that is off takes part in the heights of four squares
    assert 0.003 < found["errors"][OPEN]["share_over_3_m"] < 0.01
    assert found["errors"][OPEN]["nmad_m"] < 0.05


@pytest.mark.slow
def test_slopes_are_told(judge):
    steep = Town(boxes=0, hills_m=12.0)  # up to 12/17 of slope: 45 degrees and less
    errors = judge(steep.heights(), Points(steep))["errors"]
    total = sum(of["points"] for name, of in errors.items() if name.startswith("ground, slope"))
    assert total > 0.9 * errors[OPEN]["points"]
    assert errors["ground, slope 30–90°"]["points"] > 0.1 * total


@pytest.mark.slow
def test_a_geoid_left_out_is_a_shift_up(judge, tmp_path):
    lon, lat = TO_WGS84.transform(WEST, NORTH)
    grid = tmp_path / "geoid.tif"
    options = {"driver": "GTiff", "count": 1, "dtype": "float32", "crs": "EPSG:4326"}
    with rasterio.open(
        grid, "w", width=9, height=9, transform=from_origin(lon - 1, lat + 1, 0.25, 0.25), **options
    ) as target:
        target.write(np.full((9, 9), -17.0, np.float32), 1)
    orthometric = TOWN.heights() + 17.0
    assert judge(orthometric)["registration"]["up_m"] == pytest.approx(17.0, abs=0.01)
    assert abs(judge(orthometric, geoid=grid)["registration"]["up_m"]) < 0.01
