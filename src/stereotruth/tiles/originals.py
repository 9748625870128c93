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
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.rpc import RPC as RasterioRPC
from rasterio.windows import Window

from ..core.errors import InputError
from ..core.job import progress
from ..core.numerics.arrays import Floats
from ..core.products.files import atomic_folder, write_table
from ..core.products.grids import require_complete
from ..core.products.provenance import file_sha256
from ..core.products.rasters import open_raster, write_tiff
from ..core.tables import acquisition_time
from ..epipolar.warping import warp_rows
from ..sensor.deliveries import Acquisition, by_sheet, read_acquisition
from ..sensor.rpc import RPC
from ..sensor.rpc_files import rpc_text
from .cameras import Crop, Pair, Pinhole, local_frame, write_colmap, write_eogs, write_satnerf
from .manifest import NODATA, LayerKind, read_manifest
from .orientation import evaluate

NO_CELLS = ("", None, None), ("", None, None)

MARGIN_PX = 16  # of the crops around what the tiles show
HEIGHTS = {
    "height": LayerKind("float32", NODATA, "height above the WGS 84 ellipsoid in m"),
    "sigma": LayerKind("float32", NODATA, "standard uncertainty of the height in m"),
    "status": LayerKind("uint8", 0, "0: no points, 1: measured, 2: undecided, 3: crown"),
}
VISIBILITY = LayerKind("uint8", 0, "0: not known, 1: visible in the other image, 2: hidden there")
SAME_PX = 1.5  # that two rays' ends lie apart where both images show one place
POINTS = 32  # labels along a side of a tile that become points of the models; and the extremes
HEIGHT_MARGIN_M = 5.0  # of the cameras' heights beyond those of the labels
README = """Crops of the original images, with corrected RPCs

  {left,right}/<tile>.tif, <tile>_RPC.TXT   what the tile's left and right image show
  manifest.csv                              a row per tile: place of both crops in the original
                                            images (col0, row0; cols, rows, px), error of the RPC,
                                            and how far EOGS' and COLMAP's camera are from the RPC
                                            (px) within the heights min_height_m to max_height_m
  {left,right}_height, _sigma, _status/<tile>.tif   of what each pixel of a crop shows, if they were
                                            asked for and the image has a name in the images sheet:
                                            height and its standard uncertainty (m, float32, nodata
                                            -9999), and why there is one (status, uint8: 0 no
                                            points, 1 measured, 2 undecided, 3 crown)
  {left,right}_visibility/<tile>.tif        where both images have heights: whether the other image
                                            shows it (uint8: 0 not known, 1 visible, 2 hidden)
  satnerf/{left,right}_<tile>.json          the RPC as satnerf reads it; satnerf/pts3d.npy: labels
                                            (geocentric m) that its keypoints name
  eogs/<tile>/affine_models.json            both crops' affine cameras as EOGS reads them
  colmap/sparse/0, colmap/images            pinhole cameras of all crops as COLMAP reads them, in
                                            metres to the east, north and up of a place on the
                                            ellipsoid (colmap/frame.json), with images that have no
                                            skew

Pixel values are those of the original images, but for colmap/images, which are resampled along the
rows. RPCs are RPC00B; LINE_OFF and SAMP_OFF count from the crop's upper-left pixel, whose centre is
(0, 0), in COLMAP's files (0.5, 0.5). Ground is WGS 84 longitude and latitude in degrees and
ellipsoidal height in metres. The way from pixels of a tile to those of the original images is in
the tile's orientation file; subtract col0 and row0.
"""
Cells = tuple[str, float | None, float | None]  # of the images sheet: see _taken
Stores = Mapping[str, tuple[str | Path | None, str | Path | None]]


