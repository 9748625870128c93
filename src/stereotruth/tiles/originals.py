"""Crops of the original images for each tile, with corrected RPCs.

For software that takes images with RPCs (multi-view stereo, neural reconstruction): what a tile's
left and right image show, as the sensor has it, all bands and bytes as delivered. The RPC is that
one which stands for the corrected sensor model (``corrected_rpc`` of the tile's orientation file,
with its error), with line and sample offset of the crop; it is in the TIFF's RPC tag and in
``_RPC.TXT``, to all digits.

Where the heights of an original image are known (:mod:`stereotruth.labels.image_heights`), the
crop has them beside it: pixel by pixel what the crop shows, with the same RPC.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.rpc import RPC as RasterioRPC
from rasterio.windows import Window

from ..core.errors import InputError
from ..core.job import progress
from ..core.products.files import atomic_folder, write_table
from ..core.products.grids import require_complete
from ..core.products.provenance import file_sha256
from ..core.products.rasters import open_raster, write_tiff
from ..sensor.rpc import RPC
from ..sensor.rpc_files import rpc_text
from .manifest import NODATA, LayerKind, read_manifest
from .orientation import evaluate

MARGIN_PX = 16  # of the crops around what the tiles show
HEIGHTS = {
    "height": LayerKind("float32", NODATA, "height above the WGS 84 ellipsoid in m"),
    "sigma": LayerKind("float32", NODATA, "standard uncertainty of the height in m"),
    "status": LayerKind("uint8", 0, "0: no points, 1: measured, 2: undecided, 3: crown"),
}
README = """Crops of the original images, with corrected RPCs

  {left,right}/<tile>.tif, <tile>_RPC.TXT   what the tile's left and right image show
  manifest.csv                              a row per tile: place of both crops in the original
                                            images (col0, row0; cols, rows, px), error of the RPC
  {left,right}_height, _sigma, _status/<tile>.tif   of what each pixel of a crop shows, if they were
                                            asked for and the image has a name in the images sheet:
                                            height and its standard uncertainty (m, float32, nodata
                                            -9999), and why there is one (status, uint8: 0 no
                                            points, 1 measured, 2 undecided, 3 crown)

