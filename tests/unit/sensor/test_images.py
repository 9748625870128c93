"""Original images as the stages read them."""

from __future__ import annotations

import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError

from stereotruth.core.config.configuration import Rectify
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import open_raster
from stereotruth.sensor.images import Source, bands_of, damaged_block, open_pair

from ...synthetic.images import pattern, write_image

X, Y = np.meshgrid(np.arange(96.0), np.arange(80.0))
GREY = pattern(X / 2, Y / 2).round()


def write(path: Path, *bands: np.ndarray, mask: np.ndarray | None = None, **options) -> Path:
    write_image(path, None, np.stack(bands), **options)
    if mask is not None:  # in a file of its own
        with open_raster(path, "r+") as dataset:
            dataset.write_mask(mask)
    return path


def pixels(path: Path) -> tuple[np.ndarray, float]:
    with Source(path) as source:
        return source.read(0, 0, *source.size), source.gain


def holes(path: Path) -> np.ndarray:
    return np.isnan(pixels(path)[0])


@pytest.mark.parametrize(("dtype", "fill"), [("int16", -9999), ("float64", -1e38)])
def test_undeclared_fill_values_have_no_value(tmp_path, dtype, fill, caplog) -> None:
    """They were valid pixels of 1."""
    values = GREY.astype(dtype)
    values[10:20, 30:50] = fill
    path = write(tmp_path / "a.tif", values)
    with caplog.at_level(logging.WARNING, "stereotruth"):
        got, gain = pixels(path)
    np.testing.assert_array_equal(np.isnan(got), values == fill)
    np.testing.assert_array_equal(got[~np.isnan(got)], GREY[values != fill].astype(np.float32))
    assert gain == 1
    assert caplog.text.count("taken as nodata; declare its nodata value") == 1


def test_a_hot_pixel_does_not_flatten_the_image(tmp_path, caplog) -> None:
    values = (GREY / 4096).astype(np.float32)
    values[40, 40], values[5, 5] = 3e30, -0.0001  # a hot pixel, noise
    with caplog.at_level(logging.WARNING, "stereotruth"):
        got, gain = pixels(write(tmp_path / "a.tif", values))
    assert 1000 < np.delete(got.ravel(), 40 * 96 + 40).max() < 15000
    assert got[values < 1e30] == pytest.approx(values[values < 1e30] * gain, rel=1e-6)
    assert "hot pixels" in caplog.text and np.isfinite(got).all()


def test_wide_integers_do_not_saturate(tmp_path) -> None:
    dtype = "uint32"
    values = (GREY * 1000).astype(dtype)
    got, gain = pixels(write(tmp_path / "a.tif", values))
    assert gain == pytest.approx(10000 / values.max())
    np.testing.assert_allclose(got, values * gain, rtol=1e-6)
    assert pixels(write(tmp_path / "b.tif", GREY.astype(dtype)))[1] == 1  # as they are


def test_what_a_mask_hides_has_no_value(tmp_path) -> None:
    mask = np.full(GREY.shape, 255, np.uint8)
    mask[3:9, 4:8] = 0
    path = write(tmp_path / "a.tif", GREY.astype(np.uint16), mask=mask)
    np.testing.assert_array_equal(holes(path), mask == 0)


def test_what_is_transparent_has_no_value(tmp_path) -> None:
    nodata = 5
    values, alpha = GREY.astype(np.uint16), np.full(GREY.shape, 65535, np.uint16)
    alpha[3:9, 4:8] = 0
    values[30, 30] = 5
    path = write(tmp_path / "a.tif", values, alpha, alpha="yes", nodata=nodata)
    expected = alpha == 0
    expected[30, 30] = True
    np.testing.assert_array_equal(holes(path), expected)


