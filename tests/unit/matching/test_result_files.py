"""Disparity maps of other programs: what is too large or no map is refused before it is read."""

from __future__ import annotations

import tracemalloc

import cv2
import numpy as np
import pytest
import rasterio

from stereotruth.errors import InputError
from stereotruth.matching.result_files import read_result
from stereotruth.products.rasters import image_shape, read_image

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
