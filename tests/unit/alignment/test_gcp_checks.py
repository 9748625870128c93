"""Control points of another place, swapped images and axes, doubtful fits."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.alignment.align import align
from stereotruth.epipolar.rpc import RPC
from stereotruth.errors import InputError

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