def test_a_file_that_fetches_its_pixels_is_no_image(tmp_path) -> None:
    """Whatever its name: GDAL would make requests, and read any file."""
    write(tmp_path / "b.tif", GREY.astype(np.uint16))
    (tmp_path / "a.tif").write_text(
        '<VRTDataset rasterXSize="96" rasterYSize="80"><VRTRasterBand dataType="UInt16" band="1">'
        '<SimpleSource><SourceFilename relativeToVRT="1">b.tif</SourceFilename><SourceBand>1'
        "</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with pytest.warns(NotGeoreferencedWarning), rasterio.open(tmp_path / "a.tif") as dataset:
        assert dataset.driver == "VRT"
    with pytest.raises(InputError, match=r"a.tif: not a raster that GDAL can read"):
        Source(tmp_path / "a.tif")


def test_what_a_mask_file_hides_is_not_read(tmp_path) -> None:
    """Not zero: masked. Who asks for the mask gets the values under it, too."""
    cloud = np.zeros(GREY.shape, np.uint8)
    cloud[10:20, 30:50], cloud[40, 40] = 255, 1
    path = write(tmp_path / "a.tif", GREY.astype(np.uint16))
    mask = write(tmp_path / "cloud.tif", cloud)
    with Source(path, mask) as source:
        assert source.masks
        np.testing.assert_array_equal(np.isnan(source.read(0, 0, *source.size)), cloud > 0)
        (values,), hidden = source.read_layers(25, 5, 60, 50)
    np.testing.assert_array_equal(values, GREY[5:55, 25:85])
    np.testing.assert_array_equal(hidden, cloud[5:55, 25:85] > 0)


def test_zeros_that_a_mask_shows_are_values(tmp_path) -> None:
    """As shadows in images of 8 bits; of a file without a mask they are nodata."""
    values = GREY.clip(0, 250).astype(np.uint8)
    values[10:30, 20:60], shown = 0, np.full(GREY.shape, 255, np.uint8)
    shown[70:, :] = 0
    path = write(tmp_path / "a.tif", values, mask=shown)
    np.testing.assert_array_equal(holes(path), shown == 0)
    assert holes(write(tmp_path / "b.tif", values))[10:30, 20:60].all()


COLOURED = {"photometric": "RGB"}


def coloured(path: Path, **options) -> Path:
    """Red, green, blue and near infrared, each a multiple of the other; a hole in all, in one."""
    bands = [(GREY * k).astype(np.uint16) for k in (1, 2, 3, 5)]
    for band in bands:
        band[10, 10] = 0
    bands[0][20, 20] = 0
    return write(path, *bands, **COLOURED, **options)


def test_colours_and_a_mix_of_bands_are_read(tmp_path) -> None:
    path = coloured(tmp_path / "a.tif")
    with Source(path, mix={2: 0.75, 4: 0.25}, colour=(3, 2, 1)) as source:
        layers, _ = source.read_layers(0, 0, *source.size)
        np.testing.assert_array_equal(source.read(0, 0, *source.size), layers[0])
    there = np.ones(GREY.shape, bool)
    there[10, 10] = there[20, 20] = False
    for layer, factor in zip(layers, (0.75 * 2 + 0.25 * 5, 3, 2, 1)):
        np.testing.assert_allclose(layer[there], (GREY * factor)[there], rtol=1e-6)
    assert np.isnan(layers[:, 10, 10]).all()
    assert layers[3, 20, 20] == 0  # dark in one band is not nodata


@pytest.mark.parametrize(
    ("options", "expected"),
    [({}, (1, 2, 3)), ({"colour": None}, ()), ({"colour": (4, 1, 2)}, (4, 1, 2))],
)
def test_colour_is_what_both_images_call_so(tmp_path, options, expected, caplog) -> None:
    pair = [coloured(tmp_path / f"{n}.tif") for n in "ab"]
    with open_pair(*pair, bands=Rectify(**options)) as (left, right):
        assert left.colour == right.colour == expected
        assert left.mix == pytest.approx(dict.fromkeys(expected, 1 / 3) if expected else {1: 1})
    assert ("band 1 (red) is used" in caplog.text) == (not expected)
    grey = write(tmp_path / "g.tif", GREY.astype(np.uint16))
    if options.get("colour"):
        with pytest.raises(InputError, match=r"g.tif: no band 4: it has 1\. .*rectify.colour"):
            open_pair(pair[0], grey, bands=Rectify(**options)).__enter__()
    else:
        with open_pair(pair[0], grey, bands=Rectify(**options)) as (left, right):
            assert left.colour == right.colour == ()


@pytest.mark.parametrize(
    ("panchromatic", "colour", "mix"),
    [
        (None, None, {1: 1.0}),
        (None, (3, 2, 1), {3: 1 / 3, 2: 1 / 3, 1: 1 / 3}),
        (4, (1, 2, 3), {4: 1.0}),
        ({1: 1, 2: 3}, None, {1: 0.25, 2: 0.75}),
    ],
)
def test_weights_of_bands_are_of_sum_one(panchromatic, colour, mix) -> None:
    """Band 1 without colour, the mean with it, or what is named."""
    for one in bands_of("ab", Rectify(panchromatic=panchromatic, colour=colour)):
        assert one["mix"] == pytest.approx(mix)


def complex_image(folder: Path) -> tuple[Path, ...]:
    path = folder / "a.tif"
    rasterio.open(path, "w", driver="GTiff", width=9, height=8, count=1, dtype="complex64").close()
    return (path,)


def of_shape(rows: int, cols: int):
    def make(folder: Path) -> tuple[Path, ...]:
        size = {"height": rows, "width": cols, "blockysize": rows, "compress": "lzw", "count": 1}
        path = folder / "a.tif"
        rasterio.open(path, "w", driver="GTiff", dtype="uint16", sparse_ok=True, **size).close()
        return (path,)

    return make


def with_mask(*shape: int):
    def make(folder: Path) -> tuple[Path, ...]:
        image = write(folder / "image.tif", GREY.astype(np.uint16))
        return image, write(folder / "a.tif", *np.zeros(shape, np.uint8))

    return make


def cut_short(folder: Path) -> tuple[Path, ...]:
    path = write(folder / "a.tif", GREY.astype(np.uint32))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    return (path,)


REFUSED = {
    "complex": complex_image,
    "longer than any": of_shape(1, 1_000_001),
    "one block of all": of_shape(40_000, 40_000),
    "mask of two bands": with_mask(2, *GREY.shape),
    "mask of another size": with_mask(1, 10, 12),
    "cut short": cut_short,
}


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize("fault", REFUSED)
def test_what_is_no_image_is_refused_by_name(tmp_path, fault) -> None:
    paths = REFUSED[fault](tmp_path)
    with pytest.raises(InputError) as refused, Source(*paths) as source:
        source.check_blocks()
    assert str(refused.value.file) == str(tmp_path / "a.tif") and refused.value.remedy


# ------------------------------------------------------------------ the blocks of a TIFF

NOISE = np.random.default_rng(0).integers(0, 900, (200, 300)).astype(np.uint16)


@pytest.mark.parametrize(
    "options",
    [
        {"bigtiff": "NO", "endianness": "BIG"},
        {"bigtiff": "YES", "tiled": True, "blockxsize": 64, "blockysize": 64},
        {"bigtiff": "YES", "endianness": "BIG", "compress": "deflate"},
        {"tiled": True, "blockxsize": 16, "blockysize": 16, "compress": "deflate"},
    ],
)
def test_places_and_checksums(tmp_path, options) -> None:
    path = write(tmp_path / "a.tif", NOISE, **options)
    assert damaged_block(path, workers=2) == ""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    assert damaged_block(path) != ""
    damaged = bytearray(data)
    damaged[len(data) - 2000] ^= 4
    path.write_bytes(damaged)
    assert bool(damaged_block(path, workers=2)) == ("compress" in options)
    assert damaged_block(path, whole=False) == ""


def test_what_gdal_passes_over_is_found(tmp_path) -> None:
    """It reads some damaged blocks of float32 without a word, and gives other values."""
    grey = NOISE.astype(np.float32)
    path = tmp_path / "a.tif"
    shape = {"width": 300, "height": 200, "count": 1, "dtype": "float32"}
    with open_raster(path, "w", driver="GTiff", **shape, compress="deflate", predictor=3) as target:
        target.write(grey, 1)
    good, silent = path.read_bytes(), 0
    for at in range(1000, 61_000, 3000):
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
    ("compress", "tag", "value"),
    [("none", 258, 1), ("lzw", 259, 1)],
)
def test_sizes_that_do_not_go_together(tmp_path, compress, tag, value) -> None:
    path = write(tmp_path / "a.tif", NOISE, compress=compress, blockysize=200)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, entry_of(data, tag) + 8, value)
    path.write_bytes(data)
    assert damaged_block(path) != ""


