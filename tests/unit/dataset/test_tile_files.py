"""The files of a tile, as other programs read them."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from scipy.ndimage import map_coordinates

from stereotruth.dataset.scene_stores import SceneFiles
from stereotruth.dataset.tile_files import round_disparity
from stereotruth.products.rasters import write_tiff

from ...synthetic.tiled_scene import SIZE, labels, read, rows_of, run

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_right_tile_warped_by_the_disparity_is_the_left_tile(exported: tuple[Path, dict]) -> None:
    folder, _ = exported
    checked = 0
    for row in rows_of(folder):
        if row["complete"] == "yes":
            left, right = (read(folder / row[k]).astype(np.float64) for k in ("left", "right"))
            disparity = labels(folder / row["disp"])
            y, x = np.mgrid[:SIZE, :SIZE]
            match = x - disparity
            use = np.isfinite(disparity) & (match > 4) & (match < SIZE - 5)
            warped = map_coordinates(right, [y[use], match[use]], order=3)
            # Texture ±360, 0.02 px of float16 and of cubic interpolation: 1 to 2 grey values.
            assert np.abs(warped - left[use]).mean() < 2.5
            shifted = map_coordinates(right, [y[use], match[use] + 1.0], order=3)
            assert np.abs(shifted - left[use]).mean() > 10
            checked += 1
    assert checked >= 12


def test_half_precision_tiff(tmp_path: Path) -> None:
    """16 bits of IEEE float as the TIFF tags say, bytes as NumPy's float16, read back by GDAL."""
    values = np.linspace(-200, 200, 64 * 64).reshape(64, 64)
    stored = round_disparity(values, "float16")
    assert np.abs(stored - values)[np.abs(values) < 128].max() <= 1 / 32
    assert np.abs(stored - values).max() <= 1 / 16
    path = tmp_path / "half.tiff"
    write_tiff(path, stored, nodata=-999, half=True)
    with rasterio.open(path) as dataset:
        assert np.array_equal(dataset.read(1), stored) and dataset.nodata == -999
    data = path.read_bytes()
    assert data[:4] == b"II*\0"
    (start,) = struct.unpack_from("<I", data, 4)
    tags = {}
    for k in range(struct.unpack_from("<H", data, start)[0]):
        tag, kind, _, value = struct.unpack_from("<HHII", data, start + 2 + 12 * k)
        tags[tag] = value & 0xFFFF if kind == 3 else value
    assert (tags[258], tags[339], tags[259], tags[317]) == (
        16,
        3,
        8,
        1,
    )  # bits, IEEE, deflate, none
    import zlib

    raw = zlib.decompressobj().decompress(data[tags[273] :])
    assert np.array_equal(np.frombuffer(raw, "<f2"), stored.astype("f2").ravel())


def test_other_readers(exported: tuple[Path, dict], scene: SceneFiles, tmp_path: Path) -> None:
    folder, _ = exported
    left = read(folder / "left" / "TN_left_0.tiff")
    for path in (folder / "left" / "TN_left_0.tiff",):
        assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), left)
        assert np.array_equal(np.asarray(Image.open(path)), left)
    run([scene], tmp_path / "T", disparity_dtype="float32")
    path = tmp_path / "T" / "disp" / "TN_disparity_0.tiff"
    wanted = read(path)
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), wanted)
    assert np.array_equal(np.asarray(Image.open(path)), wanted)
