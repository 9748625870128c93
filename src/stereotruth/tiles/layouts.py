"""The dataset of all cities' tiles, in the layouts of WHU-Stereo, KITTI, US3D, and in shards.

WHU-Stereo's is that of the dataset itself (README). Files are copied, not linked: whoever edits the
dataset must not change the tiles behind it. The others (OTHERS) are made of it.
"""

from __future__ import annotations

import logging
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import NEEDED
from ..core.errors import InputError, require_packages
from ..core.job import progress
from ..core.products.files import atomic_folder, read_json, read_record, write_table
from ..core.products.provenance import file_sha256
from ..core.products.rasters import (
    KITTI_STEPS,
    read_disparity,
    read_image,
    read_labels,
    write_tiff,
)
from ..pages import pictures
from . import packages
from .manifest import KINDS, NO_TRUTH, NONE, PATHS, SPLITS, SUM, TRUTH, column, read_manifest
from .quick_looks import read_footprints, write_footprints
from .splits import shared_ground

log = logging.getLogger("stereotruth")
Image, Labels = NDArray[Any], NDArray[np.float32]  # [h, w] or [h, w, 3]; px, NaN: none
Written = tuple[dict[str, str], dict[str, Any]]  # files by kind, and what else its line says

README = """Stereo pairs with ground-truth disparity, in the folder layout of WHU-Stereo

  with ground truth/{{train,val,test}}/{{left,right,disp}}
  without ground truth/{{left,right}}       pairs whose labels are incomplete

{counts}

Licence: {licence}

Conventions
- left: the reference; right: the other view; which of them looks backward is said in orientation.
  uint16, nodata 0. Rows correspond: the match of left pixel (x, y) is right pixel (x - d, y).
  (0, 0) is the centre of the upper-left pixel.
- disp: d = x_left - x_right in px; d increases with height; {nodata}: no label (tagged as nodata).
  {rounding}
- The right image of each pair is shifted by a whole number of px (right_offset_px in
  manifest.csv), which is already inside d: the disparity of the scene is d + right_offset_px.
- height, class, agl, uncertainty, lidar_date, where there are such folders: layers on the grid of
  disp (tiles.layers); nodata is tagged.
- Why a pixel has no label (status), and the way back to heights and to the original images
  (orientation), are in tiles/<City>/ under the same number; manifest.csv has their checksums there.
- No ground lies in two splits: tiles of which two overlap are in one split, or in none and then
  not here. Splits are contiguous regions. {shared}
- quality in manifest.csv: ok, or the limits that the pair's labels exceed when held against its
  images (SIFT matches, image warping); class: building or vegetation. doubt: what the images of
  the whole scene say against its labels, if they do.
- footprints.geojson: where the pairs lie on the ground, with a style for QGIS.
- manifest.csv: a row per pair with scene, window, offset, counts, split and SHA-256 of each file.
"""
OTHERS = """The dataset in the layouts of KITTI and US3D (DFC2019), for programs that read these.

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
KITTI_SPLITS = {"train": "training", "val": "validation", "test": "testing"}
US3D_SPLITS = {"train": "Train-Track2", "val": "Validate-Track2", "test": "Test-Track2"}
US3D_TRUTH = {"agl": ("AGL", np.nan), "class": ("CLS", 65)}  # ending and value where unknown
KEPT = (
    *("tile", "number", "city", "scene", "row0", "col0", "size", "split", "class", "quality"),
    "doubt",
)


def assemble_dataset(
    tile_dirs: Iterable[str | Path],
    out: str | Path,
    *,
    catalogs: Sequence[str] = (),
    acquired: Mapping[str, str] | None = None,
    licence: str = "other",
) -> dict[str, Any]:
    """Copy the cities' tiles to ``out`` in the published layout, with a manifest and a README.

    ``catalogs``: stac, croissant, see :mod:`.catalogs`; ``acquired``:
    dates by scene; ``licence`` of the dataset.

    Each file is held against its manifest's checksum on the way. Tiles of split ``none`` (they
    share ground with two splits) stay behind. Returns counts by folder, and the pairs of tiles
    of different splits that share ground across cities (they are logged as a warning).

    Raises InputError if a city has no manifest, a file was changed, or two cities use one prefix.
    """
    folders, out = [Path(folder) for folder in tile_dirs], Path(out)
    todo, seen, nodata = [], {}, set()
    for folder in folders:
        for row in read_manifest(folder):
            if row["tile"] in seen:
                raise InputError(
                    f"tile {row['tile']} is in {seen[row['tile']]} too",
                    file=folder,
                    remedy="give each city a prefix of its own in the cities sheet",
                )
            seen[row["tile"]] = folder
            if row["complete"] == "yes":
                nodata.add(row["disparity_nodata"])
                if row["split"] == NONE:
                    continue
                kinds = *PATHS, *(name for name in KINDS if row.get(column(name)))
                place = f"{TRUTH}/{row['split']}"
            else:
                place, kinds = NO_TRUTH, PATHS[:2]
            todo.append((folder, row, place, kinds))
    with atomic_folder(out) as scratch:
        for split in SPLITS:
            for kind in {*PATHS, *(kind for *_, kinds in todo for kind in kinds)}:
                (scratch / TRUTH / split / kind).mkdir(parents=True)
        for kind in ("left", "right"):
            (scratch / NO_TRUTH / kind).mkdir(parents=True)
        rows = [_copy(*item, scratch) for item in progress(todo, len(todo), "dataset: pairs")]
        counts = Counter(place for _, _, place, _ in todo)
        shared = shared_ground(*(folder / "manifest.csv" for folder in folders))
        for a, b in shared:
            log.warning("%s and %s share ground and are in different splits", a, b)
        where = {row["tile"]: at / row["orientation"] for at, row, *_ in todo}
        told = {"catalogs": catalogs, "acquired": acquired or {}, "licence": licence}
        write_tables(scratch, rows, dict(_footprints(folders, rows)), where, **told)
        labelled = (row for _, row, _, kinds in todo if "disp" in kinds)
        largest = max((float(row["disparity_rounding_px"]) for row in labelled), default=0.0)
        text = README.format(
            counts="\n".join(f"  {count:5d} pairs  {place}" for place, count in counts.items()),
            nodata=" or ".join(sorted(nodata)),
            rounding=f"Stored values are rounded by at most {largest:.4f} px.",
            shared=f"Except: {shared}." if shared else "",
            licence=licence,
        )
        (scratch / "README.txt").write_text(text, encoding="utf-8")
    for place, count in sorted(counts.items()):
        log.info("%s/%s: %d pairs", out, place, count)
    return {"pairs": dict(counts), "shared_ground": shared}


def write_tables(
    folder: Path,
    rows: Sequence[dict[str, Any]],
    footprints: Mapping[str, Mapping[str, Any]],
    orientations: Mapping[str, Path],
    *,
    catalogs: Sequence[str],
    acquired: Mapping[str, str],
    licence: str,
) -> None:
    """Write all that tells of the pairs in ``folder``: footprints, catalogs, manifest of ``rows``.

    ``footprints`` and ``orientations`` by tile; the rest as in :func:`assemble_dataset`.
    """
    if footprints:
        write_footprints(folder, footprints.values())
    if rows and "stac" in catalogs:
        stac = _catalogs("stac")
        stac.write_stac(folder, rows, orientations, footprints, acquired, licence)
    if rows:
        write_table(folder / "manifest.csv", rows)
    if rows and "croissant" in catalogs:
        _catalogs("croissant").write_croissant(folder, licence)


def catalogs_of(dataset: Path, rows: Iterable[Mapping[str, str]]) -> dict[str, Any]:
    """Catalogs, dates and licence that :func:`write_tables` was given for a dataset."""
    files = {"stac": dataset / "stac/collection.json", "croissant": dataset / "croissant.json"}
    how = {"what": "catalog", "stage": "dataset", "read": read_json}
    licences = {
        name: read_record(file, lambda of: of["license"], **how)
        for name, file in files.items()
        if file.is_file()
    }
    acquired = {}
    for row in rows if "stac" in licences else ():
        when = read_record(dataset / row["item"], lambda of: of["properties"]["datetime"], **how)
        acquired |= {row["scene"]: when} if when else {}
    licence = next(iter(licences.values()), "other")
    return {"catalogs": list(licences), "acquired": acquired, "licence": licence}


def _catalogs(wanted: str) -> ModuleType:
    """The module that writes catalogs, with libraries that not everyone needs."""
    require_packages(f"dataset: {wanted}", NEEDED[wanted], "catalog")
    from . import catalogs

    return catalogs


def _footprints(
    folders: Iterable[Path], rows: Iterable[Mapping[str, Any]]
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Where the dataset's pairs lie, by tile; ``rows`` of its manifest."""
    found = {name: one for folder in folders for name, one in read_footprints(folder).items()}
    for row in rows:
        if one := found.get(row["tile"]):
            files = {kind: row[kind] or None for kind in PATHS}
            yield row["tile"], one | {"properties": one["properties"] | files}


