"""Windows of a large image file, from several threads, and what its bands, nodata and masks mean.

GDAL reads some damaged blocks of deflate as other pixels without an error, so that the blocks of a
TIFF can be held against the file: their places, and the checksums of deflate. Sources: TIFF 6.0
(Adobe), sections 2 and 15; BigTIFF (libtiff); zlib (RFC 1950).
"""

from __future__ import annotations

import logging
import threading
import zlib
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, Compression, Interleaving
from rasterio.errors import RasterioError
from rasterio.windows import Window

from ..core.config.configuration import Rectify
from ..core.errors import InputError
from ..core.numerics.arrays import Bools, Ints, Singles
from ..core.products.file_parts import open_stream
from ..core.products.rasters import MASK, Hidden, open_raster, refuse_bands
from ..core.products.remote_files import size_of

log = logging.getLogger("stereotruth")

CACHE_MB = 256  # of decoded source; 1024 rows of a scene 34 000 px wide take 70
MAX_SIDE = 1_000_000  # px; no sensor's image is as long
MAX_PIXELS = 30_000_000_000  # a strip of WorldView, 13 km x 112 km, has 16 thousand million
MAX_BLOCK_BYTES = 1 << 30  # of a block of the file, which is decoded as a whole
OUTLIER = 10.0  # of the largest value above all but a thousandth of the others: a hot pixel
BELOW = 0.1  # of the largest value below zero: a fill value; noise of reflectances is above
GET_AGAIN = "the file is damaged or cut short: get it again"

# The blocks of a TIFF.
PART_BYTES = 1 << 20  # that are inflated at once
FARTHEST = 1 << 62  # place in a file; damaged ones may not fit 64 bits