def write_originals(
    tiles: str | Path,
    out: str | Path,
    images: Mapping[str, tuple[str | Path, str | Path]],
    heights: Stores | None = None,
    *,
    cells: Mapping[str, Sequence[Cells]] | None = None,
    workers: int = 1,
) -> int:
    """Crop the images of a city's tiles into the folder ``out``; how many tiles there are.

    ``images``: left and right original image by scene; ``heights``: the stores of what they show
    (``results/heights``), None for an image without one; ``cells``: time and sun of both images of
    a scene by the images sheet. Raises InputError if an image is not that of the orientation files,
    or its heights are not of its size.
    """
    tiles = Path(tiles)
    rows = read_manifest(tiles)
    with atomic_folder(out) as scratch:
        _make_folders(scratch, heights or {})
        place = [round(float(rows[0][k]), 4) for k in ("lon", "lat")] if rows else [0.0, 0.0]
        with ThreadPoolExecutor(workers) as pool:
            one = partial(_tile, scratch, tiles, place, images, heights)
            made = list(progress(pool.map(one, rows), len(rows), "original images: crops"))
        if made:
            table = _write_cameras(scratch, place, made, images, cells or {})
            write_table(scratch / "manifest.csv", table)
        (scratch / "README.txt").write_text(README, encoding="utf-8")
    return len(rows)


def _make_folders(scratch: Path, stores: Stores) -> None:
    for k, view in enumerate(("left", "right")):
        layers = HEIGHTS if any(pair[k] for pair in stores.values()) else ()
        seen = ["visibility"] if any(all(pair) for pair in stores.values()) else []
        for name in (view, f"colmap/images/{view}", *(f"{view}_{k}" for k in (*layers, *seen))):
            (scratch / name).mkdir(parents=True)


def _tile(
    scratch: Path,
    tiles: Path,
    place: Sequence[float],
    images: Mapping[str, tuple[str | Path, str | Path]],
    heights: Stores | None,
    row: Mapping[str, str],
) -> tuple[dict[str, Any], Pair]:
    """Write both crops of a tile and what lies beside them; its row of the table, its cameras."""
    record = json.loads((tiles / row["orientation"]).read_text(encoding="utf-8"))
    found: dict[str, Any] = {k: row[k] for k in ("tile", "city", "scene", "split")}
    ground, (low, high) = _labels(tiles, row, record)
    found |= {"min_height_m": round(low, 2), "max_height_m": round(high, 2)}
    stores, crops, frame = (heights or {}).get(row["scene"], (None, None)), [], local_frame(*place)
    for view, image, store in zip(("left", "right"), images[row["scene"]], stores):
        name = f"{view}/{row['tile']}.tif"
        cut, rpc = _crop(Path(image), scratch / name, record[view], view, row)
        found |= cut | _listed(scratch, view, name)
        found |= _listed(scratch, f"{view}_rpc", name.removesuffix(".tif") + "_RPC.TXT")
        for layer in HEIGHTS if heights else ():
            name = f"{view}_{layer}/{row['tile']}.tif" if store else ""
            if store:
                values = _heights_of_crop(store, layer, scratch / found[view], found)
                _write_beside(scratch / name, values, HEIGHTS[layer], scratch / found[view])
            found |= _listed(scratch, f"{view}_{layer}", name)
        size = found[f"{view}_cols"], found[f"{view}_rows"]
        crops.append(Crop(found[view], rpc, size, (low, high)))
    if heights:
        _write_visibility(scratch, crops, stores, found)
    pinholes = tuple(Pinhole.fit(crop, frame) for crop in crops)
    for view, hole in zip(("left", "right"), pinholes):
        name = f"colmap/images/{hole.crop.name}"
        _write_without_skew(scratch / hole.crop.name, scratch / name, hole)
        found |= _listed(scratch, f"{view}_colmap", name)
        found |= {
            f"{view}_colmap_skew": hole.skew,
            f"{view}_colmap_max_error_px": float(f"{hole.max_error_px:.2g}"),
        }
    pixels = [np.stack(crop.rpc.project(*ground.T), 1) for crop in crops]
    inside = np.ones(len(ground), bool)
    for crop, at in zip(crops, pixels):
        inside &= ((at > -0.5) & (at < np.array(crop.size) - 0.5)).all(axis=1)
    return found, Pair(pinholes, ground[inside], tuple(at[inside] for at in pixels))


def _listed(scratch: Path, column: str, name: str) -> dict[str, str]:
    """The cells of a file that was written; empty without one."""
    return {column: name, f"{column}_sha256": file_sha256(scratch / name) if name else ""}


