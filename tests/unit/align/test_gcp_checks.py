"""Control points of another place, swapped images and axes, wrong RPCs, doubtful fits."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from stereotruth.align.align import align
from stereotruth.align.gcp_checks import System, find_blunders
from stereotruth.align.images import open_view
from stereotruth.core.errors import InputError
from stereotruth.sensor.rpc import RPC

from ...synthetic.surveyed_pair import RPCS, SIZES, TRUE, make_gcps, run, write_gcps, write_image


@pytest.mark.slow
def test_good_points_with_noise_are_never_thrown_away():
    """300 random sets of 4 to 20 points with 0.25 px noise."""
    rng = np.random.default_rng(5)
    thrown = 0
    for _ in range(300):
        n = int(rng.integers(4, 21))
        predicted = rng.uniform(0, 3000, (n, 2))
        measured = predicted + [5, -8] + 0.25 * rng.standard_normal((n, 2))
        used, _, _ = find_blunders(System.of("affine", predicted, measured))
        thrown += int((~used).sum())
    assert thrown == 0


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


@pytest.mark.parametrize(
    ("changes", "fields"),
    [
        ([], {"long_off": 15.0}),
        ([("samp_num_coeff", 1, 0.0)], {}),
        ([("samp_num_coeff", 13, -1.0)], {}),
        ([("line_den_coeff", 1, 3.0)], {}),
        ([], {"lat_scale": 2e-5}),
        ([("samp_num_coeff", 0, 0.05), ("samp_num_coeff", 4, 0.1)], {}),
        ([], None),
    ],
)
def test_a_wrong_rpc_is_named_not_the_control_points(tmp_path, changes, fields):
    """A pair whose left RPC is changed, in a file beside the image; the last is as it should be."""
    values = {k: np.array(v) for k, v in (RPCS["left"].to_dict() | (fields or {})).items()}
    for name, i, value in changes:
        values[name][i] = value
    pair = [write_image(tmp_path / f"{v}.tif", RPCS[v], SIZES[v]) for v in ("left", "right")]
    lines = []
    for name, value in values.items():
        lines += (
            [f"{name.upper()}_{i}: {float(v)!r}" for i, v in enumerate(value, 1)]
            if value.ndim
            else [f"{name.upper()}: {float(value)!r}"]
        )
    (tmp_path / "left_RPC.TXT").write_text("\n".join(lines))
    gcps = write_gcps(tmp_path / "gcps.csv", make_gcps())
    if fields is None:
        align(*pair, gcps, provenance={})
        return
    with pytest.raises(InputError) as error:
        align(*pair, gcps, provenance={})
    assert "left_RPC.TXT" in str(error.value) and "Remedy: " in str(error.value)


@pytest.mark.parametrize(
    ("turned_deg", "moved_m"), [(0.0, 0.0), (0.0, 20.0), (3.0, 0.0), (0.0, 400.0)]
)
def test_an_image_on_a_map_grid_may_have_the_rpc_of_that_grid(tmp_path, turned_deg, moved_m):
    """As images that were projected to a plane; not one that was brought to a map later."""
    image = write_image(tmp_path / "left.tif", RPCS["left"], SIZES["left"])
    lon, lat = RPCS["left"].localize([0, 1, 0], [0, 0, 1], 160.0)  # of another height than its own
    at = Affine(lon[1] - lon[0], 0, lon[0] + moved_m / 96e3, 0, lat[2] - lat[0], lat[0])
    with rasterio.open(image, "r+") as dataset:
        dataset.crs = "EPSG:4326"
        dataset.transform = at * Affine.rotation(turned_deg) * Affine.translation(-0.5, -0.5)
    if turned_deg or moved_m > 100:
        with pytest.raises(InputError, match=r"left\.tif.*Remedy"):
            open_view("left", image, "")
    else:
        open_view("left", image, "")
