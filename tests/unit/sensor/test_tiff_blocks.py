"""Damage in TIFFs that GDAL passes over."""

from __future__ import annotations

import re
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from stereotruth.core.products.rasters import open_raster
from stereotruth.sensor.tiff_blocks import _batches, damaged_block

GREY = np.random.default_rng(0).integers(0, 900, (200, 300)).astype(np.uint16)


def write(path, **options):
    shape = {"width": 300, "height": 200, "count": 1, "dtype": "uint16"}
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(path, "w", driver="GTiff", **shape, **options) as dataset,
    ):
        dataset.write(GREY, 1)
    return path


@pytest.mark.parametrize("bigtiff", ["YES", "NO"])
@pytest.mark.parametrize("endianness", ["LITTLE", "BIG"])
@pytest.mark.parametrize("options", [{}, {"tiled": True, "blockxsize": 64, "blockysize": 64}])
@pytest.mark.parametrize("compress", ["none", "deflate", "lzw"])
def test_places_and_checksums(tmp_path, bigtiff, endianness, options, compress) -> None:
    path = write(
        tmp_path / "a.tif", bigtiff=bigtiff, endianness=endianness, compress=compress, **options
    )
    assert damaged_block(path) == ""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert "past the end" in damaged_block(path) or "directory" in damaged_block(path)
    damaged = bytearray(data)
    damaged[len(data) - 2000] ^= 4
    path.write_bytes(damaged)
    assert bool(damaged_block(path, workers=2)) == (compress == "deflate")


def test_what_gdal_passes_over_is_found(tmp_path) -> None:
    """It reads some damaged blocks of float32 without a word, and gives other values."""
    grey = GREY.astype(np.float32)
    path = tmp_path / "a.tif"
    shape = {"width": 300, "height": 200, "count": 1, "dtype": "float32"}
    with open_raster(path, "w", driver="GTiff", **shape, compress="deflate", predictor=3) as target:
        target.write(grey, 1)
    good, silent = path.read_bytes(), 0
    for at in range(1000, 61_000, 1500):
        data = bytearray(good)
        data[at] ^= 16
        path.write_bytes(data)
        try:
            with open_raster(path) as dataset:
                same = np.array_equal(dataset.read(1), grey)
        except RasterioError:
            continue
        assert same or "is damaged" in damaged_block(path)
        silent += not same
    assert silent > 0


@pytest.mark.parametrize(
    ("compress", "tag", "value", "match"),
    [
        ("deflate", 279, 0, "a place or a size, but not both"),  # GDAL reads zeros
        ("none", 279, 60, "has 60 bytes, its pixels take"),
        ("none", 258, 1, "its pixels take"),
        ("lzw", 259, 1, "its pixels take"),
        ("deflate", 259, 1, "its pixels take"),
    ],
)
def test_sizes_that_do_not_go_together(tmp_path, compress, tag, value, match) -> None:
    path = write(tmp_path / "a.tif", compress=compress, blockysize=200)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, entry_of(data, tag) + 8, value)
    path.write_bytes(data)
    assert re.search(match, damaged_block(path))


def entry_of(data: bytes, wanted: int) -> int:
    """Where a tag stands in a small TIFF."""
    (start,) = struct.unpack_from("<I", data, 4)
    places = (start + 2 + 12 * k for k in range(struct.unpack_from("<H", data, start)[0]))
    return next(at for at in places if struct.unpack_from("<H", data, at)[0] == wanted)


@pytest.mark.parametrize("compress", ["none", "deflate", "lzw", "packbits"])
def test_two_strips_at_one_place_are_found(tmp_path, compress) -> None:
    """GDAL reads them in silence, the same rows twice."""
    path = write(tmp_path / "a.tif", compress=compress, blockysize=50)
    data = bytearray(path.read_bytes())
    (places,) = struct.unpack_from("<I", data, entry_of(data, 273) + 8)
    (sizes,) = struct.unpack_from("<I", data, entry_of(data, 279) + 8)
    kind, width = ("<H", 2) if data[entry_of(data, 279) + 2] == 3 else ("<I", 4)
    for table, code, step in ((places, "<I", 4), (sizes, kind, width)):
        (first,) = struct.unpack_from(code, data, table)
        struct.pack_into(code, data, table + 2 * step, first)
    path.write_bytes(data)
    with open_raster(path) as dataset:
        values = dataset.read(1)
    assert np.array_equal(values[:50], values[100:150])
    assert damaged_block(path) == "blocks 1 and 3 of 4 share bytes"


@pytest.mark.slow
def test_a_block_that_holds_more_than_its_pixels_is_found_in_little_memory(tmp_path) -> None:
    """A gigabyte of zeros in a megabyte of deflate."""
    path = write(tmp_path / "a.tif", compress="deflate", blockysize=200)
    packer = zlib.compressobj(9)
    bomb = b"".join(packer.compress(bytes(1 << 20)) for _ in range(1000)) + packer.flush()
    data = bytearray(path.read_bytes()) + bomb
    struct.pack_into("<I", data, entry_of(data, 273) + 8, len(data) - len(bomb))
    struct.pack_into("<I", data, entry_of(data, 279) + 8, len(bomb))
    path.write_bytes(data)
    tracemalloc.start()
    assert damaged_block(path) == "block 1 of 1 is damaged"
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 50e6


def test_many_blocks_are_read_a_few_at_a_time(tmp_path) -> None:
    path = write(tmp_path / "a.tif", tiled=True, blockxsize=16, blockysize=16, compress="deflate")
    assert damaged_block(path, workers=2) == ""
    counts = np.array([10, 70 << 20, 0, 0, 5] + [1] * 70)
    batches = list(_batches(counts))
    assert [k for batch in batches for k in batch] == list(range(75))
    assert all(len(b) <= 64 and (len(b) == 1 or counts[list(b)].sum() <= 64 << 20) for b in batches)


def test_sparse_files_and_other_formats_pass(tmp_path) -> None:
    path = tmp_path / "a.tif"
    with pytest.warns(NotGeoreferencedWarning):
        rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=900,
            height=900,
            count=1,
            dtype="uint16",
            sparse_ok=True,
            compress="deflate",
        ).close()
    assert damaged_block(path) == ""
    (tmp_path / "b.png").write_bytes(b"\x89PNG")
    assert damaged_block(tmp_path / "b.png") == ""


def test_a_last_strip_that_is_written_in_full_is_no_damage(tmp_path) -> None:
    path = write(tmp_path / "a.tif", blockysize=66)  # the last of four strips has two rows
    data = path.read_bytes()
    full, last = 66 * 300 * 2, 2 * 300 * 2
    kind = next(k for k in "HI" if struct.pack(f"<4{k}", full, full, full, last) in data)
    sizes = struct.pack(f"<4{kind}", full, full, full, last)
    path.write_bytes(data.replace(sizes, struct.pack(f"<4{kind}", *[full] * 4)) + bytes(full))
    assert damaged_block(path) == ""
    with open_raster(path) as dataset:
        assert (dataset.read(1) == GREY).all()
    path.write_bytes(data.replace(sizes, struct.pack(f"<4{kind}", full, last, full, last)))
    assert "block 2 has 1200 bytes" in damaged_block(path)
