"""Headers against what ingest finds in the points."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar.ingest import ingest, survey

from ...synthetic.las import write_las


def test_a_header_says_what_the_points_are(tmp_path):
    file = tmp_path / "a.laz"
    write_las(file, 5000)
    found, read = survey(file), ingest(file, tmp_path / "a.points")
    assert found.points == read["points"]["read"]
    box, points = np.array(found.box), np.array(read["bounds"])
    np.testing.assert_allclose(box, points[:4], atol=1e-6)  # corners of a box turned in degrees
    assert (box[:2] <= points[:2]).all() and (box[2:] >= points[2:4]).all()
    np.testing.assert_allclose(found.heights, points[4:], atol=1e-3)
    assert found.notes == tuple(read["notes"])
    assert found.surface == read["crs"]["heights"]
    assert found.area_m2 == pytest.approx(700 * 700, rel=0.01)


def test_what_ingest_refuses_of_a_header_is_refused(tmp_path):
    file = tmp_path / "a.laz"
    write_las(file, 500, system=None)
    with pytest.raises(InputError, match="no coordinate reference system"):
        survey(file)
    assert survey(file, lidar_crs="EPSG:32650").system.startswith("WGS 84 / UTM zone 50N")
