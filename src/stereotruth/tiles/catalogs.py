"""The dataset as a STAC collection, and as Croissant, by libraries of the extra ``catalog``.

*STAC*: an item for each pair, its files as assets. ``stac/collection.json``,
``stac/<tile>/<tile>.json``; orientation files and the corrected RPCs of the original images are
copied to ``stac/orientation/`` and ``stac/rpc/``. Links are relative, so that the folder can be
moved as a whole. Tiles lie in no map projection: ``proj:code`` is null, and ``proj:shape``, the
footprint and the orientation file say where they are.

*Croissant*, the vocabulary of data sets for machine learning: ``croissant.json`` has the files'
sets and the record set ``pairs``: lines of the manifest, with the paths of images and disparities.
Their pixels are no fields: mlcroissant makes 8 bits of a TIFF's.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import mlcroissant as mlc
import numpy as np
import pystac
from pystac.extensions.file import FileExtension
from pystac.extensions.projection import ProjectionExtension
from pystac.extensions.raster import RasterBand, RasterExtension

from ..core.errors import InputError
from ..core.products.provenance import file_sha256
from ..core.products.rasters import image_facts
from ..sensor.rpc import RPC
from ..sensor.rpc_files import rpc_text
from .manifest import FOOTPRINTS, NO_TRUTH, TRUTH

FOLDER = "stac"
PREFIX = "stereotruth"
TEXTS = ("tile", "city", "scene", "split", "class", "quality")
LONG_AGO, EVER = datetime(1970, 1, 1, tzinfo=UTC), datetime(2100, 1, 1, tzinfo=UTC)
IMAGES = {"left": "left epipolar image", "right": "right epipolar image"}
TIFF, JSON, TEXT = "image/tiff", "application/json", "text/plain"
CROISSANT = "croissant.json"
URL = "https://doi.org/10.1109/TGRS.2023.3245205"
TEXT_FIELD = mlc.DataType.TEXT
COLUMNS = {
    **dict.fromkeys(("tile", "city", "scene", "split"), TEXT_FIELD),
    "right_offset_px": mlc.DataType.INTEGER,
    "labelled_share": mlc.DataType.FLOAT,
    **dict.fromkeys(("left", "right", "disp"), TEXT_FIELD),
}
KINDS = {
    "left": ("left", "left epipolar image, the reference"),
    "right": ("right", "right epipolar image"),
    "disparity": ("disp", "disparity x_left - x_right in px; -999: none"),
}


def _when(text: str, scene: str) -> datetime:
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        raise InputError(
            f"dataset.acquired.{scene}: {text!r} is no date",
            remedy="write it as 2020-10-25 or 2020-10-25T03:12:45Z",
        ) from None
    return found if found.tzinfo else found.replace(tzinfo=UTC)


def write_stac(
    folder: Path,
    rows: Sequence[dict[str, Any]],
    orientations: Mapping[str, Path],
    footprints: Mapping[str, Mapping[str, Any]],
    acquired: Mapping[str, str],
    licence: str,
) -> None:
    """Write the collection of the dataset in ``folder``; adds its files to the manifest's ``rows``.

    ``orientations`` and ``footprints`` by tile, ``acquired``: dates by scene.
    ``licence`` of the dataset. Raises InputError for
    what is no date.
    """
    root = folder / FOLDER
    for name in ("orientation", "rpc"):
        (root / name).mkdir(parents=True)
    times = {scene: _when(text, scene) for scene, text in acquired.items()}
    items = []
    for row in rows:
        row["orientation"] = f"{FOLDER}/orientation/{row['tile']}.json"
        shutil.copyfile(orientations[row["tile"]], folder / row["orientation"])
        row["orientation_sha256"] = file_sha256(folder / row["orientation"])
        items.append(_item(folder, row, footprints[row["tile"]], times.get(row["scene"])))
    boxes = np.array([item.bbox for item in items])
    whole = [*boxes[:, :2].min(axis=0).tolist(), *boxes[:, 2:].max(axis=0).tolist()]
    known = sorted(item.datetime for item in items if item.datetime)
    unknown = len(known) < len(items)
    span = [LONG_AGO, EVER] if unknown else [known[0], known[-1]]
    collection = pystac.Collection(
        "stereotruth",
        "Epipolar pairs of satellite images with ground-truth disparity",
        pystac.Extent(pystac.SpatialExtent([whole]), pystac.TemporalExtent([span])),
        license=licence,
        keywords=["satellite stereo", "disparity", "LiDAR"],
        summaries=pystac.Summaries({f"{PREFIX}:split": sorted({row["split"] for row in rows})}),
    )
    for name, kind in (("manifest.csv", "text/csv"), (FOOTPRINTS, "application/geo+json")):
        asset = pystac.Asset(str(folder / name), None, None, kind)
        collection.add_asset(name.partition(".")[0], asset)
    collection.add_items(items)
    collection.normalize_hrefs(str(root))
    collection.make_asset_hrefs_relative()
    collection.make_all_asset_hrefs_relative()
    collection.save(catalog_type=pystac.CatalogType.SELF_CONTAINED)
    for row in rows:
        row["item"] = f"{FOLDER}/{row['tile']}/{row['tile']}.json"
        row["item_sha256"] = file_sha256(folder / row["item"])


def _item(
    folder: Path, row: Mapping[str, Any], place: Mapping[str, Any], when: datetime | None
) -> pystac.Item:
    ring = np.array(place["geometry"]["coordinates"][0])
    item = pystac.Item(
        row["tile"],
        dict(place["geometry"]),
        [*ring.min(axis=0).tolist(), *ring.max(axis=0).tolist()],
        when,
        {f"{PREFIX}:{name}": row[name] for name in TEXTS if row.get(name)},
        start_datetime=None if when else LONG_AGO,
        end_datetime=None if when else EVER,
    )
    item.properties[f"{PREFIX}:right_offset_px"] = int(row["right_offset_px"])
    item.properties[f"{PREFIX}:labelled_share"] = float(row["labelled_share"])
    item.properties[f"{PREFIX}:acquisition_known"] = when is not None
    side = int(row["size"])
    ProjectionExtension.ext(item, add_if_missing=True).apply(shape=[side, side])
    item.properties["proj:code"] = None
    for view, title in IMAGES.items():
        _raster(item, view, folder / row[view], title, ["data"], None)
    if row["disp"]:
        title = "disparity x_left - x_right of the left image"
        _raster(item, "disparity", folder / row["disp"], title, ["data", "labels"], "px")
    orientation = folder / row["orientation"]
    _asset(item, "orientation", orientation, "orientation file", JSON, ["metadata"])
    record = json.loads(orientation.read_text(encoding="utf-8"))
    for view in IMAGES:
        text = folder / FOLDER / "rpc" / f"{row['scene']}_{view}_RPC.TXT"
        if not text.is_file():
            rpc = RPC.from_dict(record[view]["corrected_rpc"])
            text.write_text(rpc_text(rpc), encoding="ascii")
        title = f"corrected RPC of the original {view} image"
        _asset(item, f"{view}_rpc", text, title, TEXT, ["metadata"])
    return item


def _asset(
    item: pystac.Item, key: str, path: Path, title: str, kind: str, roles: list[str]
) -> pystac.Asset:
    asset = pystac.Asset(str(path), title, None, kind, roles)
    item.add_asset(key, asset)
    checksum = "1220" + file_sha256(path)  # multihash: SHA-256 of 32 bytes
    said = FileExtension.ext(asset, add_if_missing=True)
    said.apply(checksum=checksum, size=path.stat().st_size)
    return asset


def _raster(
    item: pystac.Item, key: str, path: Path, title: str, roles: list[str], unit: str | None
) -> None:
    asset = _asset(item, key, path, title, TIFF, roles)
    facts = image_facts(path)
    band = {"nodata": facts.nodata, "data_type": facts.dtype, "unit": unit}
    bands = [RasterBand.create(**band) for _ in range(facts.bands)]
    RasterExtension.ext(asset, add_if_missing=True).apply(bands)


def write_croissant(folder: Path, licence: str) -> None:
    """Describe the dataset in ``folder``, whose manifest is written."""
    manifest = mlc.FileObject(
        id="manifest",
        name="manifest.csv",
        content_url="manifest.csv",
        encoding_formats=["text/csv"],
        sha256=file_sha256(folder / "manifest.csv"),
    )
    files = [
        mlc.FileSet(
            id=f"{kind}-files",
            name=f"{kind}-files",
            description=meaning,
            encoding_formats=["image/tiff"],
            includes=[
                f"{TRUTH}/*/{place}/*.tiff",
                *([] if kind == "disparity" else [f"{NO_TRUTH}/{place}/*.tiff"]),
            ],
        )
        for kind, (place, meaning) in KINDS.items()
    ]
    fields = [
        mlc.Field(
            id=f"pairs/{column}",
            name=column,
            data_types=[kind],
            source=mlc.Source(file_object="manifest", extract=mlc.Extract(column=column)),
        )
        for column, kind in COLUMNS.items()
    ]
    said = "a pair of images, its labels and files (paths from the folder of this file)"
    pairs = mlc.RecordSet(id="pairs", name="pairs", description=said, fields=fields)
    metadata = mlc.Metadata(
        name="stereotruth",
        description="Epipolar pairs of satellite images with ground-truth disparity",
        url=URL,
        license=[licence],
        distribution=[manifest, *files],
        record_sets=[pairs],
    )
    text = json.dumps(metadata.to_json(), indent=1, default=str)
    (folder / CROISSANT).write_text(text + "\n", encoding="utf-8")
