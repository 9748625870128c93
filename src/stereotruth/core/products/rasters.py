"""TIFF and PNG files of one band or three: read and written in one place, not georeferenced."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioIOError

from ..errors import InputError
from .files import atomic_file
from .raster_values import Quantity, Values, is_value
from .ungeoreferenced import open_raster

Floats = NDArray[np.float64]

MOST_VALUES = 1 << 28  # of an image that is read as a whole: 16384 x 16384 of one band
DISPARITY = Quantity(
    "disparity", "disparity map", -np.inf, np.inf, "give one band of disparities in px"
)
KITTI_STEPS = 256  # in a px of disparity, of PNGs


def write_tiff(
    path: Path,
    array: NDArray[Any],
    *,
    nodata: float | None = None,
    half: bool = False,
    description: str = "",
) -> None:
    """A deflate TIFF of [h, w] or [3, h, w] that libtiff's readers open.

    ``half`` stores float32 in 16 bits.

    GDAL writes IEEE half precision for 32-bit float with NBITS=16. Values must be rounded to
    half precision before.
    """
    bands = array if array.ndim == 3 else array[None]
    rows, cols = array.shape[-2:]
    integer = np.issubdtype(array.dtype, np.integer)
    options: dict[str, Any] = {"nbits": 16} if half else {}
    if array.ndim == 3:
        options |= {"photometric": "RGB", "interleave": "pixel"}
    with open_raster(
        path,
        "w",
        driver="GTiff",
        width=cols,
        height=rows,
        count=len(bands),
        dtype=array.dtype,
        nodata=nodata,
        compress="deflate",
        predictor=2 if integer else 1,  # readers without libtiff know no float predictor
        blockysize=min(rows, 64),
        **options,
    ) as dataset:
        dataset.write(bands)
        if description:
            dataset.update_tags(TIFFTAG_IMAGEDESCRIPTION=description)


def read_image(path: str | Path) -> NDArray[Any]:
    """An image: [h, w], or [h, w, 3] of three bands; uint8, uint16 or else float32; nodata is 0.

    Raises InputError if it cannot be read or has other than one or three bands.
    """
    with _opened(path) as source:
        if source.count not in (1, 3):
            raise InputError(
                f"{source.count} bands", file=path, remedy="give images of one band or three"
            )
        bands = source.read()
    if bands.dtype not in (np.uint8, np.uint16):
        bands = np.nan_to_num(bands.astype(np.float32), copy=False)
    return bands[0] if len(bands) == 1 else np.ascontiguousarray(np.moveaxis(bands, 0, -1))


class ImageFacts(NamedTuple):
    """Bands, type of their values, and nodata tag of an image."""

    bands: int
    dtype: str
    nodata: float | None


def image_facts(path: str | Path) -> ImageFacts:
    """Of an image file. Raises InputError if it cannot be read."""
    with _opened(path) as source:
        return ImageFacts(source.count, source.dtypes[0], source.nodata)


def image_shape(path: str | Path) -> tuple[int, int]:
    """Rows and columns of an image. Raises InputError if it cannot be read."""
    with _opened(path) as source:
        return source.shape


def read_disparity(path: str | Path, nodata: float = -999.0) -> NDArray[np.float32]:
    """A disparity map, float32[h, w] px; NaN where it is nodata (given or tagged) or not finite.

    A PNG of 16 bits has KITTI's coding: KITTI_STEPS in a px, 0 where there is none.

    Raises InputError if it cannot be read, has other bands, or is a PNG of 8 bits.
    """
    with _opened(path) as source:
        if source.driver == "PNG" and not _is_kitti(source):
            raise InputError(
                f"a PNG of {source.dtypes[0]} has no disparities",
                file=path,
                remedy=f"write 16 bits, {KITTI_STEPS} steps a px and 0 for none, or a TIFF",
            )
        values = Values(source, Path(path), DISPARITY)
        raw, there = values.raw()
        if _is_kitti(source):
            there, found = raw != 0, raw / np.float32(KITTI_STEPS)
        else:
            there &= ~is_value(raw, nodata)
            found = raw.astype(np.float64) * values.scale + values.offset
    return np.where(there, found, np.nan).astype(np.float32)


@contextmanager
def _opened(path: str | Path) -> Iterator[rasterio.DatasetReader]:
    """An image that is read as a whole. Raises InputError if it cannot be, or is too large."""
    try:
        with open_raster(path) as dataset:
            refuse_large((dataset.height, dataset.width, dataset.count), path)
            yield dataset
    except RasterioIOError as error:
        raise InputError(
            f"no image that can be read ({error})", file=path, remedy="copy the file anew"
        ) from None


def refuse_large(shape: Sequence[int], path: str | Path) -> None:
    """Raise InputError if an image has more values than are read at once."""
    if math.prod(shape) > MOST_VALUES:
        raise InputError(
            f"{' x '.join(map(str, shape))} values are more than are read at once",
            file=path,
            remedy=f"cut it into images of at most {MOST_VALUES / 1e6:.0f} million values",
        )


def read_tile(path: Path) -> Floats:
    """The band of an exported TIFF, or the mean of three, float64[h, w]; NaN where it is nodata."""
    with _opened(path) as dataset:
        bands = dataset.read().astype(np.float64)
        missing = (bands == dataset.nodata).all(axis=0)
    values = bands[0] if len(bands) == 1 else bands.mean(axis=0)
    values[missing] = np.nan
    return values


def read_labels(path: str | Path) -> tuple[NDArray[Any], float | None]:
    """The band of a label file as it is, and its nodata tag, or what stands for nodata in a PNG."""
    with _opened(path) as dataset:
        return dataset.read(1), 0.0 if _is_kitti(dataset) else dataset.nodata


def _is_kitti(dataset: rasterio.DatasetReader) -> bool:
    return dataset.driver == "PNG" and dataset.dtypes[0] == "uint16"


def read_flags(path: str | Path) -> tuple[NDArray[np.uint8], dict[int, str]]:
    """The band of a file of flags as :func:`write_tiff` writes it, and what its values mean."""
    with _opened(path) as dataset:
        text = dataset.tags().get("TIFFTAG_IMAGEDESCRIPTION", "")
        return dataset.read(1), {int(v): n for v, n in re.findall(r"(\d+) (\w+)", text)}


def write_disparity(path: str | Path, disparity: NDArray[np.float32]) -> None:
    """Write a disparity map as a TIFF of 32-bit floats with nodata NaN."""
    with (
        atomic_file(path) as scratch,
        open_raster(
            scratch,
            "w",
            driver="GTiff",
            height=disparity.shape[0],
            width=disparity.shape[1],
            count=1,
            dtype="float32",
            nodata=np.nan,
            compress="deflate",
            predictor=1,  # readers without libtiff know no float predictor
            tiled=True,
        ) as target,
    ):
        target.write(disparity, 1)
