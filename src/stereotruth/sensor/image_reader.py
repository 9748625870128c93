"""Windows of a large image file, from several threads."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.windows import Window

from ..core.config.configuration import Rectify
from ..core.errors import InputError
from ..core.products.rasters import MASK, Hidden, open_raster, refuse_bands
from .tiff_blocks import damaged_block

log = logging.getLogger("stereotruth")


CACHE_MB = 256  # of decoded source; 1024 rows of a scene 34 000 px wide take 70


MAX_SIDE = 1_000_000  # px; no sensor's image is as long
MAX_PIXELS = 30_000_000_000  # a strip of WorldView, 13 km x 112 km, has 16 thousand million
MAX_BLOCK_BYTES = 1 << 30  # of a block of the file, which is decoded as a whole
OUTLIER = 10.0  # of the largest value above all but a thousandth of the others: a hot pixel
BELOW = 0.1  # of the largest value below zero: a fill value; noise of reflectances is above


class Source:
    """Bands of an image file, read by windows from any thread as float32 with NaN for nodata.

    The image is the mean of its bands by the weights of ``mix`` (of sum 1; by default band 1);
    ``colour``: numbers of further bands that are read beside it. Nodata is where all of these have
    the file's nodata value, or exactly 0 if it names none and has neither mask nor alpha band; what
    the file's own mask or alpha band hides; and, as no sensor counts below zero, negative values
    (of real numbers those below :data:`BELOW` of the largest value), since fill values are often
    not declared. ``mask`` is a
    raster on the image's grid whose non-zero pixels hide the image's, too. Integer images keep
    their digital numbers. Others, and integers of more than 16 bits, keep theirs if their maximum
    lies in [256, 65535] (of integers: below), else they are multiplied by ``gain`` = 10000 /
    maximum. The maximum is that of a decimated reading; hot pixels do not count.

    Raises InputError if the file cannot be read, is complex-valued or larger than any image.
    """

    def __init__(
        self,
        path: str | Path,
        mask: str | Path | None = None,
        *,
        mix: Mapping[int, float] | None = None,
        colour: Sequence[int] = (),
    ) -> None:
        self.path = Path(path)
        self.mix, self.colour = dict(mix or {1: 1.0}), tuple(colour)
        self._bands = list(dict.fromkeys((*self.mix, *self.colour)))
        self.mask_path = Path(mask) if mask else None
        self._local = threading.local()
        self._opened: list[rasterio.DatasetReader] = []
        self._told = False
        dataset = self._dataset()
        self.size = (dataset.width, dataset.height)
        self._refuse_shape(dataset)
        self._refuse_bands(dataset)
        dtype = np.dtype(dataset.dtypes[self._bands[0] - 1])
        self._hidden = Hidden(dataset)
        self.nodata = dataset.nodata
        if self.nodata is None and not self._hidden.declared:
            self.nodata = 0.0
        self.masks = self._hidden.declared or self.mask_path is not None
        if self.mask_path is not None:
            self._refuse_mask(self._mask())
        self.band_count = dataset.count
        if dataset.count > (1 if self._hidden.alpha is None else 2) and self._bands == [1]:
            log.warning(
                "%s has %d bands; band 1 (%s) is used",
                self.path.name,
                dataset.count,
                dataset.descriptions[0] or dataset.colorinterp[0].name,
            )
        self.gain, self._lowest = 1.0, -np.inf
        if dtype.kind == "f" or dtype.itemsize > 2:
            self._scale(dataset, dtype.kind == "f")
        elif dtype.kind == "i":
            self._lowest = 0.0

    def _refuse_shape(self, dataset: rasterio.DatasetReader) -> None:
        too_large = max(self.size) > MAX_SIDE or self.size[0] * self.size[1] > MAX_PIXELS
        if dataset.count == 0 or too_large:
            raise InputError(
                f"{dataset.count} bands of {self.size[0]} x {self.size[1]} pixels are no image of "
                "a satellite",
                file=self.path,
                remedy="give the image itself; if that is it, it is damaged: get it again",
            )
        if dataset.dtypes[0].startswith("complex"):
            raise InputError(
                "complex image", file=self.path, remedy="give the amplitude as a real-valued image"
            )
        rows, cols = dataset.block_shapes[0]
        if rows * cols * np.dtype(dataset.dtypes[0]).itemsize > MAX_BLOCK_BYTES:
            raise InputError(
                f"its blocks of {cols} x {rows} pixels can only be read as a whole",
                file=self.path,
                remedy="write it in tiles (gdal_translate -co TILED=YES); if it has them, it is "
                "damaged: get it again",
            )

    def _refuse_bands(self, dataset: rasterio.DatasetReader) -> None:
        missing = [band for band in self._bands if band > dataset.count]
        kinds = {dataset.dtypes[band - 1] for band in self._bands if band <= dataset.count}
        if missing or len(kinds) > 1:
            raise InputError(
                f"no band {missing[0]}: it has {dataset.count}"
                if missing
                else f"bands of different types ({', '.join(sorted(kinds))})",
                file=self.path,
                remedy="name others in rectify.colour and rectify.panchromatic",
            )

    def _refuse_mask(self, mask: rasterio.DatasetReader) -> None:
        if (mask.width, mask.height) != self.size:
            raise InputError(
                f"a mask of {mask.width} x {mask.height} pixels for the image {self.path.name} of "
                f"{self.size[0]} x {self.size[1]}",
                file=self.mask_path,
                remedy="a mask has the pixels of its image (left_mask, right_mask in scenes.tsv)",
            )
        refuse_bands(mask, self.mask_path, MASK)

    def _scale(self, dataset: rasterio.DatasetReader, real: bool) -> None:
        """Set the gain, and below what values are fill values."""
        shape = tuple(min(n, 2048) for n in dataset.shape)
        with self._readable("the image"):
            sample = dataset.read(self._bands, out_shape=(len(self._bands), *shape))
        sample = sample.astype(np.float64)
        sample = sample[np.isfinite(sample) & (sample > 0)]
        sample = sample if self.nodata is None else sample[sample != self.nodata]
        top = float(sample.max()) if sample.size else 0.0
        if top > OUTLIER * (most := float(np.percentile(sample, 99.9)) if sample.size else 0.0):
            log.warning(
                "%s: few values reach %g, all others %g: the few are taken as hot pixels",
                self.path.name,
                top,
                most,
            )
            top = most
        self._lowest = -BELOW * top if real else 0.0
        if top <= 0.0 or (256.0 if real else 0.0) <= top <= 65535.0:
            return
        log.warning(
            "%s: %s values up to %g are scaled to 10000",
            self.path.name,
            "float" if real else "integer",
            top,
        )
        self.gain = 10000.0 / top

    def _dataset(self) -> rasterio.DatasetReader:
        if not hasattr(self._local, "dataset"):
            self._local.dataset = self._open(self.path)
        return self._local.dataset

    def _mask(self) -> rasterio.DatasetReader:
        if not hasattr(self._local, "mask"):
            self._local.mask = self._open(self.mask_path)
        return self._local.mask

    def _open(self, path: Path) -> rasterio.DatasetReader:
        try:
            dataset = open_raster(path)
        except RasterioError as error:
            raise InputError(
                f"not a raster that GDAL can read ({error})",
                file=path,
                remedy="check the path and the file",
            ) from error
        self._opened.append(dataset)
        return dataset

    @contextmanager
    def _readable(self, what: str, path: Path | None = None) -> Iterator[None]:
        try:
            yield
        except RasterioError as error:
            raise InputError(
                f"{what} cannot be read ({error})",
                file=path or self.path,
                remedy="the file is damaged or cut short: get it again",
            ) from error

    def _hidden_by_itself(self, window: Window) -> NDArray[np.bool_] | None:
        """What the file's own mask or alpha band hides; None if it has none."""
        end = window.row_off + window.height
        with self._readable(f"the mask of rows {window.row_off} to {end}"):
            return self._hidden.read(self._dataset(), window=window)

    def read_layers(
        self, col: int, row: int, cols: int, rows: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Image and colour bands [1 + colours, rows, cols] of a window, and which are masked.

        Pixels [rows, cols] that only the file ``mask`` hides have their values.
        """
        window = Window(col, row, cols, rows)
        hidden = self._hidden_by_itself(window)
        values = self._values(window, hidden)
        if hidden is None:
            hidden = np.zeros(values.shape[1:], np.bool_)
        if self.mask_path is not None:
            with self._readable(f"rows {row} to {row + rows}", self.mask_path):
                hidden = hidden | (self._mask().read(1, window=window) != 0)
        return values, hidden

    def read(self, col: int, row: int, cols: int, rows: int) -> NDArray[np.float32]:
        """Window [rows, cols] from (col, row) on; must lie in the image."""
        values, hidden = self.read_layers(col, row, cols, rows)
        if self.mask_path is not None:
            values[0][hidden] = np.nan
        return values[0]

    def _values(self, window: Window, hidden: NDArray[np.bool_] | None) -> NDArray[np.float32]:
        dataset = self._dataset()
        with self._readable(f"rows {window.row_off} to {window.row_off + window.height}"):
            raw = dataset.read(self._bands, window=window)
        values = raw.astype(np.float32)
        # a band may be dark where others are not
        missing = np.zeros(raw.shape[1:], np.bool_)
        if self.nodata is not None:
            missing = (raw == self.nodata).all(axis=0)
        if hidden is not None:
            missing |= hidden
        below = (values < self._lowest).any(axis=0) & ~missing
        if below.any():
            if not self._told:
                self._told = True
                log.warning(
                    "%s: values below %g (%g) are taken as nodata; declare its nodata value",
                    self.path.name,
                    self._lowest,
                    float(values[:, below].min(axis=0)[0]),
                )
            missing |= below
        values[:, missing] = np.nan
        if len(self._bands) > 1:
            place = {band: values[k] for k, band in enumerate(self._bands)}
            mixed = sum(np.float32(weight) * place[band] for band, weight in self.mix.items())
            values = np.stack([mixed, *(place[band] for band in self.colour)])
        return values if self.gain == 1.0 else values * np.float32(self.gain)

    def check_blocks(self, workers: int = 1, *, whole: bool = True) -> None:
        """Refuse a TIFF of which GDAL would read damaged blocks in silence; reads all of it.

        Not ``whole``: only the places of its blocks are held against the file.
        """
        if problem := damaged_block(self.path, workers, whole=whole):
            raise InputError(
                problem, file=self.path, remedy="the file is damaged or cut short: get it again"
            )

    def close(self) -> None:
        """Close the handles of all threads."""
        for dataset in self._opened:
            dataset.close()

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _colour_of(path: str | Path) -> tuple[int, ...] | None:
    """The bands that an image calls red, green and blue; None if it does not."""
    with open_raster(path) as dataset:
        named = {name: band for band, name in enumerate(dataset.colorinterp, 1)}
    found = tuple(named.get(n) for n in (ColorInterp.red, ColorInterp.green, ColorInterp.blue))
    return None if None in found else found


def band_weights(
    panchromatic: int | Mapping[int, float] | None, colour: Sequence[int] | None
) -> dict[int, float]:
    """Weights, of sum 1, of the bands that are mixed, as ``rectify.panchromatic`` names them.

    ``colour``: the bands of a pair that are coloured, None for grey.
    """
    given = panchromatic
    if given is None:
        given = dict.fromkeys(colour, 1.0) if colour else 1
    if isinstance(given, int):
        given = {given: 1.0}
    if not given:
        raise InputError(
            "rectify.panchromatic: no band", remedy="name a band, or bands with their weights"
        )
    return {band: weight / sum(given.values()) for band, weight in given.items()}


def bands_of(paths: Sequence[str | Path], bands: Rectify) -> list[dict[str, Any]]:
    """``mix`` and ``colour`` of each of both images, as :class:`Source` takes them."""
    colours = [bands.colour] * 2
    if bands.colour == "auto":
        try:
            colours = [_colour_of(path) for path in paths]
        except RasterioError:
            colours = [None, None]  # who opens the image says what is wrong with it
    if None in colours:
        colours = [None, None]
    return [
        {"mix": band_weights(bands.panchromatic, colour), "colour": colour or ()}
        for colour in colours
    ]


@contextmanager
def open_pair(
    left: str | Path,
    right: str | Path,
    left_mask: str | Path | None = None,
    right_mask: str | Path | None = None,
    *,
    bands: Rectify | None = None,
) -> Iterator[tuple[Source, Source]]:
    """Both images of a pair, of which GDAL keeps CACHE_MB decoded at most."""
    of_left, of_right = bands_of((left, right), bands or Rectify())
    # GDAL's default, 5 % of the machine's memory, can be more than a job may use
    with (
        rasterio.Env(GDAL_CACHEMAX=CACHE_MB),
        Source(left, left_mask, **of_left) as first,
        Source(right, right_mask, **of_right) as second,
    ):
        yield first, second
