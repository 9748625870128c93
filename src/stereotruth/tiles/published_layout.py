"""All cities' tiles in the folder layout of the published WHU-Stereo dataset.

Files are copied, not linked: whoever edits the dataset must not change the tiles behind it.
"""

from __future__ import annotations

import logging
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from ..core.errors import InputError, install_extra
from ..core.job import progress
from ..core.products.files import atomic_folder, write_table
from ..core.products.provenance import file_sha256
from .footprints import read_footprints, write_footprints
from .layer_kinds import KINDS, column
from .manifest import read_manifest
from .split_names import NO_TRUTH, NONE, SPLITS, TRUTH
from .splits import shared_ground

log = logging.getLogger("stereotruth")


PAIR = ("left", "right", "disp")
README = """Stereo pairs with ground-truth disparity, in the folder layout of WHU-Stereo

  with ground truth/{{train,val,test}}/{{left,right,disp}}
  without ground truth/{{left,right}}       pairs whose labels are incomplete

{counts}

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


def _rounding(rows: Sequence[dict[str, str]]) -> str:
    largest = max((float(r["disparity_rounding_px"]) for r in rows), default=0.0)
    return f"Stored values are rounded by at most {largest:.4f} px."


def assemble_dataset(
    tile_dirs: Iterable[str | Path],
    out: str | Path,
    *,
    catalogs: Sequence[str] = (),
    acquired: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Copy the cities' tiles to ``out`` in the published layout, with a manifest and a README.

    ``catalogs``: stac, croissant, see :mod:`.stac_catalog` and :mod:`.croissant`; ``acquired``:
    dates by scene.

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
                kinds = *PAIR, *(name for name in KINDS if row.get(column(name)))
                place = f"{TRUTH}/{row['split']}"
            else:
                place, kinds = NO_TRUTH, PAIR[:2]
            todo.append((folder, row, place, kinds))
    with atomic_folder(out) as scratch:
        for split in SPLITS:
            for kind in {*PAIR, *(kind for *_, kinds in todo for kind in kinds)}:
                (scratch / TRUTH / split / kind).mkdir(parents=True)
        for kind in ("left", "right"):
            (scratch / NO_TRUTH / kind).mkdir(parents=True)
        rows = [_copy(*item, scratch) for item in progress(todo, len(todo), "dataset: pairs")]
        counts = Counter(place for _, _, place, _ in todo)
        shared = shared_ground(*(folder / "manifest.csv" for folder in folders))
        for a, b in shared:
            log.warning("%s and %s share ground and are in different splits", a, b)
        footprints = {one["id"]: one for one in _footprints(folders, rows)}
        write_footprints(scratch, footprints.values())
        if rows and "stac" in catalogs:
            where = {row["tile"]: at / row["orientation"] for at, row, *_ in todo}
            _module("stac").write_stac(scratch, rows, where, footprints, acquired or {})
        if rows:
            write_table(scratch / "manifest.csv", rows)
        if rows and "croissant" in catalogs:
            _module("croissant").write_croissant(scratch)
        text = README.format(
            counts="\n".join(f"  {count:5d} pairs  {place}" for place, count in counts.items()),
            nodata=" or ".join(sorted(nodata)),
            rounding=_rounding([row for _, row, _, kinds in todo if "disp" in kinds]),
            shared=f"Except: {shared}." if shared else "",
        )
        (scratch / "README.txt").write_text(text, encoding="utf-8")
    for place, count in sorted(counts.items()):
        log.info("%s/%s: %d pairs", out, place, count)
    return {"pairs": dict(counts), "shared_ground": shared}


def _module(catalog: str) -> ModuleType:
    """The module that writes a catalog, with libraries that not everyone needs."""
    try:
        if catalog == "stac":
            from . import stac_catalog as module
        else:
            from . import croissant as module
    except ModuleNotFoundError as error:
        raise InputError(
            f"dataset.catalogs: {catalog} needs {error.name}, which is not installed",
            remedy=f"{install_extra('catalog')}; or leave it out",
        ) from None
    return module


def _footprints(
    folders: Iterable[Path], rows: Iterable[Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Where the dataset's pairs lie; ``rows`` of its manifest."""
    found = {name: one for folder in folders for name, one in read_footprints(folder).items()}
    for row in rows:
        if one := found.get(row["tile"]):
            files = {kind: row[kind] or None for kind in ("left", "right", "disp")}
            yield one | {"properties": one["properties"] | files}


def _copy(
    folder: Path, row: dict[str, str], place: str, kinds: Sequence[str], scratch: Path
) -> dict[str, Any]:
    """Copy one pair and return its row of the dataset's manifest."""
    row = {k: v for k, v in row.items() if k.partition("_")[0] not in ("status", "orientation")}
    for kind in (*PAIR, *(name for name in KINDS if column(name) in row)):
        cell = kind if kind in PAIR else column(kind)
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
