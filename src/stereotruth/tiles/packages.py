"""The dataset in few large files that load in one line: WebDataset shards and Parquet.

Both hold, of each labelled pair, the arrays of the tiles as they are (images, and disparity with
its nodata value), pictures of 8 bits for viewers, which would make 8 bits of the arrays, and what
the manifest says. ``README.md`` is the card that dataset hubs read: features, splits, licence,
conventions.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from ..core.config.configuration import NEEDED
from ..core.errors import InputError, require_packages
from ..core.products.provenance import file_sha256
from ..pages import pictures
from .manifest import SPLITS

Row = Mapping[str, str]  # of the manifest
Sample = dict[str, Any]  # of one pair, by column

SHARD_PAIRS = 32
ROW_GROUP = 4  # pairs of Parquet that are read at once
PLAIN = {**dict.fromkeys(("tile", "city", "scene", "split"), "string"), "right_offset_px": "int32"}
ARRAYS = ("left", "right", "disparity")
PICTURES = {"preview_left": "jpg", "preview_right": "jpg", "preview_disparity": "png"}
NAMES = {"parquet": "data/{}-{:05d}.parquet", "webdataset": "data/{}-{:05d}.tar"}
LOADING = {
    "parquet": 'datasets.load_dataset("this/folder", split="train").with_format("numpy")',
    "webdataset": 'webdataset.WebDataset("this/folder/data/train-00000.tar").decode()',
}
CARD = """---
{front}---
# Satellite stereo pairs with ground-truth disparity

    {loading}

- `left`, `right`: epipolar images, digital numbers, 0 where there is no value. `left` is the
  reference. Rows correspond: the match of left pixel (x, y) is right pixel (x - d, y); (0, 0) is
  the centre of the upper-left pixel.
- `disparity`: d = x_left - x_right in px, float32 on the pixels of `left`. Its sign: d increases
  with height. {nodata}: no label.
- `right_offset_px`: px by which the right image is shifted, already inside d.
- `preview_left`, `preview_right`, `preview_disparity`: pictures of 8 bits to look at, not to
  measure in.
- No ground lies in two splits.
- Licence: {license}.
"""


def sample_of(row: Row, *arrays: NDArray[Any]) -> Sample:
    """Of a pair: its line of the manifest, and left, right and disparity [h, w] as stored."""
    labels = np.where(arrays[2] == float(row["disparity_nodata"]), np.nan, arrays[2])
    looks = *(pictures.stretch(image) for image in arrays[:2]), pictures.colours(labels)
    shown = {}
    for (name, kind), look in zip(PICTURES.items(), looks):
        bands = np.ascontiguousarray(look[..., ::-1]) if look.ndim == 3 else look
        shown[name] = cv2.imencode(f".{kind}", bands)[1].tobytes()
    plain = {name: row[name] for name in PLAIN} | {"right_offset_px": int(row["right_offset_px"])}
    return plain | dict(zip(ARRAYS, arrays)) | shown


def write_packages(
    folder: Path, rows: Sequence[Row], load: Callable[[Row], Sample], layout: str, licence: str
) -> list[dict[str, Any]]:
    """Write the pairs of ``rows`` and the card; lines of the manifest, with each pair's file.

    Raises InputError if pairs differ in size or type, or if a library is missing.
    """
    table: list[dict[str, Any]] = []
    splits: list[dict[str, Any]] = []
    kinds: dict[str, tuple[tuple[int, ...], str]] = {}
    (folder / "data").mkdir()
    for split in SPLITS:
        of = [row for row in rows if row["split"] == split]
        if of:
            splits.append({"name": split, "num_examples": len(of), "num_bytes": 0})
        for first in range(0, len(of), SHARD_PAIRS):
            samples = [load(row) for row in of[first : first + SHARD_PAIRS]]
            for sample in samples:
                found = {name: (sample[name].shape, str(sample[name].dtype)) for name in ARRAYS}
                if found != (kinds := kinds or found):
                    problem = f"tile {sample['tile']} is of {found}, others of {kinds}"
                    raise InputError(problem, file=folder, remedy="make all tiles alike")
            name = NAMES[layout].format(split, first // SHARD_PAIRS)
            {"parquet": _parquet, "webdataset": _shard}[layout](folder / name, samples)
            said = {"shard": name, "shard_sha256": file_sha256(folder / name)}
            splits[-1]["num_bytes"] += (folder / name).stat().st_size
            table += [{key: sample[key] for key in PLAIN} | said for sample in samples]
    features = PLAIN | dict.fromkeys(PICTURES, "image")
    for name, (shape, dtype) in kinds.items():
        features[name] = {f"array{len(shape)}_d": {"shape": list(shape), "dtype": dtype}}
    files = [{"split": of["name"], "path": f"data/{of['name']}-*"} for of in splits]
    front: dict[str, Any] = {
        "license": licence,
        "tags": ["stereo-matching", "disparity", "satellite", "remote-sensing"],
        "configs": [{"config_name": "default", "data_files": files}],
    }
    if layout == "parquet":  # WebDataset's own reader finds the features
        front["dataset_info"] = {
            "features": [{"name": of, "dtype": dtype} for of, dtype in features.items()],
            "splits": splits,
        }
    text = CARD.format(
        front=yaml.safe_dump(front, sort_keys=False),
        loading=LOADING[layout],
        nodata=" or ".join(sorted({row["disparity_nodata"] for row in rows})),
        license=licence,
    )
    (folder / "README.md").write_text(text, encoding="utf-8")
    return table


def _shard(path: Path, samples: Sequence[Sample]) -> None:
    """A tar file with a member for each column of a sample."""
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as shard:
        for sample in samples:
            members = {"json": json.dumps({name: sample[name] for name in PLAIN}).encode()}
            for name in ARRAYS:
                np.save(stream := io.BytesIO(), sample[name], allow_pickle=False)
                members[f"{name}.npy"] = stream.getvalue()
            members |= {f"{name}.{kind}": sample[name] for name, kind in PICTURES.items()}
            for ending, content in members.items():
                member = tarfile.TarInfo(f"{sample['tile']}.{ending}")
                member.size = len(content)
                shard.addfile(member, io.BytesIO(content))


def _parquet(path: Path, samples: Sequence[Sample]) -> None:
    """A file with a line for each sample; arrays are lists of lists."""
    require_packages("dataset: parquet", NEEDED["parquet"], "catalog")
    import pyarrow as pa
    from pyarrow import parquet

    def nested(array: NDArray[Any]) -> pa.Array:
        found = pa.array(array.reshape(-1))
        for axis in range(array.ndim - 1, 0, -1):
            count = int(np.prod(array.shape[:axis]))
            steps = np.arange(count + 1, dtype=np.int32) * array.shape[axis]
            found = pa.ListArray.from_arrays(pa.array(steps, pa.int32()), found)
        return found

    columns = {name: pa.array([s[name] for s in samples], kind) for name, kind in PLAIN.items()}
    for name in PICTURES:
        columns[name] = pa.array([{"bytes": s[name], "path": None} for s in samples])
    columns |= {name: nested(np.stack([s[name] for s in samples])) for name in ARRAYS}
    how = {"compression": "zstd", "use_dictionary": False, "row_group_size": ROW_GROUP}
    parquet.write_table(pa.table(columns), path, **how)
