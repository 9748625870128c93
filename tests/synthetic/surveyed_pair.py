"""Two images with biased RPCs and control points that were measured in them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import rasterio

from stereotruth.align.align import align
from stereotruth.align.alignment import Alignment
from stereotruth.align.control_points import COLUMNS
from stereotruth.sensor.rpc import RPC, SensorModel

LON, LAT, HEIGHT = 115.4, 30.2, 60.0
SIZES = {"left": (4000, 3000), "right": (3600, 2800)}
TRUE = {
    "left": np.array([[1.0002, -0.0001, 6.3], [0.0001, 0.9999, -4.1]]),
    "right": np.array([[0.9998, 0.0002, -3.7], [-0.0001, 1.0001, 8.8]]),
}


def linear_rpc(gsd: float, angle_deg: float, size: tuple[int, int]) -> RPC:
    """Parallel rays, no rotation: col to the east, row to the south, parallax along rows."""
    cols, rows = size
    east, north = 111320.0 * np.cos(np.radians(LAT)), 110950.0
    one = np.eye(20)[0]
    samp, line = np.zeros(20), np.zeros(20)
    lon_scale, lat_scale, height_scale = 0.02, 0.02, 500.0
    samp[1] = lon_scale * east / gsd / (cols / 2)
    line[2] = -lat_scale * north / gsd / (rows / 2)
    line[3] = height_scale * np.tan(np.radians(angle_deg)) / gsd / (rows / 2)
    return RPC(
        line_off=(rows - 1) / 2,
        samp_off=(cols - 1) / 2,
        lat_off=LAT,
        long_off=LON,
        height_off=HEIGHT,
        line_scale=rows / 2,
        samp_scale=cols / 2,
        lat_scale=lat_scale,
        long_scale=lon_scale,
        height_scale=height_scale,
        line_num_coeff=line,
        line_den_coeff=one,
        samp_num_coeff=samp,
        samp_den_coeff=one,
    )


RPCS = {
    "left": linear_rpc(0.65, -5.0, SIZES["left"]),
    "right": linear_rpc(0.80, 26.0, SIZES["right"]),
}


def write_image(path: Path, rpc: RPC, size: tuple[int, int]) -> Path:
    def text(value) -> str:
        return " ".join(repr(float(v)) for v in np.atleast_1d(value))

    tags = {name.upper(): text(value) for name, value in rpc.to_dict().items()}
    options = {"count": 1, "dtype": "uint16", "sparse_ok": True, "tiled": True}
    with rasterio.open(path, "w", driver="GTiff", width=size[0], height=size[1], **options) as ds:
        ds.update_tags(ns="RPC", ERR_BIAS="-1", ERR_RAND="-1", **tags)
    return path


def make_gcps(n: int = 15, noise: float = 0.25, seed: int = 1, true=TRUE) -> list[dict]:
    """GCPs spread over the common ground, as rows of the CSV."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(n)))
    cells = rng.permutation(side * side)[:n]
    u, v = (cells % side + 0.5) / side - 0.5, (cells // side + 0.5) / side - 0.5
    jitter = rng.uniform(-0.3, 0.3, (2, n)) / side
    lon, lat = LON + 0.022 * (u + jitter[0]), LAT + 0.014 * (v + jitter[1])
    height = rng.uniform(30, 110, n)
    rows = []
    for i in range(n):
        row = {"id": f"G{i + 1:02d}", "lon": lon[i], "lat": lat[i], "height": height[i]}
        for view in ("left", "right"):
            col_row = SensorModel(RPCS[view], true[view]).project(lon[i], lat[i], height[i])
            col_row = np.array(col_row) + noise * rng.standard_normal(2)
            row[f"{view}_col"], row[f"{view}_row"] = col_row
        rows.append(row)
    return rows


def write_gcps(path: Path, rows: list[dict]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(
            {k: f"{v:.10f}" if isinstance(v, float) else v for k, v in row.items()} for row in rows
        )
    return path


def run(images, tmp_path, rows, **options) -> Alignment:
    file = write_gcps(tmp_path / "gcps.csv", rows)
    options.setdefault("provenance", {})
    return align(images["left"], images["right"], file, scene="Test-1", **options)


# ----------------------------------------------------------------------------------- refusals


def change(rows, **cells):
    rows[5].update(cells)
    return rows