def _labels(
    tiles: Path, row: Mapping[str, str], record: Mapping[str, Any]
) -> tuple[Floats, tuple[float, float]]:
    """Ground [n, 3] of some of a tile's labels; lowest and highest that its crops show, m.

    The heights are those of the labels and a margin, or without any those that the scene may have.
    """
    disparity = np.empty((0, 0))
    if row["disp"]:
        with open_raster(tiles / row["disp"]) as source:
            disparity = source.read(1, masked=True).filled(np.nan).astype(np.float64)
    y, x = np.nonzero(np.isfinite(disparity))
    if not y.size:
        return np.empty((0, 3)), tuple(record["ground"]["height_range_m"])
    d, every = disparity[y, x], max(1, len(disparity) // POINTS)
    chosen = (y % every == every // 2) & (x % every == every // 2)
    chosen |= (d == d.min()) | (d == d.max())
    place = evaluate(record["ground"], x[chosen], y[chosen], d[chosen])
    low, high = place["height"].min() - HEIGHT_MARGIN_M, place["height"].max() + HEIGHT_MARGIN_M
    return np.stack([place[k] for k in ("lon", "lat", "height")], 1), (float(low), float(high))


def _taken(image: str | Path, cell: Cells, rpc: RPC) -> Acquisition:
    """When and by which sun an image was taken: by ``cell`` (day or time, azimuth and elevation of
    the sun in degrees), or else by its delivery."""
    acquired, azimuth, elevation = cell
    place = float(rpc.long_off), float(rpc.lat_off)
    sun = None if azimuth is None or elevation is None else (azimuth, elevation)
    time = acquisition_time(acquired) if acquired else None
    return by_sheet(read_acquisition(image, place), time, sun, place)


def _write_cameras(
    scratch: Path,
    place: Sequence[float],
    made: Sequence[tuple[dict[str, Any], Pair]],
    images: Mapping[str, tuple[str | Path, str | Path]],
    cells: Mapping[str, Sequence[Cells]],
) -> list[dict[str, Any]]:
    """Write the files of satnerf, EOGS and COLMAP; the rows of the table with what they hold."""
    known: dict[str, list[Acquisition]] = {}
    for found, pair in made:
        if (scene := found["scene"]) not in known:
            each = zip(images[scene], cells.get(scene, NO_CELLS), pair.pinholes)
            known[scene] = [_taken(image, cell, hole.crop.rpc) for image, cell, hole in each]
    pairs, taken = [pair for _, pair in made], [known[found["scene"]] for found, _ in made]
    write_satnerf(scratch / "satnerf", pairs, taken)
    write_colmap(scratch / "colmap/sparse/0", pairs, local_frame(*place))
    frame = {"lon": place[0], "lat": place[1], "height": 0.0, "axes": "east, north, up; m"}
    (scratch / "colmap/frame.json").write_text(json.dumps(frame), encoding="ascii")
    for (found, pair), both in zip(made, taken):
        folder = f"eogs/{found['tile']}"
        errors = write_eogs(scratch / folder, pair, both)
        found |= _listed(scratch, "eogs", f"{folder}/affine_models.json")
        for view, hole, error in zip(("left", "right"), pair.pinholes, errors):
            found |= _listed(scratch, f"{view}_satnerf", f"satnerf/{hole.crop.json_name}")
            found[f"{view}_eogs_max_error_px"] = float(f"{error:.2g}")
    return [found for found, _ in made]


def _crop(
    image: Path, out: Path, record: Mapping[str, Any], view: str, row: Mapping[str, str]
) -> tuple[dict[str, Any], RPC]:
    """Write one crop with its RPC; where it lies, for the table, and the RPC."""
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
            "driver": "GTiff",
            "width": cols,
            "height": rows,
            "count": source.count,
            "dtype": source.dtypes[0],
            "nodata": source.nodata,
            "photometric": "RGB" if source.colorinterp[0] == ColorInterp.red else "MINISBLACK",
            "compress": "deflate",
            "predictor": 1 if source.dtypes[0].startswith("float") else 2,
            "tiled": True,
        }
        masked = rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True)
        with masked, open_raster(out, "w", **options) as target:
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
    return found | {f"{view}_rpc_max_error_px": record["corrected_rpc_max_error_px"]}, rpc


