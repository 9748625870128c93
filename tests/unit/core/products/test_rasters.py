"""Images and labels as they are read from files."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import (
    image_shape,
    read_disparity,
    read_image,
    write_disparity,
)

from ....synthetic.images import write
from ....synthetic.other_programs import PROGRAMS

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_images_are_grey_or_colour(tmp_path):
    grey = np.arange(24, dtype=np.uint16).reshape(4, 6)
    colour = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    assert np.array_equal(read_image(write(tmp_path / "a.tif", grey)), grey)
    assert np.array_equal(read_image(write(tmp_path / "b.tif", colour)), colour)
    assert image_shape(tmp_path / "b.tif") == (4, 6)
    real = np.array([[1.5, np.nan]], np.float64)
    found = read_image(write(tmp_path / "c.tif", real))
    assert found.dtype == np.float32 and found.tolist() == [[1.5, 0.0]]
    with pytest.raises(InputError, match="2 bands"):
        read_image(write(tmp_path / "d.tif", colour[..., :2]))
    (tmp_path / "e.tif").write_bytes(b"no image")
    with pytest.raises(InputError, match="no image that can be read"):
        read_image(tmp_path / "e.tif")


def test_images_that_are_cut_short_are_refused(tmp_path):
    path = write(tmp_path / "a.tif", np.random.default_rng(0).random((300, 300)), compress="lzw")
    path.write_bytes(path.read_bytes()[:400_000])
    for read in (read_image, read_disparity):
        with pytest.raises(InputError, match=r"a.tif: no image that can be read"):
            read(path)


@pytest.mark.parametrize("bits", [16, 32])  # the published files have 16
def test_labels_are_nan_where_there_are_none(tmp_path, bits):
    values = np.array([[1.5, -999], [np.inf, -7]], np.float32)
    found = read_disparity(write(tmp_path / "d.tif", values, nodata=-7, nbits=bits), -999)
    assert found.dtype == np.float32
    assert np.array_equal(found, [[1.5, np.nan], [np.nan, np.nan]], equal_nan=True)


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_opens_the_disparity_map_of_a_method(tmp_path, program):
    values = np.linspace(-40, 60, 300 * 170, dtype=np.float32).reshape(300, 170)
    values[::7, ::5] = np.nan
    write_disparity(tmp_path / "d.tiff", values)
    found = PROGRAMS[program](tmp_path / "d.tiff")
    assert found.dtype == np.float32 and np.array_equal(found, values, equal_nan=True)
