"""The one reader of rasters: images, labels, heights, undulations, masks; and TIFFs written."""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioIOError
from rasterio.windows import Window

from ..errors import InputError, in_number
from ..numerics.arrays import Floats
from .files import atomic_file
from .remote_files import gdal_name

_LOCK = Lock()  # what `catch_warnings` changes, all threads share
# Formats that hold their pixels. A list, because GDAL knows others (VRT, WMS, STAC …) that fetch
# them from anywhere, whatever the ending of the file's name.
FORMATS = (
    *("GTiff", "JP2OpenJPEG", "JP2ECW", "JP2KAK", "JP2MrSID", "NITF", "PNG", "JPEG"),
    *("HFA", "ENVI", "EHdr", "PCIDSK"),
)
# Files beside an image (overviews, masks) are opened by GDAL itself: none of them from a network,
# from where it reads what a sheet names, and nothing else (:func:`.remote_files.gdal_name`).
os.environ.setdefault("CPL_VSIL_CURL_ALLOWED_FILENAME", "none")
os.environ.setdefault("GDAL_HTTP_MAX_RETRY", "4")  # of what is read by its parts
os.environ.setdefault("GDAL_HTTP_RETRY_DELAY", "1")  # s, twice as long each time


FILLS = (0, -1, -99, -999, -9999, -99999, -32767, -32768)  # and the ends of an integer type
OFTEN = 10
LEAST = 10  # cells of an extreme that is none of FILLS: fewer are blunders
FAR = 50.0  # m or px
RIMS = np.geomspace(1.0, 1e6, 121)  # bins of differences between neighbours, m or px
KITTI_STEPS = 256  # in a px of disparity, of PNGs
MOST_VALUES = 1 << 28  # of an image that is read as a whole: 16384 x 16384 of one band
MOST_CELLS = 1 << 20  # that are read at once, where the file's blocks allow it


def open_raster(
    path: str | Path, mode: str = "r", *, formats: Sequence[str] = FORMATS, **options: Any
) -> Any:
    """``rasterio.open`` without its warning that a file has no georeference; for any thread.

    Files to be read have to be of one of the ``formats`` (names of GDAL's drivers). Of stand-ins
    (:mod:`.remote_files`), what they stand for is opened.
    """
    with _LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        if mode != "r":
            return rasterio.open(path, mode, **options)
        name, reading = gdal_name(path)
        # vertical parts of systems are not told otherwise; rasterio.open takes one format only
        with rasterio.Env(GTIFF_REPORT_COMPD_CS=True, **reading):
            return rasterio.DatasetReader(name, driver=list(formats), **options)


@dataclass(frozen=True)
class Quantity:
    """What values are: ``low`` to ``high`` is possible; ``what`` has them, ``remedy`` else."""

    name: str
    what: str
    low: float
    high: float
    remedy: str


HEIGHT = Quantity(
    "height on Earth",
    "surface model",
    -600.0,
    9500.0,
    "give a raster of one band of heights (gdal_translate -b N takes one out)",
)
MASK = Quantity("pixel of a mask", "mask", 0.0, np.inf, "give a mask of one band")
DISPARITY = Quantity(
    "disparity", "disparity map", -np.inf, np.inf, "give one band of disparities in px"
)


def is_value(raw: NDArray[Any], value: float) -> NDArray[np.bool_]:
    """Where stored numbers are a value, as precise as their type can tell it."""
    if np.dtype(raw.dtype).kind == "f":
        value = np.asarray(value, raw.dtype)
    return raw == value


def refuse_bands(dataset: Any, file: Path, quantity: Quantity) -> None:
    """Raise InputError for other than one band of real numbers beside an alpha band."""
    bands = dataset.count - (ColorInterp.alpha in dataset.colorinterp)
    if bands != 1 or np.dtype(dataset.dtypes[0]).kind not in "iuf":
        raise InputError(
            f"{in_number(dataset.count, 'band')} of {dataset.dtypes[0]} are no {quantity.what}",
            file=file,
            remedy=quantity.remedy,
        )


class Hidden:
    """What the file's own mask or alpha band hides, of an open raster; ``declared`` if it has one.

    GDAL takes alpha bands of floats for none, and a mask for what overrules the nodata value.
    """

    def __init__(self, dataset: Any) -> None:
        alpha = [i for i, c in enumerate(dataset.colorinterp, 1) if c == ColorInterp.alpha]
        self.alpha = alpha[0] if alpha else None
        self.mask = self.alpha is None and MaskFlags.per_dataset in dataset.mask_flag_enums[0]
        self.declared = self.alpha is not None or self.mask

    def read(self, dataset: Any, **how: Any) -> NDArray[np.bool_] | None:
        """bool[h, w] of a window (rasterio's ``window``, ``out_shape``); None if it has none."""
        if self.alpha is not None:
            return dataset.read(self.alpha, **how) == 0
        return dataset.read_masks(1, **how) == 0 if self.mask else None