Pixel values are those of the original images. RPCs are RPC00B; LINE_OFF and SAMP_OFF count from the
crop's upper-left pixel, whose centre is (0, 0). Ground is WGS 84 longitude and latitude in degrees
and ellipsoidal height in metres. The way from pixels of a tile to those of the original images
is in the tile's orientation file; subtract col0 and row0.
"""


def write_originals(
    tiles: str | Path,
    out: str | Path,
    images: Mapping[str, tuple[str | Path, str | Path]],
    heights: Mapping[str, tuple[str | Path | None, str | Path | None]] | None = None,
    *,
    workers: int = 1,
) -> int:
    """Crop the images of a city's tiles into the folder ``out``; how many tiles there are.

    ``images``: left and right original image by scene; ``heights``: the stores of what they show
    (``results/heights``), None for an image without one. Raises InputError if an image is not that
    of the orientation files, or its heights are not of its size.
    """
    tiles = Path(tiles)
    rows = read_manifest(tiles)
    stores = heights or {}
    with atomic_folder(out) as scratch:
        for k, view in enumerate(("left", "right")):
            (scratch / view).mkdir()
            if any(pair[k] for pair in stores.values()):
                for layer in HEIGHTS:
                    (scratch / f"{view}_{layer}").mkdir()

        def crops(row: Mapping[str, str]) -> dict[str, Any]:
            record = json.loads((tiles / row["orientation"]).read_text(encoding="utf-8"))
            found: dict[str, Any] = {k: row[k] for k in ("tile", "city", "scene", "split")}
            both = images[row["scene"]], stores.get(row["scene"], (None, None))
            for view, image, store in zip(("left", "right"), *both):
                name = f"{view}/{row['tile']}.tif"
                found |= _crop(Path(image), scratch / name, record[view], view, row)
                text = name.removesuffix(".tif") + "_RPC.TXT"
                found |= {view: name, f"{view}_sha256": file_sha256(scratch / name)}
                found |= {f"{view}_rpc": text, f"{view}_rpc_sha256": file_sha256(scratch / text)}
                for layer in HEIGHTS if stores else ():
                    name = f"{view}_{layer}/{row['tile']}.tif" if store else ""
                    found |= {f"{view}_{layer}": name, f"{view}_{layer}_sha256": ""}
                    if store:
                        _crop_heights(store, layer, scratch / name, scratch / found[view], found)
                        found[f"{view}_{layer}_sha256"] = file_sha256(scratch / name)
            return found

        with ThreadPoolExecutor(workers) as pool:
            table = list(progress(pool.map(crops, rows), len(rows), "original images: crops"))
        if table:
            write_table(scratch / "manifest.csv", table)
        (scratch / "README.txt").write_text(README, encoding="utf-8")
    return len(rows)


def _crop(
    image: Path, out: Path, record: Mapping[str, Any], view: str, row: Mapping[str, str]
) -> dict[str, Any]:
    """Write one crop with its RPC; where it lies, for the table."""
    size = int(row["size"])
    side = np.linspace(-0.5, size - 0.5, 17)
    x, y = (v.ravel() for v in np.meshgrid(side, side))
    at = evaluate(record["tile_to_sensor"], x, y)
    with open_raster(image) as source:
        low = [max(math.floor(at[k].min()) - MARGIN_PX, 0) for k in ("col", "row")]
        ends = zip(("col", "row"), (source.width, source.height))
        high = [min(math.ceil(at[k].max()) + MARGIN_PX + 1, n) for k, n in ends]
        if low[0] >= high[0] or low[1] >= high[1]:
            raise InputError(
                f"tile {row['tile']} is not in it", file=image, remedy="make the tiles again"
            )
        cols, rows = high[0] - low[0], high[1] - low[1]
        rpc = RPC.from_dict(record["corrected_rpc"])
        rpc = replace(rpc, samp_off=rpc.samp_off - low[0], line_off=rpc.line_off - low[1])
        options = {
            "photometric": "RGB" if source.colorinterp[0] == ColorInterp.red else "MINISBLACK",
            "compress": "deflate",
            "predictor": 1 if source.dtypes[0].startswith("float") else 2,
            "tiled": True,
        }
        with (
            rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True),
            open_raster(
                out,
                "w",
                driver="GTiff",
                width=cols,
                height=rows,
                count=source.count,
                dtype=source.dtypes[0],
                nodata=source.nodata,
                **options,
            ) as target,
        ):
            window = Window(*low, cols, rows)
            target.write(source.read(window=window))
            if MaskFlags.per_dataset in source.mask_flag_enums[0]:
                target.write_mask(source.read_masks(1, window=window))
            target.colorinterp = source.colorinterp
            target.rpcs = RasterioRPC(**rpc.to_dict(), err_bias=None, err_rand=None)
            for band, name in enumerate(source.descriptions, 1):
                if name:
                    target.set_band_description(band, name)
    out.with_name(f"{out.stem}_RPC.TXT").write_text(rpc_text(rpc), encoding="ascii")
    place = dict(zip(("col0", "row0", "cols", "rows"), (*low, cols, rows)))
    found = {f"{view}_{name}": value for name, value in place.items()}
    return found | {f"{view}_rpc_max_error_px": record["corrected_rpc_max_error_px"]}


def _crop_heights(
    store: str | Path, layer: str, out: Path, crop: Path, place: Mapping[str, Any]
) -> None:
    """Write a layer of an image's heights where a crop of it lies; ``place``: row of the table."""
    view, kind = out.parent.name.partition("_")[0], HEIGHTS[layer]
    group = require_complete(store)
    first = place[f"{view}_row0"], place[f"{view}_col0"]
    shape = place[f"{view}_rows"], place[f"{view}_cols"]
    window = tuple(slice(start, start + size) for start, size in zip(first, shape))
    values = np.asarray(group[layer][window])
    if values.shape != shape:
        raise InputError(
            f"is of another image than {crop.parent.name}/{crop.name}: it ends before the crop",
            file=store,
            remedy="delete it and run the workflow again",
        )
    if kind.dtype.startswith("float"):
        values = np.where(np.isfinite(values), values, kind.nodata).astype(kind.dtype)
    write_tiff(out, values, nodata=kind.nodata, description=kind.description)
    with open_raster(crop) as source, open_raster(out, "r+") as target:
        target.rpcs = source.rpcs