def _copy(
    folder: Path, row: dict[str, str], place: str, kinds: Sequence[str], scratch: Path
) -> dict[str, Any]:
    """Copy one pair and return its row of the dataset's manifest."""
    kept = {*PATHS, *map(column, KINDS)}  # of a tile's files; the others stay in its folder
    files = {key.removesuffix(SUM) for key in row if key.endswith(SUM)} - kept
    row = {key: value for key, value in row.items() if key.removesuffix(SUM) not in files}
    for kind in (*PATHS, *(name for name in KINDS if column(name) in row)):
        cell = kind if kind in PATHS else column(kind)
        if kind not in kinds:
            row[cell] = row[f"{cell}_sha256"] = ""
            continue
        source, target = folder / row[cell], f"{place}/{kind}/{Path(row[cell]).name}"
        if not source.is_file():
            raise InputError("file is missing", file=source, remedy=f"make {folder} again")
        shutil.copyfile(source, scratch / target)
        if file_sha256(scratch / target) != row[f"{cell}_sha256"]:
            raise InputError(
                "file is not as in its manifest", file=source, remedy=f"make {folder} again"
            )
        row[cell] = target
    return row


# ------------------------------------------------------------------ other layouts


def write_layout(
    dataset: str | Path, out: str | Path, layout: str, *, licence: str = "other"
) -> int:
    """Write the labelled pairs of ``dataset`` (rule dataset's) to ``out``; how many there are.

    ``licence``: of the card of webdataset and parquet.

    Raises InputError if the dataset has no manifest or an image cannot be written so.
    """
    dataset = Path(dataset)
    rows = [row for row in read_manifest(dataset) if row["disp"]]

    def load(row: Mapping[str, str]) -> packages.Sample:
        images = (read_image(dataset / row[view]) for view in ("left", "right"))
        return packages.sample_of(row, *images, read_labels(dataset / row["disp"])[0])

    with atomic_folder(out) as scratch:
        if layout in packages.NAMES:
            table = packages.write_packages(scratch, rows, load, layout, licence)
        else:
            reported = progress(rows, len(rows), f"dataset as {layout}: pairs")
            table = [_write_pair(dataset, row, scratch, layout) for row in reported]
            (scratch / "README.txt").write_text(OTHERS, encoding="utf-8")
        if table:
            write_table(scratch / "manifest.csv", table)
    log.info("%s: %d pairs", out, len(rows))
    return len(rows)