def entry_of(data: bytes, wanted: int) -> int:
    """Where a tag stands in a small TIFF."""
    (start,) = struct.unpack_from("<I", data, 4)
    places = (start + 2 + 12 * k for k in range(struct.unpack_from("<H", data, start)[0]))
    return next(at for at in places if struct.unpack_from("<H", data, at)[0] == wanted)


@pytest.mark.parametrize("compress", ["none", "lzw"])
def test_two_strips_at_one_place_are_found(tmp_path, compress) -> None:
    """GDAL reads them in silence, the same rows twice."""
    path = write(tmp_path / "a.tif", NOISE, compress=compress, blockysize=50)
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


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_sparse_files_and_other_formats_pass(tmp_path) -> None:
    (path,) = of_shape(300, 300)(tmp_path)
    assert damaged_block(path) == ""
    picture = {"driver": "PNG", "width": 9, "height": 9, "count": 1, "dtype": "uint8"}
    with rasterio.open(tmp_path / "b.png", "w", **picture) as dataset:
        dataset.write(np.ones((1, 9, 9), np.uint8))
    assert damaged_block(tmp_path / "b.png") == ""
    small = write(tmp_path / "c.tif", NOISE[:10], tiled=True, blockxsize=512, blockysize=256)
    assert damaged_block(small) == ""


def test_a_block_that_lost_its_size_is_nodata(tmp_path) -> None:
    path = write(tmp_path / "a.tif", NOISE, compress="deflate", blockysize=50)
    data = bytearray(path.read_bytes())
    (sizes,) = struct.unpack_from("<I", data, entry_of(data, 279) + 8)
    kind, width = ("<H", 2) if data[entry_of(data, 279) + 2] == 3 else ("<I", 4)
    struct.pack_into(kind, data, sizes + width, 0)
    path.write_bytes(data)
    assert damaged_block(path) == ""
    assert np.array_equal(holes(path)[::50, 1], [False, True, False, False])