class Values:
    """The values of an open raster: its one band of real numbers, by scale and offset.

    There is none where the file's mask or alpha band hides it, where it is the declared nodata
    value, or where it is not finite. ``unit``: of what the band counts in, in m or px. Raises
    InputError: see :func:`refuse_bands`; and, as it is read, for a value that its quantity cannot
    have.
    """

    def __init__(self, dataset: Any, file: Path, quantity: Quantity, unit: float = 1.0) -> None:
        refuse_bands(dataset, file, quantity)
        self.dataset, self.file, self.quantity, self.unit = dataset, file, quantity, unit
        self.hidden = Hidden(dataset)
        self.scale, self.offset = dataset.scales[0], dataset.offsets[0]

    def raw(self, **how: Any) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Stored values [h, w] of a window, and where there is one."""
        raw = self.dataset.read(1, **how)
        there = np.isfinite(raw)
        if self.dataset.nodata is not None:
            there &= ~is_value(raw, self.dataset.nodata)
        if (hidden := self.hidden.read(self.dataset, **how)) is not None:
            there &= ~hidden
        return raw, there

    def read(self, **how: Any) -> Floats:
        """Values [h, w] of a window in units of the band; NaN where there is none."""
        return self.of(*self.raw(**how))

    def of(self, raw: NDArray[Any], there: NDArray[np.bool_]) -> Floats:
        """Values of what :meth:`raw` returns."""
        found = np.where(there, raw * float(self.scale) + self.offset, np.nan)
        low, high = self.quantity.low / self.unit, self.quantity.high / self.unit
        with np.errstate(invalid="ignore"):
            wrong = (found < low) | (found > high)
        if wrong.any():
            self.refuse(raw[wrong][0], int(wrong.sum()), f"which is no {self.quantity.name}")
        return found

    def refuse(self, value: float, cells: int, why: str) -> None:
        """Raise InputError for a fill value."""
        nodata = self.dataset.nodata
        tagged = "no nodata value" if nodata is None else f"nodata {nodata:g}"
        raise InputError(
            f"{in_number(cells, 'cell')} of {float(value):g}, {why}; the file declares {tagged}",
            file=self.file,
            remedy=f"declare it as nodata (gdal_edit.py -a_nodata {float(value):g}), or correct "
            "the band's scale; if it is a value, give the file a mask that shows it",
        )

    def windows(self) -> Iterator[Window]:
        """The blocks of the file, row by row; several of them where they are as wide as it is."""
        (rows, cols), (height, width) = self.dataset.block_shapes[0], self.dataset.shape
        if cols >= width:
            rows *= max(1, MOST_CELLS // (rows * width))
        for row in range(0, height, rows):
            for col in range(0, width, cols):
                yield Window(col, row, min(cols, width - col), min(rows, height - row))

    def refuse_fills(self) -> None:
        """Read all, and raise InputError by one of the rules."""
        tally = Fills(self)
        for window in self.windows():
            tally.add(*self.raw(window=window))
        tally.refuse()


@dataclass
class _Value:
    """A value that may be a fill: cells, most cells of another within 1, rims in RIMS' bins."""

    cells: int = 0
    others: int = 0
    rims: NDArray[np.int64] = field(default_factory=lambda: np.zeros(RIMS.size + 1, np.int64))


