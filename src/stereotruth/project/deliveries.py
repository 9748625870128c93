"""Which files of a satellite delivery are the two images, and which of them looks backward."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rasterio.errors import RasterioError

from ..align.images import open_view
from ..core.errors import InputError
from ..core.products.folders import files_below
from ..core.products.ungeoreferenced import open_raster
from ..sensor.rpc import SensorModel
from ..sensor.rpc_files import rpc_file

SUFFIXES = {".tif", ".tiff", ".jp2", ".ntf", ".nitf", ".img"}
# Names of suppliers (GaoFen-7, ZY-3, Cartosat, ALOS PRISM) for the views along the track, and the
# plain words.
VIEWS = (
    ("left", re.compile(r"(?<![A-Za-z])(BWD|BACKWARD|LEFT)(?![A-Za-z])", re.IGNORECASE)),
    ("right", re.compile(r"(?<![A-Za-z])(FWD|FORWARD|RIGHT)(?![A-Za-z])", re.IGNORECASE)),
)
# What lies beside the images that are wanted: bands of colour, browse images.
OTHERS = re.compile(
    r"(?<![A-Za-z])(MUX|MSS?|MULTI|BROWSE|THUMB\w*|QUICKLOOK|PREVIEW|ICON)(?![A-Za-z])",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Image:
    """An image with a usable RPC; ``view`` is what is said of it: left, right, or nothing."""

    path: Path
    view: str
    sensor: SensorModel
    size: tuple[int, int]


def _view(file: Path) -> str:
    return next((view for view, words in VIEWS if words.search(file.name)), "")


def find_pair(given: Sequence[Path]) -> tuple[tuple[Image, Image], list[str]]:
    """The two images of a delivery's folder, or those that are named; and remarks.

    Left first where the names of the files say it, or who names them one by one. Raises
    InputError, naming what there is, if there are not two, or one has no RPC that can be read.
    """
    given = [Path(path) for path in given]
    for path in given:
        if not path.exists():
            raise InputError("no such file or folder", file=path, remedy="correct the path")
    if len(given) == 2 and all(path.is_file() for path in given):
        files, lines = given, []
    elif all(path.is_dir() for path in given):
        files, lines = _in_folders(given)
    else:
        raise InputError(
            "is not two images, nor a folder",
            file=given[0],
            remedy="name the delivery's folder (or both folders), or the left and right image",
        )
    images = [_open(file) for file in files]
    if {image.view for image in images} == {"left", "right"}:
        images.sort(key=lambda image: image.view)
    elif files == given:  # named one by one: left, right
        images = [replace(image, view=view) for image, view in zip(images, ("left", "right"))]
    for image in images:
        source = rpc_file(image.path)
        told = "its own metadata" if source == image.path else source.name
        lines.append(f"{image.path.name}: {image.size[0]} x {image.size[1]} px, RPC from {told}")
    return (images[0], images[1]), lines


def _open(file: Path) -> Image:
    sensor, size = open_view(_view(file) or "first", file, "")
    return Image(file, _view(file), sensor, size)


def _in_folders(folders: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """The files of the pair below folders, and remarks on those that were passed over."""
    every = sorted(file for folder in folders for file in files_below(folder) if file.is_file())
    files = [file for file in every if file.suffix.lower() in SUFFIXES]
    mosaics = [file for file in every if file.suffix.lower() == ".til"]
    for mosaic in mosaics:
        _refuse_mosaic(mosaic)
    wanted = [file for file in files if not OTHERS.search(file.stem)]
    single = [file for file in wanted if _bands(file) == 1]
    if len(single) >= 2:
        wanted = single
    named = {view: [file for file in wanted if _view(file) == view] for view, _ in VIEWS}
    if all(len(found) == 1 for found in named.values()):
        wanted = [named["left"][0], named["right"][0]]
    lines = []
    if passed := [file.name for file in files if file not in wanted]:
        lines.append(f"passed over: {', '.join(passed[:6])}" + " …" * (len(passed) > 6))
    if len(wanted) != 2:
        there = ", ".join(str(file) for file in wanted[:8]) or "none"
        raise InputError(
            f"{len(wanted)} images that may be of the pair: {there}",
            file=folders[0],
            remedy="name the two: stereotruth scene add LEFT RIGHT --lidar …",
        )
    return wanted, lines


def _bands(file: Path) -> int:
    """Number of bands; 0 of a file that is no image of a readable format."""
    try:
        with open_raster(file) as dataset:
            return dataset.count
    except RasterioError:
        return 0


def _refuse_mosaic(mosaic: Path) -> None:
    """Refuse a WorldView TIL of several files: formats that point at others are not read."""
    text = mosaic.read_text(encoding="utf-8", errors="replace")
    parts = re.findall(r'filename\s*=\s*"([^"]+)"', text, flags=re.IGNORECASE)
    if len(parts) > 1:
        raise InputError(
            f"an image in {len(parts)} files ({parts[0]} …); a pair has one file a view",
            file=mosaic,
            remedy=f"put them together, gdal_translate {mosaic.name} {mosaic.stem}.TIF, keep "
            f"{mosaic.stem}.RPB beside it, and move the parts and the TIL away",
        )
    part = mosaic.with_name(parts[0]) if parts else mosaic
    rpb = mosaic.with_suffix(".RPB")
    if part.stem != mosaic.stem and rpb.is_file() and rpc_file(part) == part:
        raise InputError(
            f"its RPC file {rpb.name} has another name than its image {part.name}",
            file=mosaic,
            remedy=f"copy it: cp {rpb.name} {part.stem}.RPB",
        )
