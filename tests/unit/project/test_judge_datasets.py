"""Commands that take any dataset: what they refuse, and what they hand on."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import sealed
from stereotruth.core.products.provenance import file_sha256
from stereotruth.core.products.rasters import read_disparity, write_tiff
from stereotruth.project.main import app


def call(*arguments):
    return CliRunner().invoke(app, [str(of) for of in arguments])


def test_errata_are_applied_to_a_folder(tmp_path):
    file = tmp_path / "data/a_LEFT_DSP.tif"
    file.parent.mkdir()
    write_tiff(file, np.full((4, 6), 2, np.float32), nodata=-999)
    tile = {"pair": "a", "disparity": "elsewhere/a_LEFT_DSP.tif"}
    tile |= {"disparity_sha256": file_sha256(file), "gain": -1.0, "gain_sigma": 0.0}
    tile |= {"pivot_px": 0.0, "field_px": [[0.25]], "sigma_px": [[0.01]]}
    (tmp_path / "delta").mkdir()
    said = sealed({"nodata": -999.0, "tiles": [tile], "not_mended": {}})
    (tmp_path / "delta/errata.json").write_text(said)
    done = call("errata", "apply", tmp_path / "delta", tmp_path / "data", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert (read_disparity(tmp_path / "out/a_LEFT_DSP.tif") == -1.75).all()
    again = call("errata", "apply", tmp_path / "delta", tmp_path / "data", tmp_path / "out")
    assert isinstance(again.exception, InputError)


@pytest.mark.parametrize("limits, layout", [((5, 5), "whu"), ((-64, 64), "none of them")])
def test_an_audit_of_nothing_is_refused(tmp_path, limits, layout):
    to = tmp_path / "audit"
    found = call("audit", tmp_path, layout, "--range", *limits, "--to", to)
    assert isinstance(found.exception, InputError) and not to.exists()
