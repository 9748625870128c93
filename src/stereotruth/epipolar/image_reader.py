"""Windows of a large image file, from several threads."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.errors import RasterioError
from rasterio.windows import Window

from ..errors import InputError
from ..products.ungeoreferenced import open_raster

log = logging.getLogger("stereotruth")


CACHE_MB = 256  # of decoded source; 1024 rows of a scene 34 000 px wide take 70


class Source:
    """One band of an image file, read by windows from any thread as float32 with NaN for nodata.

    Nodata is the file's nodata value, or exactly 0 if it names none. Integer images keep their
    digital numbers. Others keep theirs if their maximum lies in [256, 65535], else they are
    multiplied by ``gain`` = 10000 / maximum (of a decimated reading).

    Raises InputError if the file cannot be read or is complex-valued.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._local = threading.local()
        self._opened: list[rasterio.DatasetReader] = []
        dataset = self._dataset()
        self.size = (dataset.width, dataset.height)
        dtype = np.dtype(dataset.dtypes[0])
        if dtype.kind == "c":
            raise InputError(
                "complex image", file=path, remedy="give the amplitude as a real-valued image"
            )
        self.nodata = 0.0 if dataset.nodata is None else float(dataset.nodata)
        if dataset.count > 1:
            log.warning(
                "%s has %d bands; band 1 (%s) is used",
                self.path.name,
                dataset.count,
                dataset.descriptions[0] or dataset.colorinterp[0].name,
            )
        self.gain = 1.0
        if dtype.kind == "f":
            self.gain = self._float_gain(dataset)

    def _float_gain(self, dataset: rasterio.DatasetReader) -> float:
        shape = tuple(min(n, 2048) for n in dataset.shape)
        sample = dataset.read(1, out_shape=shape).astype(np.float64)
        sample = sample[np.isfinite(sample) & (sample != self.nodata)]
        top = float(sample.max()) if sample.size else 0.0
        if 256.0 <= top <= 65535.0 or top <= 0.0:
            return 1.0
        log.warning("%s: float values up to %g are scaled to 10000", self.path.name, top)
        return 10000.0 / top

    def _dataset(self) -> rasterio.DatasetReader:
        if not hasattr(self._local, "dataset"):
            try:
                dataset = open_raster(self.path)
            except RasterioError as error:
                raise InputError(
                    f"not a raster that GDAL can read ({error})",
                    file=self.path,
                    remedy="check the path and the file",
                ) from error
            self._opened.append(dataset)
            self._local.dataset = dataset
        return self._local.dataset

    def read(self, col: int, row: int, cols: int, rows: int) -> NDArray[np.float32]:
        """Window [rows, cols] from (col, row) on; must lie in the image."""
        try:
            raw = self._dataset().read(1, window=Window(col, row, cols, rows))
        except RasterioError as error:
            raise InputError(
                f"rows {row} to {row + rows} cannot be read ({error})",
                file=self.path,
                remedy="the file is damaged or cut short: get it again",
            ) from error
        values = raw.astype(np.float32)
        values[raw == self.nodata] = np.nan
        return values if self.gain == 1.0 else values * np.float32(self.gain)

    def close(self) -> None:
        """Close the handles of all threads."""
        for dataset in self._opened:
            dataset.close()

    def __enter__(self) -> Source:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def open_pair(left: str | Path, right: str | Path) -> Iterator[tuple[Source, Source]]:
    """Both images of a pair, of which GDAL keeps CACHE_MB decoded at most."""
    # GDAL's default, 5 % of the machine's memory, can be more than a job may use
    with rasterio.Env(GDAL_CACHEMAX=CACHE_MB), Source(left) as first, Source(right) as second:
        yield first, second
