"""Pictures within a page."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from stereotruth.products import pictures

from ...synthetic.reported_city import picture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.mark.parametrize("limit", [200, 2000, 20_000, 10**6])
def test_pictures_keep_within_their_bytes(limit):
    noise = np.random.default_rng(0).integers(0, 255, (300, 200, 3)).astype(np.uint8)
    for image in (noise, noise[..., 0]):
        data = base64.b64decode(pictures.encode(image, limit).partition(",")[2])
        assert len(data) <= limit
    shape = picture(pictures.encode(noise, limit)).shape
    assert shape[0] / shape[1] == pytest.approx(1.5, rel=0.2)
    assert (shape == noise.shape) == (limit == 10**6)
