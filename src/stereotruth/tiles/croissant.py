"""The dataset as Croissant, the vocabulary of data sets for machine learning.

``croissant.json`` has the files' sets and the record set ``pairs``: lines of the manifest, with the
paths of images and disparities. Their pixels are no fields: mlcroissant makes 8 bits of a TIFF's.
"""

from __future__ import annotations

import json
from pathlib import Path

import mlcroissant as mlc

from ..core.products.provenance import file_sha256
from .split_names import NO_TRUTH, TRUTH

CROISSANT = "croissant.json"
URL = "https://doi.org/10.1109/TGRS.2023.3245205"
COLUMNS = {
    "tile": mlc.DataType.TEXT,
    "city": mlc.DataType.TEXT,
    "scene": mlc.DataType.TEXT,
    "split": mlc.DataType.TEXT,
    "right_offset_px": mlc.DataType.INTEGER,
    "labelled_share": mlc.DataType.FLOAT,
    "left": mlc.DataType.TEXT,
    "right": mlc.DataType.TEXT,
    "disp": mlc.DataType.TEXT,
}
KINDS = {
    "left": ("left", "left epipolar image, the reference"),
    "right": ("right", "right epipolar image"),
    "disparity": ("disp", "disparity x_left - x_right in px; -999: none"),
}


def write_croissant(folder: Path) -> None:
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
        distribution=[manifest, *files],
        record_sets=[pairs],
    )
    text = json.dumps(metadata.to_json(), indent=1, default=str)
    (folder / CROISSANT).write_text(text + "\n", encoding="utf-8")
