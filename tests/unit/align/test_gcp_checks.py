"""Control points of another place, swapped images and axes, doubtful fits."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from stereotruth.align.align import align
from stereotruth.align.images import open_view
from stereotruth.core.errors import InputError
from stereotruth.sensor.rpc import RPC

from ...synthetic.surveyed_pair import RPCS, SIZES, TRUE, make_gcps, run, write_gcps, write_image


def test_points_of_another_place_are_refused(images, tmp_path):
    rng = np.random.default_rng(3)
    rows = make_gcps(12)
    for row in rows:
        row["left_col"] += rng.normal(0, 30)
        row["left_row"] += rng.normal(0, 30)
    with pytest.raises(InputError, match=r"contradict|do not fit"):
        run(images, tmp_path, rows)


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


def other_rpc(tmp_path, changes, **fields):
    """A pair whose left RPC is changed, in a file beside the image."""
    values = {k: np.array(v) for k, v in (RPCS["left"].to_dict() | fields).items()}
    for name, i, value in changes:
        values[name][i] = value
    pair = [write_image(tmp_path / f"{v}.tif", RPCS[v], SIZES[v]) for v in ("left", "right")]
    lines = []
    for name, value in values.items():
        many = value.ndim > 0
        lines += (
            [f"{name.upper()}_{i}: {float(v)!r}" for i, v in enumerate(value, 1)]
            if many
            else [f"{name.upper()}: {float(value)!r}"]
        )
    (tmp_path / "left_RPC.TXT").write_text("\n".join(lines))
    return pair


@pytest.mark.parametrize(
    ("changes", "fields", "message"),
    [
        ([], {"long_off": 15.0}, "left_RPC.TXT: this RPC leads to ground about lon 15.0"),
        ([("samp_num_coeff", 1, 0.0)], {}, "do not meet the ground|pixels would be"),
        ([("samp_num_coeff", 13, -1.0)], {}, "m long here and"),
        ([("line_den_coeff", 1, 3.0)], {}, "denominator vanishes|m long here"),
        ([], {"lat_scale": 2e-5}, "m long"),
        ([("samp_num_coeff", 0, 0.05), ("samp_num_coeff", 4, 0.1)], {}, r"RPC: left_RPC.TXT"),
    ],
)
def test_a_wrong_rpc_is_named_not_the_control_points(tmp_path, changes, fields, message):
    pair = other_rpc(tmp_path, changes, **fields)
    with pytest.raises(InputError, match=message) as error:
        align(*pair, write_gcps(tmp_path / "gcps.csv", make_gcps()), provenance={})
    assert "left_RPC.TXT" in str(error.value)


def test_the_rpc_as_it_is_passes(tmp_path):
    pair = other_rpc(tmp_path, [])
    align(*pair, write_gcps(tmp_path / "gcps.csv", make_gcps()), provenance={})


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
        with pytest.raises(InputError, match=r"left\.tif.*on a map grid and has an RPC.*Remedy"):
            open_view("left", image, "")
    else:
        open_view("left", image, "")