def _write_pair(
    dataset: Path, row: Mapping[str, str], scratch: Path, layout: str
) -> dict[str, Any]:
    """Write a pair in the layout of kitti or us3d; its line of the manifest."""
    images = [read_image(dataset / row[view]) for view in ("left", "right")]
    disparity = read_disparity(dataset / row["disp"], float(row["disparity_nodata"]))
    if layout == "kitti":
        files, said = _kitti(scratch, row, images, disparity)
    else:
        there = [name for name in US3D_TRUTH if row.get(column(name))]
        layers = {name: read_labels(dataset / row[column(name)])[0] for name in there}
        files, said = _us3d(scratch, row, images, disparity, layers)
    record = {name: row[name] for name in KEPT if name in row} | said
    for kind, name in files.items():
        record |= {kind: name, f"{kind}_sha256": file_sha256(scratch / name)}
    return record


def _put_png(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"images of {image.dtype} cannot be PNGs", file=path, remedy="leave out layout kitti"
        )
    if not cv2.imwrite(str(path), image if image.ndim == 2 else image[..., ::-1]):
        raise InputError("cannot be written", file=path, remedy="see that there is space")


def moved(image: NDArray[Any], shift: int) -> NDArray[Any]:
    """An image moved to the left by ``shift`` px; 0 comes in from the right."""
    out = np.zeros_like(image)
    if shift < image.shape[1]:
        out[:, : image.shape[1] - shift] = image[:, shift:]
    return out


