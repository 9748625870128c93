"""A hand-made city whose right images are the left ones, shifted."""

from __future__ import annotations

import base64
import csv
import json
from pathlib import Path

import cv2
import numpy as np

from stereotruth.core.products.rasters import write_tiff

SIZE = 96
SHIFT = 7  # px of disparity, of every tile
HOLE = np.s_[10:30, 20:50]  # pixels without a label
FLAGS = {0: "no_points", 1: "labelled", 2: "hidden_in_left", 9: "a_new_reason"}
CITY = 'Ville <b>"A & B"<b>'
REASON = "<script>window.broken = true</script> 9.1 px off"


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(SIZE, SIZE + 2 * SHIFT)).astype(np.float32)
    return np.clip(cv2.GaussianBlur(noise, (0, 0), 2.5) * 900 + 600, 1, 2000).astype(np.uint16)


def row_of(name: str, number: int, **values: object) -> dict[str, object]:
    row = {
        "tile": name,
        "number": number,
        "city": CITY,
        "scene": f"S-{1 + number % 2}",
        "row0": SIZE * (number // 2),
        "col0": 0,
        "size": SIZE,
        "right_offset_px": -3,
        "complete": "yes",
        "split": ("train", "test", "val")[number % 3],
        "labelled_share": f"{1 - 600 / SIZE**2:.6f}",
        "disparity_min_px": f"{SHIFT:.4f}",
        "disparity_mean_px": f"{(13 * number) % 10 + 0.5:.4f}",
        "disparity_max_px": f"{SHIFT:.4f}",
        "count_no_points": 0,
        "count_labelled": SIZE**2 - 600,
        "count_hidden_in_left": 0,
        "count_a_new_reason": 600,
        "left": f"left/{name}.tiff",
        "right": f"right/{name}.tiff",
        "disp": f"disp/{name}.tiff",
        "status": f"status/{name}.tiff",
        "left_sha256": "0" * 64,
    }
    return row | values


def write_city(folder: Path, count: int, **columns: list[object]) -> list[dict[str, object]]:
    """tiles/<City> of ``count`` labelled tiles and one without labels; ``columns`` by tile."""
    rows = []
    for kind in ("left", "right", "disp", "status"):
        (folder / kind).mkdir(parents=True)
    for k in range(count + 1):
        name = f"T_{k}"
        row = row_of(name, k, **{key: values[k] for key, values in columns.items()})
        whole = texture(k)
        write_tiff(folder / row["left"], whole[:, SHIFT:-SHIFT], nodata=0)
        write_tiff(folder / row["right"], whole[:, 2 * SHIFT :], nodata=0)
        disparity = np.full((SIZE, SIZE), SHIFT, np.float32)
        disparity[HOLE] = -999
        status = np.where(disparity == -999, 9, 1).astype(np.uint8)
        if k < count:
            write_tiff(folder / row["disp"], disparity, nodata=-999)
            text = ", ".join(f"{value} {name}" for value, name in FLAGS.items())
            write_tiff(folder / row["status"], status, description=text)
        else:
            row |= {"complete": "no", "split": "none", "disp": "", "status": ""}
        rows.append(row)
    with (folder / "manifest.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    (folder / "export.json").write_text(
        json.dumps({"size_px": SIZE, "provenance": {"code": "<i>c0de</i>", "inputs": {"x": "y"}}})
    )
    return rows


def alignment(path: Path) -> Path:
    """Two GCPs off by (3, 4) and (−6, 8) px before, a tenth of it after; a third left out."""
    gcps = [
        {"id": "G1", "measured": [100.0, 50.0], "before": [3.0, 4.0], "used": True, "reason": ""},
        {"id": "G2", "measured": [10.0, 180.0], "before": [-6.0, 8.0], "used": True, "reason": ""},
        {"id": "G3", "measured": [150.0, 90.0], "before": [90.0, 0.0], "used": False,
         "reason": REASON},
    ]  # fmt: skip
    for gcp in gcps:
        gcp["after"] = [v / 10 for v in gcp["before"]]
        gcp["leave_one_out"] = [None, None]
    view = {"size": [200, 200], "gcps": gcps, "rms": {"before": 7.91, "after": 0.79}}
    record = {"model": "shift", "left": view, "right": view, "warnings": [f"left image: {REASON}"]}
    path.write_text(json.dumps(record))
    return path


def picture(uri: str) -> np.ndarray:
    data = base64.b64decode(uri.removeprefix("data:image/webp;base64,"))
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1].astype(int)
