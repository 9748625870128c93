"""The dataset in the layouts of KITTI and US3D (DFC2019), for programs that read these.

``kitti``: ``{training,validation,testing}/{image_2,image_3,disp_occ_0}/<tile>_10.png``. Disparities
are 16-bit PNGs of 256 steps in a px, 0 where there is none, so that they cannot be negative: each
right image is moved along its rows by ``shift_px``, a whole number of px, so that the smallest
disparity of its pair is 1 to 2 px; as many columns at its right end are nodata. What lies above
255.99 px then gets no label.

``us3d``: ``{Train,Validate,Test}-Track2-RGB/<tile>_{LEFT,RIGHT}_RGB.tif`` and
``{Train,Validate,Test}-Track2-Truth/<tile>_LEFT_DSP.tif``. Images are RGB of 8 bits, between
``black`` and ``white`` (digital numbers of both images of a pair), disparities those of the tiles.
With the layers ``agl`` and ``class`` (``tiles.layers``) there are ``<tile>_LEFT_AGL.tif`` (m above
the ground, NaN where it is not known) and ``<tile>_LEFT_CLS.tif`` (LAS classes, 65 where there is
none) beside them.

Each has a ``manifest.csv`` with what was done to each pair, and its checksums.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.job import progress
from ..core.products.files import atomic_folder, write_table
from ..core.products.provenance import file_sha256
from ..core.products.rasters import KITTI_STEPS, read_disparity, read_image, read_labels, write_tiff
from ..pages import pictures
from .layer_kinds import KINDS, column
from .manifest import read_manifest

log = logging.getLogger("stereotruth")

KITTI_SPLITS = {"train": "training", "val": "validation", "test": "testing"}
US3D_SPLITS = {"train": "Train-Track2", "val": "Validate-Track2", "test": "Test-Track2"}
US3D_TRUTH = {"agl": ("AGL", np.nan), "class": ("CLS", 65)}  # ending and value where unknown
KEPT = (
    *("tile", "number", "city", "scene", "row0", "col0", "size", "split", "class", "quality"),
    "doubt",
)


@dataclass(frozen=True)
class _Pair:
    """A labelled pair of the dataset: images [h, w] or [h, w, 3], disparity px with NaN."""

    row: Mapping[str, str]
    left: NDArray[Any]
    right: NDArray[Any]
    disparity: NDArray[np.float32]
    layers: Mapping[str, NDArray[Any]]  # agl, class: of those that the dataset has


def write_layout(dataset: str | Path, out: str | Path, layout: str) -> int:
    """Write the labelled pairs of ``dataset`` (rule dataset's) to ``out``; how many there are.

    Raises InputError if the dataset has no manifest or an image cannot be written so.
    """
    dataset, write = Path(dataset), {"kitti": _kitti, "us3d": _us3d}[layout]
    rows = [row for row in read_manifest(dataset) if row["disp"]]
    with atomic_folder(out) as scratch:
        table = []
        for row in progress(rows, len(rows), f"dataset as {layout}: pairs"):
            images = (read_image(dataset / row[view]) for view in ("left", "right"))
            disparity = read_disparity(dataset / row["disp"], float(row["disparity_nodata"]))
            layers = {
                name: read_labels(dataset / row[column(name)])[0]
                for name in US3D_TRUTH
                if row.get(column(name))
            }
            pair = _Pair(row, *images, disparity, layers)
            files, said = write(scratch, pair)
            record = {name: row[name] for name in KEPT if name in row} | said
            for kind, name in files.items():
                record |= {kind: name, f"{kind}_sha256": file_sha256(scratch / name)}
            table.append(record)
        if table:
            write_table(scratch / "manifest.csv", table)
        (scratch / "README.txt").write_text(__doc__, encoding="utf-8")
    log.info("%s: %d pairs", out, len(rows))
    return len(rows)


def _put_png(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"images of {image.dtype} cannot be PNGs", file=path, remedy="leave out layout kitti"
        )
    if not cv2.imwrite(str(path), image if image.ndim == 2 else image[..., ::-1]):
        raise InputError("cannot be written", file=path, remedy="see that there is space")


def shift_of(disparity: NDArray[np.float32]) -> int:
    """By how many px a right image is moved so that no disparity is below 1 px."""
    known = disparity[np.isfinite(disparity)]
    return max(0, int(np.ceil(1.0 - float(known.min())))) if known.size else 0


def moved(image: NDArray[Any], shift: int) -> NDArray[Any]:
    """An image moved to the left by ``shift`` px; 0 comes in from the right."""
    out = np.zeros_like(image)
    if shift < image.shape[1]:
        out[:, : image.shape[1] - shift] = image[:, shift:]
    return out


def _kitti(folder: Path, pair: _Pair) -> tuple[dict[str, str], dict[str, Any]]:
    shift = shift_of(pair.disparity)
    steps = np.rint((pair.disparity.astype(np.float64) + shift) * KITTI_STEPS)
    beyond = steps > 65535
    steps = np.where(np.isfinite(steps) & ~beyond, steps, 0.0).astype(np.uint16)
    split, tile = KITTI_SPLITS[pair.row["split"]], pair.row["tile"]
    files = {}
    for kind, place, image in (
        ("left", "image_2", pair.left),
        ("right", "image_3", moved(pair.right, shift)),
        ("disp", "disp_occ_0", steps),
    ):
        files[kind] = f"{split}/{place}/{tile}_10.png"
        _put_png(folder / files[kind], image)
    return files, {
        "shift_px": shift,
        "right_offset_px": int(pair.row["right_offset_px"]) - shift,
        "labels_left_out": int(beyond.sum()),
    }


def _us3d(folder: Path, pair: _Pair) -> tuple[dict[str, str], dict[str, Any]]:
    values = np.concatenate([image[image != 0] for image in (pair.left, pair.right)])
    limits = tuple(float(v) for v in np.percentile(values, (0.1, 99.9))) if values.size else (0, 1)
    if pair.left.dtype == np.uint8:
        limits = (1.0, 255.0)  # as they are
    split, tile = US3D_SPLITS[pair.row["split"]], pair.row["tile"]
    files = {}
    for kind, ending in (("left", "LEFT_RGB"), ("right", "RIGHT_RGB")):
        grey = pictures.stretch(getattr(pair, kind), limits=limits)
        bands = np.stack([grey] * 3) if grey.ndim == 2 else np.moveaxis(grey, -1, 0)
        files[kind] = f"{split}-RGB/{tile}_{ending}.tif"
        (folder / files[kind]).parent.mkdir(exist_ok=True)
        write_tiff(folder / files[kind], np.ascontiguousarray(bands))
    files["disp"] = f"{split}-Truth/{tile}_LEFT_DSP.tif"
    (folder / files["disp"]).parent.mkdir(exist_ok=True)
    known = np.isfinite(pair.disparity)
    labels = np.where(known, pair.disparity, np.float32(-999))
    write_tiff(folder / files["disp"], labels, nodata=-999)
    for name, values in pair.layers.items():
        ending, unknown = US3D_TRUTH[name]
        files[name] = f"{split}-Truth/{tile}_LEFT_{ending}.tif"
        nodata = KINDS[name].nodata
        values = np.where(values == nodata, np.asarray(unknown, values.dtype), values)
        write_tiff(folder / files[name], values, nodata=unknown)
    return files, {
        "right_offset_px": int(pair.row["right_offset_px"]),
        "black": f"{limits[0]:g}",
        "white": f"{limits[1]:g}",
    }