class Fills:
    """The rim rule, which finds fill values that nobody has declared; windows are added one by one.

    A value that producers fill with (:data:`FILLS`, before scale and offset; or the lowest or
    highest of all, farther from the next than the others reach and than :data:`FAR`) is a fill if
    it is the only one, or occurs :data:`OFTEN` times as often as any other within 1 of it and its
    neighbours differ from it by more than 1 and by more than nine tenths of all other neighbours do
    from each other. A mask or alpha band that shows such values ends the rule: it says what is
    there. False alarms: docs/damaged_input.md. ``may_be_constant``: one value everywhere is no
    fill, as of a grid that somebody has made of 0.
    """

    def __init__(self, values: Values, *, may_be_constant: bool = False) -> None:
        self.values, self.may_be_constant = values, may_be_constant
        self.cells = 0
        dtype = np.dtype(values.dataset.dtypes[0])
        ends = (np.iinfo(dtype).min, np.iinfo(dtype).max) if dtype.kind in "iu" else ()
        self.fills = frozenset(map(float, (*FILLS, *ends)))
        self.found: dict[float, _Value] = {}
        self.rims = np.zeros(RIMS.size + 1, np.int64)  # of all others, in windows that have one
        # (value, cells) of the two lowest and of the two highest; stored values
        self.ends: tuple[dict[float, int], dict[float, int]] = {}, {}

    def add(self, raw: NDArray[Any], there: NDArray[np.bool_]) -> Floats:
        """Take in a window, see :meth:`Values.raw`; returns its values."""
        values = self.values.of(raw, there)
        if self.values.hidden.declared or not there.any():
            return values
        self.cells += int(there.sum())
        known = raw[there]
        here = []
        for end, pick in zip(self.ends, (np.min, np.max)):
            first = pick(known)
            end[float(first)] = end.get(float(first), 0) + int((known == first).sum())
            if (rest := known[known != first]).size:
                second = float(pick(rest))
                end[second] = end.get(second, 0) + int((rest == second).sum())
            here += [first]
            for value in sorted(end, reverse=pick is np.max)[2:]:
                del end[value]
        fills = {float(v) for v in here} | {v for v in self.fills if np.any(known == v)}
        metres = values * self.values.unit
        for value in fills:
            self._count(self.found.setdefault(value, _Value()), value, raw, there, metres)
        if fills & self.fills or any(self.found[v].cells >= LEAST for v in fills):
            plain = np.where(np.isin(raw, list(fills)), np.nan, metres)
            for axis in (0, 1):
                self.rims += _binned(np.abs(np.diff(plain, axis=axis)))
        return values

    def _count(
        self,
        found: _Value,
        value: float,
        raw: NDArray[Any],
        there: NDArray[np.bool_],
        metres: Floats,
    ) -> None:
        on = there & (raw == value)
        found.cells += int(on.sum())
        level = metres[on][0]
        with np.errstate(invalid="ignore"):
            near = raw[there & ~on & (np.abs(metres - level) <= 1.0)]
        if near.size:
            found.others += int(np.unique(near, return_counts=True)[1].max())
        for axis in (0, 1):
            first, second = (np.take(on, range(k, on.shape[axis] - 1 + k), axis) for k in (0, 1))
            step = np.abs(np.diff(metres, axis=axis))
            found.rims += _binned(step[first != second])

    def refuse(self) -> None:
        """Raise InputError if a value is a fill."""
        for value, found in sorted(self.found.items()):
            if self._is_fill(value, found):
                every = found.cells == self.cells
                why = "and no other value" if every else "which stand apart from all around"
                self.values.refuse(value, found.cells, why)

    def _is_fill(self, value: float, found: _Value) -> bool:
        if value in self.fills and found.cells == self.cells > 1:
            return not self.may_be_constant
        if not (value in self.fills or self._stands_apart(value, found)):
            return False
        if found.cells < OFTEN * found.others or not found.rims.sum():
            return False
        middle = int(np.searchsorted(np.cumsum(found.rims), found.rims.sum() / 2))
        steeper = self.rims[middle:].sum() / max(self.rims.sum(), 1)
        return middle > 0 and steeper < 0.1

    def _stands_apart(self, value: float, found: _Value) -> bool:
        """Whether it is the lowest or highest of all, far from the next."""
        lowest, highest = (sorted(end, reverse=bool(k)) for k, end in enumerate(self.ends))
        step = abs(self.values.scale) * self.values.unit
        for near, far in ((lowest, highest), (highest, lowest)):
            if found.cells >= LEAST and len(near) == 2 and value == near[0]:
                gap, rest = abs(near[1] - near[0]) * step, abs(far[0] - near[1]) * step
                return gap > max(rest, FAR)
        return False


def _binned(steps: NDArray[np.floating]) -> NDArray[np.int64]:
    steps = steps[np.isfinite(steps)]
    return np.bincount(np.searchsorted(RIMS, steps.ravel()), minlength=RIMS.size + 1)


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


def read_overview(path: str | Path, side_px: int) -> NDArray[Any]:
    """Band 1 of an image [h, w], in means over its pixels; the longer side has ``side_px`` at most.

    Raises InputError if it cannot be read.
    """
    with _opened(path) as source:
        step = max(1.0, max(source.shape) / side_px)
        shape = tuple(max(int(n / step), 1) for n in source.shape)
        return source.read(1, out_shape=shape, resampling=Resampling.average)


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