class Source:
    """Bands of an image file, read by windows from any thread as float32 with NaN for nodata.

    The image is the mean of its bands by the weights of ``mix`` (of sum 1; by default band 1);
    ``colour``: numbers of further bands that are read beside it. Nodata is where all of these have
    the file's nodata value, or exactly 0 if it names none and has neither mask nor alpha band; what
    the file's own mask or alpha band hides; and, as no sensor counts below zero, negative values
    (of real numbers those below :data:`BELOW` of the largest value), since fill values are often
    not declared. ``mask`` is a raster on the image's grid whose non-zero pixels hide the image's,
    too. Integer images keep their digital numbers. Others, and integers of more than 16 bits, keep
    theirs if their maximum lies in [256, 65535] (of integers: below), else they are multiplied by
    ``gain`` = 10000 / maximum. The maximum is that of a decimated reading; hot pixels do not count.

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
        dataset = self._dataset(self.path)
        self.size = (dataset.width, dataset.height)
        self.band_count = dataset.count
        self._refuse_shape(dataset)
        self._refuse_bands(dataset)
        dtype = np.dtype(dataset.dtypes[self._bands[0] - 1])
        self._hidden = Hidden(dataset)
        self.nodata = dataset.nodata
        if self.nodata is None and not self._hidden.declared:
            self.nodata = 0.0
        self.masks = self._hidden.declared or self.mask_path is not None
        if self.mask_path is not None:
            self._refuse_mask(self._dataset(self.mask_path))
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
        with _readable(self.path, "the image"):
            sample = dataset.read(self._bands, out_shape=(len(self._bands), *shape))
        sample = sample.astype(np.float64)
        sample = sample[np.isfinite(sample) & (sample > 0)]
        sample = sample if self.nodata is None else sample[sample != self.nodata]
        top = float(sample.max()) if sample.size else 0.0
        most = float(np.percentile(sample, 99.9)) if sample.size else 0.0
        if top > OUTLIER * most:
            words = "%s: few values reach %g, all others %g: the few are taken as hot pixels"
            log.warning(words, self.path.name, top, most)
            top = most
        self._lowest = -BELOW * top if real else 0.0
        if top <= 0.0 or (256.0 if real else 0.0) <= top <= 65535.0:
            return
        kind = "float" if real else "integer"
        log.warning("%s: %s values up to %g are scaled to 10000", self.path.name, kind, top)
        self.gain = 10000.0 / top

    def _dataset(self, path: Path) -> rasterio.DatasetReader:
        """The image or its mask, opened once by each thread."""
        if not hasattr(self._local, "opened"):
            self._local.opened = {}
        opened = self._local.opened
        if path not in opened:
            try:
                opened[path] = open_raster(path)
            except RasterioError as error:
                raise InputError(
                    f"not a raster that GDAL can read ({error})",
                    file=path,
                    remedy="check the path and the file",
                ) from error
            self._opened.append(opened[path])
        return opened[path]

    def read_layers(self, col: int, row: int, cols: int, rows: int) -> tuple[Singles, Bools]:
        """Image and colour bands [1 + colours, rows, cols] of a window, and which are masked.

        Pixels [rows, cols] that only the file ``mask`` hides have their values.
        """
        window, dataset = Window(col, row, cols, rows), self._dataset(self.path)
        with _readable(self.path, f"the mask of rows {row} to {row + rows}"):
            hidden = self._hidden.read(dataset, window=window)
        if hidden is None:
            hidden = np.zeros((rows, cols), np.bool_)
        with _readable(self.path, f"rows {row} to {row + rows}"):
            values = self._values(dataset.read(self._bands, window=window), hidden)
        if self.mask_path is not None:
            with _readable(self.mask_path, f"rows {row} to {row + rows}"):
                masked = self._dataset(self.mask_path).read(1, window=window) != 0
            hidden = hidden | masked
        return values, hidden

    def read(self, col: int, row: int, cols: int, rows: int) -> Singles:
        """Window [rows, cols] from (col, row) on; must lie in the image."""
        values, hidden = self.read_layers(col, row, cols, rows)
        if self.mask_path is not None:
            values[0][hidden] = np.nan
        return values[0]

    def _values(self, raw: NDArray[Any], hidden: Bools) -> Singles:
        """Image and colour bands of the ``raw`` ones; NaN where the image has no value."""
        values, missing = raw.astype(np.float32), hidden.copy()
        if self.nodata is not None:  # a band may be dark where others are not
            missing |= (raw == self.nodata).all(axis=0)
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
            raise InputError(problem, file=self.path, remedy=GET_AGAIN)

    def close(self) -> None:
        """Close the handles of all threads."""
        for dataset in self._opened:
            dataset.close()

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def _readable(path: Path, what: str) -> Iterator[None]:
    """Says by InputError ``what`` of a file GDAL cannot read."""
    try:
        yield
    except RasterioError as error:
        raise InputError(f"{what} cannot be read ({error})", file=path, remedy=GET_AGAIN) from error


def _colour_of(path: str | Path) -> tuple[int, ...] | None:
    """The bands that an image calls red, green and blue; None if it does not."""
    with open_raster(path) as dataset:
        named = {name: band for band, name in enumerate(dataset.colorinterp, 1)}
    found = tuple(named.get(n) for n in (ColorInterp.red, ColorInterp.green, ColorInterp.blue))
    return None if None in found else found


def _weights(bands: Rectify, colour: Sequence[int] | None) -> dict[int, float]:
    """Weights, of sum 1, of the bands that are mixed, as ``rectify.panchromatic`` names them: by
    default the mean of the ``colour`` bands, and band 1 of a grey image (None)."""
    given = bands.panchromatic
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
    return [{"mix": _weights(bands, colour), "colour": colour or ()} for colour in colours]


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


# ------------------------------------------------------------------ the blocks of a TIFF


def damaged_block(path: Path, workers: int = 1, *, whole: bool = True) -> str:
    """What is wrong with the first strip or tile that is damaged; empty if none is, or no TIFF.

    ``whole``: checksums too, for which all of the file is read. Blocks without a place or without
    bytes are empty: GDAL has nodata there.
    """
    with open_raster(path) as dataset:
        if dataset.driver != "GTiff":
            return ""
        offsets, counts = _places_of_blocks(dataset)
        least, full = _pixel_bytes(dataset, offsets.size)
        compression = dataset.compression
    plain = compression is None
    if problem := _misplaced(offsets, counts, size_of(path), (least, 2 * full) if plain else None):
        return problem
    if compression != Compression.deflate or not whole:
        return ""
    most, lock = 2 * full + PART_BYTES, threading.Lock()
    with open_stream(path, keep=False) as stream, ThreadPoolExecutor(workers) as pool:

        def is_whole(k: int) -> bool:
            with lock:
                stream.seek(int(offsets[k]))
                block = stream.read(int(counts[k]))
            return not block or _inflates(block, most)

        for k, good in enumerate(pool.map(is_whole, range(offsets.size))):
            if not good:
                pool.shutdown(cancel_futures=True)
                return f"block {k + 1} of {offsets.size} is damaged"
    return ""


def _places_of_blocks(dataset: rasterio.DatasetReader) -> tuple[NDArray, NDArray]:
    """Offsets and sizes int64[n] of the strips or tiles in the file, as GDAL has them; else 0."""
    rows, cols = dataset.block_shapes[0]
    of_bands = 1 if dataset.interleaving == Interleaving.pixel else dataset.count
    found = [
        [
            min(
                int(dataset.get_tag_item(f"BLOCK_{what}_{x}_{y}", "TIFF", bidx=band) or 0), FARTHEST
            )
            for what in ("OFFSET", "SIZE")
        ]
        for band in range(1, of_bands + 1)
        for y in range(-(-dataset.height // rows))
        for x in range(-(-dataset.width // cols))
    ]
    offsets, counts = np.array(found, np.int64).T
    return offsets, counts


def _pixel_bytes(dataset: rasterio.DatasetReader, blocks: int) -> tuple[Ints, int]:
    """Bytes that the pixels of each block take at least [blocks], and those of a full one.

    Of a last strip, those of its rows alone; some programs write it in full.
    """
    rows, cols = dataset.block_shapes[0]
    bits = 8 * np.dtype(dataset.dtypes[0]).itemsize
    bits = int(dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS", bits))
    samples = dataset.count if dataset.interleaving == Interleaving.pixel else 1
    line = -(-cols * bits * samples // 8)
    across, down = -(-dataset.width // cols), -(-dataset.height // rows)
    first = np.arange(blocks) // across % down * rows
    return np.minimum(rows, dataset.height - first) * line, rows * line


def _inflates(block: bytes, most: int) -> bool:
    """Whether a block of deflate is whole; its checksum is compared.

    ``most``: bytes that come out of it at most; one that holds more is as good as damaged.
    """
    inflating, rest, held = zlib.decompressobj(), block, 0
    try:
        while not inflating.eof:
            before, out = len(rest), len(inflating.decompress(rest, PART_BYTES))
            rest, held = inflating.unconsumed_tail, held + out
            if held > most or (not out and len(rest) == before):
                return False
    except zlib.error:
        return False
    return inflating.eof


def _misplaced(
    offsets: NDArray, counts: NDArray, size: int, limits: tuple[NDArray, int] | None
) -> str:
    """What is wrong with the places of blocks in a file of ``size`` bytes; empty if nothing is.

    ``limits``: least bytes of each block, and most of any, if they are not compressed.
    """
    past = np.flatnonzero((offsets < 0) | (counts < 0) | (counts > size - offsets))
    if past.size:
        return f"block {past[0] + 1} of {offsets.size} reaches past the end of the file"
    if limits is not None:
        least, most = limits
        wrong = np.flatnonzero((counts > 0) & ((counts < least) | (counts > most)))
        if wrong.size:
            k = wrong[0]
            return f"block {k + 1} has {counts[k]} bytes, its pixels take {least[k]}"
    used = np.flatnonzero(counts > 0)
    used = used[np.argsort(offsets[used], kind="stable")]
    over = np.flatnonzero((offsets[used] + counts[used])[:-1] > offsets[used[1:]])
    if not over.size:
        return ""
    first, second = sorted((int(used[over[0]]) + 1, int(used[over[0] + 1]) + 1))
    return f"blocks {first} and {second} of {offsets.size} share bytes"