def _kitti(
    folder: Path, row: Mapping[str, str], images: Sequence[Image], disparity: Labels
) -> Written:
    known = disparity[np.isfinite(disparity)]
    shift = max(0, int(np.ceil(1.0 - float(known.min())))) if known.size else 0  # none below 1 px
    steps = np.rint((disparity.astype(np.float64) + shift) * KITTI_STEPS)
    beyond = steps > 65535
    steps = np.where(np.isfinite(steps) & ~beyond, steps, 0.0).astype(np.uint16)
    split, tile = KITTI_SPLITS[row["split"]], row["tile"]
    files = {}
    for kind, place, image in (
        ("left", "image_2", images[0]),
        ("right", "image_3", moved(images[1], shift)),
        ("disp", "disp_occ_0", steps),
    ):
        files[kind] = f"{split}/{place}/{tile}_10.png"
        _put_png(folder / files[kind], image)
    return files, {
        "shift_px": shift,
        "right_offset_px": int(row["right_offset_px"]) - shift,
        "labels_left_out": int(beyond.sum()),
    }


def _us3d(
    folder: Path,
    row: Mapping[str, str],
    images: Sequence[Image],
    disparity: Labels,
    layers: Mapping[str, NDArray[Any]],
) -> Written:
    values = np.concatenate([image[image != 0] for image in images])
    limits = tuple(float(v) for v in np.percentile(values, (0.1, 99.9))) if values.size else (0, 1)
    if images[0].dtype == np.uint8:
        limits = (1.0, 255.0)  # as they are
    split, tile = US3D_SPLITS[row["split"]], row["tile"]
    files = {}
    for kind, image in zip(("left", "right"), images):
        grey = pictures.stretch(image, limits=limits)
        bands = np.stack([grey] * 3) if grey.ndim == 2 else np.moveaxis(grey, -1, 0)
        files[kind] = f"{split}-RGB/{tile}_{kind.upper()}_RGB.tif"
        (folder / files[kind]).parent.mkdir(exist_ok=True)
        write_tiff(folder / files[kind], np.ascontiguousarray(bands))
    files["disp"] = f"{split}-Truth/{tile}_LEFT_DSP.tif"
    (folder / files["disp"]).parent.mkdir(exist_ok=True)
    labels = np.where(np.isfinite(disparity), disparity, np.float32(-999))
    write_tiff(folder / files["disp"], labels, nodata=-999)
    for name, values in layers.items():
        ending, unknown = US3D_TRUTH[name]
        files[name] = f"{split}-Truth/{tile}_LEFT_{ending}.tif"
        nodata = KINDS[name].nodata
        values = np.where(values == nodata, np.asarray(unknown, values.dtype), values)
        write_tiff(folder / files[name], values, nodata=unknown)
    return files, {
        "right_offset_px": int(row["right_offset_px"]),
        "black": f"{limits[0]:g}",
        "white": f"{limits[1]:g}",
    }