def _heights_of_crop(
    store: str | Path, layer: str, crop: Path, place: Mapping[str, Any]
) -> NDArray[Any]:
    """A layer of an image's heights where a crop of it lies; ``place``: row of the table."""
    view = crop.parent.name
    first = place[f"{view}_row0"], place[f"{view}_col0"]
    shape = place[f"{view}_rows"], place[f"{view}_cols"]
    window = tuple(slice(start, start + size) for start, size in zip(first, shape))
    values = np.asarray(require_complete(store)[layer][window])
    if values.shape != shape:
        raise InputError(
            f"is of another image than {view}/{crop.name}: it ends before the crop",
            file=store,
            remedy="delete it and run the workflow again",
        )
    return values


def _write_beside(out: Path, values: NDArray[Any], kind: LayerKind, crop: Path) -> None:
    """Write a layer of a crop, with the crop's RPC."""
    if kind.dtype.startswith("float"):
        values = np.where(np.isfinite(values), values, kind.nodata).astype(kind.dtype)
    write_tiff(out, values, nodata=kind.nodata, description=kind.description)
    with open_raster(crop) as source, open_raster(out, "r+") as target:
        target.rpcs = source.rpcs


def _write_visibility(
    scratch: Path, crops: Sequence[Crop], stores: Sequence[Any], found: dict[str, Any]
) -> None:
    """Write, where both images have heights, what of each crop the other one shows."""
    both = all(stores)
    heights = [
        _heights_of_crop(store, "height", scratch / crop.name, found)
        for store, crop in zip(stores if both else (), crops)
    ]
    for k, crop in enumerate(crops):
        view = crop.name.partition("/")[0]
        name = crop.name.replace(view, f"{view}_visibility", 1) if both else ""
        if both:
            seen = visibility(crop, crops[1 - k], heights[k], heights[1 - k])
            _write_beside(scratch / name, seen, VISIBILITY, scratch / crop.name)
        found |= _listed(scratch, f"{view}_visibility", name)


def visibility(
    one: Crop, other: Crop, heights: NDArray[np.floating], there: NDArray[np.floating]
) -> NDArray[np.uint8]:
    """Whether the other image shows what each pixel of a crop shows; see VISIBILITY.

    ``heights`` and ``there``: of both crops, m, NaN where there is none. The nearest pixel of the
    other crop shows the same place if its own lies within SAME_PX in the first; it hides the place
    if it shows something else that is higher.
    """
    row, col = np.nonzero(np.isfinite(heights))
    height = heights[row, col].astype(np.float64)
    at = np.rint(other.rpc.project(*one.rpc.localize(col, row, height), height)).astype(np.int64)
    inside = ((at >= 0) & (at < np.array(other.size)[:, None])).all(axis=0)
    row, col, height, at = row[inside], col[inside], height[inside], at[:, inside]
    met = there[at[1], at[0]].astype(np.float64)
    back = one.rpc.project(*other.rpc.localize(*at, met), met)
    apart = np.hypot(back[0] - col, back[1] - row)
    found = np.zeros(heights.shape, np.uint8)
    found[row, col] = np.where(apart <= SAME_PX, 1, np.where(met > height, 2, 0))
    return found


def _write_without_skew(crop: Path, out: Path, hole: Pinhole) -> None:
    """Write the image that a pinhole camera has of a crop, by cubic convolution along its rows.

    Of colour images red, green and blue; 0 where the crop has nothing, or nodata.
    """
    at = hole.columns()
    with open_raster(crop) as source:
        bands = source.read([1, 2, 3] if source.count > 2 else [1])
    values = np.nan_to_num(np.stack([warp_rows(band.astype(np.float64), at) for band in bands]))
    if (kind := bands.dtype).kind in "iu":
        values = np.clip(np.rint(values), np.iinfo(kind).min, np.iinfo(kind).max)
    write_tiff(out, (values if len(bands) > 1 else values[0]).astype(kind))
