"""Original images as the stages read them."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from stereotruth.epipolar.image_reader import Source


def test_several_bands(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "rgb.tif"
    shape = {"width": 9, "height": 8, "count": 3, "dtype": "uint8", "photometric": "RGB"}
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(path, "w", driver="GTiff", **shape) as dataset,
    ):
        dataset.write(np.full((3, 8, 9), 5, dtype=np.uint8))
    with caplog.at_level(logging.WARNING, "stereotruth"), Source(path) as source:
        assert source.size == (9, 8)
        assert source.read(2, 1, 4, 3).shape == (3, 4)
    assert "rgb.tif has 3 bands; band 1 (red) is used" in caplog.text
