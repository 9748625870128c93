"""Disparity maps of other programs: what is too large or no map is refused before it is read."""

from __future__ import annotations

import tracemalloc

import cv2
import numpy as np
import pytest
import rasterio

from stereobench.methods.user_methods import read_result
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import image_shape, read_disparity, read_image

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
MAP = np.arange(12, dtype=np.float32).reshape(3, 4)


def sparse(path, side):
    """A small TIFF of many pixels."""
    shape = {"width": side, "height": side, "count": 1, "dtype": "float32"}
    blocks = {"tiled": True, "blockxsize": 8192, "blockysize": 8192, "sparse_ok": True}
    rasterio.open(path, "w", driver="GTiff", **shape, **blocks, BIGTIFF="YES").close()
    return path


def test_maps_are_read(tmp_path):
    np.save(tmp_path / "a.npy", MAP)
    cv2.imwrite(str(tmp_path / "a.pfm"), MAP)
    for name in ("a.npy", "a.pfm"):
        assert np.array_equal(read_result(tmp_path / name), MAP)
    assert np.isnan(read_result(tmp_path / "a.npy", nodata=5.0)[1, 1])


@pytest.mark.parametrize("scale", [-1.0, -1 / 255, 1.0, 1 / 255, 256.0])
def test_the_scale_of_a_pfm_is_the_order_of_its_bytes(tmp_path, scale):
    """-1/255 is the default of Middlebury's SDK; the format knows no unit."""
    data = (MAP + 10.5)[::-1].astype("<f4" if scale < 0 else ">f4").tobytes()
    (tmp_path / "a.pfm").write_bytes(b"Pf\n4 3\n%f\n" % scale + data)
    assert np.array_equal(read_result(tmp_path / "a.pfm"), MAP + 10.5)


def tiff(path, *bands, scale=1.0, offset=0.0, nodata=None):
    shape = {"width": 4, "height": 3, "count": len(bands), "dtype": bands[0].dtype}
    with rasterio.open(path, "w", driver="GTiff", nodata=nodata, **shape) as target:
        target.scales, target.offsets = (scale,) * len(bands), (offset,) * len(bands)
        target.write(np.array(bands))
    return path


def test_scale_offset_and_fill_of_a_tiff_count(tmp_path):
    stored = (16 * MAP).astype(np.int16)
    stored[1, 2] = -32768
    found = read_result(tiff(tmp_path / "a.tif", stored, scale=1 / 16, offset=-8, nodata=-32768))
    assert np.isnan(found[1, 2])
    np.testing.assert_array_equal(np.delete(found.ravel(), 6), np.delete(MAP.ravel() - 8, 6))


@pytest.mark.parametrize("bands", [[MAP, MAP], [MAP] * 3, [MAP.astype(np.complex64)]])
def test_other_bands_are_no_disparities(tmp_path, bands):
    with pytest.raises(InputError, match=r"a\.tif: .* are no disparity map.*Remedy"):
        read_result(tiff(tmp_path / "a.tif", *bands))


def test_a_png_of_8_bits_has_no_disparities(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), (256 * MAP).astype(np.uint16))
    cv2.imwrite(str(tmp_path / "b.png"), MAP.astype(np.uint8))
    found = read_disparity(tmp_path / "a.png")
    assert np.isnan(found[0, 0]) and np.array_equal(found.ravel()[1:], MAP.ravel()[1:])
    with pytest.raises(InputError, match=r"b\.png: a PNG of uint8 has no disparities.*16 bits"):
        read_disparity(tmp_path / "b.png")


@pytest.mark.parametrize("read", [read_result, read_image, image_shape])
def test_an_image_of_more_pixels_than_memory_holds_is_refused(tmp_path, read):
    with pytest.raises(InputError, match=r"a\.tif: 400000 x 400000 x 1 values are more"):
        read(sparse(tmp_path / "a.tif", 400_000))


@pytest.mark.parametrize(
    "header", [b"Pf\n99999999 99999999\n-1\n", b"Pf\n16000 16000\n-1\n", b"Pf\n-3 4\n-1\n"]
)
def test_a_pfm_that_is_smaller_than_it_says_is_refused(tmp_path, header):
    (tmp_path / "a.pfm").write_bytes(header + bytes(100))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"a\.pfm: (no image|.* more than are read)"):
        read_result(tmp_path / "a.pfm")
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_what_is_no_map_is_refused(tmp_path):
    for name, content in (
        ("a.npy", b"\x93NUMPY"),
        ("b.npy", b""),
        ("c.pfm", b""),
        ("d.pfm", b"Pf\nx y\n1\n"),
        ("e.pfm", b"P7" + bytes(50)),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="no image that can be read"):
            read_result(tmp_path / name)
    np.save(tmp_path / "o.npy", np.array([{}]), allow_pickle=True)
    np.save(tmp_path / "s.npy", np.array([["a"]]))
    np.savez(tmp_path / "z.npz", MAP)
    (tmp_path / "z.npz").rename(tmp_path / "z.npy")
    huge = np.lib.format.header_data_from_array_1_0(MAP) | {"shape": (10**6, 10**6)}
    with (tmp_path / "h.npy").open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, huge)
    for name in ("o.npy", "s.npy", "z.npy", "h.npy"):
        with pytest.raises(InputError, match=r"no image that can be read"):
            read_result(tmp_path / name)
