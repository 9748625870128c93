"""Rates of the kernels beside those of other software; part of throughput.py, on its scene."""

from __future__ import annotations

import argparse
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pyproj
import rasterio
from figures import print_records
from rasterio.transform import RPCTransformer

from stereocities.cities import CITIES
from stereotruth.core.products.grids import Layer, require_complete
from stereotruth.core.products.resumable_grids import resumable_grid
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rectify import rectify_image
from stereotruth.labels.pair_window import PairWindow, read_patch
from stereotruth.labels.paper_recipe import correlate, points_of
from stereotruth.labels.window_points import PointBlock
from stereotruth.lidar.point_store import Points, PointStore
from stereotruth.lidar.smooth_maps import PatchedTransform
from stereotruth.sensor.images import Source
from stereotruth.sensor.rpc import SensorModel
from stereotruth.sensor.rpc_files import read_rpc

CITY = "Qichun"
BLOCK = 1 << 16


def fastest(call: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Seconds on the clock and of CPU (all threads and child processes), the least of the calls."""
    best = math.inf, math.inf
    for _ in range(repeats):
        clock, cpu = time.perf_counter(), sum(os.times()[2:4]) + time.process_time()
        call()
        clock = time.perf_counter() - clock
        cpu = sum(os.times()[2:4]) + time.process_time() - cpu
        best = min(best[0], clock), min(best[1], cpu)
    return best


def ground_points(folder: Path, wanted: int) -> Points:
    store = PointStore(max((folder / "points").glob("*.points"), key=lambda s: PointStore(s).count))
    points = store.query(*store.bounds[:4])
    return Points(*(getattr(points, name)[:wanted] for name in Points.__dataclass_fields__))


def in_threads(call: Callable[..., Any], places: Sequence[np.ndarray], threads: int) -> None:
    """Call for blocks of 65536 places, as the stages do it."""
    blocks = ([values[k : k + BLOCK] for values in places] for k in range(0, places[0].size, BLOCK))
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(lambda block: call(*block), blocks):
            pass


def geometry(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Rates (points/s) of projections, and how far they are from GDAL's and PROJ's."""
    points = ground_points(arguments.folder, 4_000_000)
    every = points.lon, points.lat, points.height
    few = [values[:200_000] for values in every]
    model = EpipolarModel.load(arguments.folder / "epipolar.json")
    image = arguments.folder / "left.tif"
    sensor = SensorModel(read_rpc(image))
    rows = []

    def row(
        name: str, call: Callable[[], Any], count: int, found: Any, true: Any, unit: str
    ) -> None:
        clock, cpu = fastest(call, max(arguments.repeats, 3))
        worst = float(np.abs(np.subtract(found, true)).max())
        rates = {"what": name, "per_s": count / clock, "per_cpu_s": count / cpu}
        rows.append(rates | {"difference": worst, "unit": unit})

    with rasterio.open(image) as dataset, RPCTransformer(dataset.rpcs) as gdal:
        line, col = gdal.rowcol(*few, op=float)
        theirs = np.subtract([col, line], 0.5)
        row(
            "ground to one image, stereotruth", lambda: in_threads(sensor.project, every, 1),
            points.lon.size, sensor.project(*few), theirs, "px",
        )  # fmt: skip
        row(
            "ground to one image, GDAL", lambda: gdal.rowcol(*few, op=float),
            few[0].size, theirs, theirs, "px",
        )  # fmt: skip
    affine = model.left.affine
    left = model.left_to_epipolar(*(affine[:, :2] @ theirs + affine[:, 2:]))
    for threads in sorted({1, arguments.workers}):
        row(
            f"ground to epipolar coordinates of both images, {threads} threads",
            lambda threads=threads: in_threads(model.ground_to_epipolar, every, threads),
            points.lon.size, model.ground_to_epipolar(*few)[:2], left, "px",
        )  # fmt: skip
    code = CITIES[CITY].epsg
    to_map = pyproj.Transformer.from_crs("EPSG:4979", f"EPSG:{code}", always_xy=True)
    exact = pyproj.Transformer.from_crs(pyproj.CRS(code).to_3d(), "EPSG:4979", always_xy=True)
    on_map = *to_map.transform(*few[:2]), few[2]
    patches = PatchedTransform(exact.transform, 1.0)
    true = exact.transform(*on_map)[:2]
    for name, transform in (("stereotruth", patches), ("pyproj", exact.transform)):
        row(
            f"UTM to WGS 84, {name}", lambda transform=transform: transform(*on_map),
            few[0].size, transform(*on_map)[:2], true, "degree",
        )  # fmt: skip
    return rows


def correlation(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Rates (points/s) of the paper's filter, on windows as the stage has them."""
    folder = arguments.folder
    points = ground_points(folder, 6_000_000)
    model = EpipolarModel.load(folder / "epipolar.json")
    xy = model.ground_to_epipolar(points.lon, points.lat, points.height)
    images = [require_complete(folder / f"{view}.zarr")["image"] for view in ("left", "right")]
    x, y = (int(np.median(values)) - 512 for values in xy[:2])
    windows = []
    for part in range(2):
        cols, rows = slice(x, x + 1024), slice(y + 512 * part, y + 512 * (part + 1))
        inside = (xy[0] > cols.start) & (xy[0] < cols.stop - 1)
        inside &= (xy[1] > rows.start) & (xy[1] < rows.stop - 1)
        across = xy[2, inside]
        reach = slice(int(across.min()) - 1, int(across.max()) + 2)
        patches = [read_patch(image, rows, c, 9) for image, c in zip(images, (cols, reach))]
        names = "lon_q", "lat_q", "h_q", "classification", "day"
        attributes = [getattr(points, name)[inside] for name in names]
        block = PointBlock(*attributes, np.ascontiguousarray(xy[:, inside]))
        ground = SimpleNamespace(blocks=lambda block=block: [block])
        in_frames, _ = points_of(ground, PairWindow(rows, cols, 0, *patches))
        windows.append((in_frames, *patches, 9))
    count = sum(window[0].x.size for window in windows)
    rows = []
    for threads in (1, 2)[: arguments.workers]:
        with ThreadPoolExecutor(threads) as pool:
            clock, cpu = fastest(
                lambda pool=pool: list(pool.map(lambda window: correlate(*window), windows)),
                max(arguments.repeats, 2),
            )
        density = count / (1024 * 1024)
        name = f"correlation filter, window 9, {density:.1f} points a pixel, {threads} threads"
        rows.append({"what": name, "per_s": count / clock, "per_cpu_s": count / cpu})
    return rows


class InMemory:
    """What rectification reads of a source, without decoding, and what it writes, thrown away."""

    def __init__(self, source: Source) -> None:
        self.path, self.size, self.nodata, self.gain = source.path, source.size, 0.0, 1.0
        self.colour, self.band_count = (), 1
        self.pixels = source.read(0, 0, *source.size)
        self.valid: list[int] = []

    def read_layers(
        self, col: int, row: int, cols: int, rows: int
    ) -> tuple[np.ndarray, np.ndarray]:
        layers = self.pixels[None, row : row + rows, col : col + cols].copy()
        return layers, np.zeros((rows, cols), np.bool_)

    def missing(self, blocks: Sequence[Any], *_: object) -> list[int]:
        return list(range(len(blocks)))

    def write(self, *told: Any) -> None:
        self.valid.append(told[-1])

    def results(self, _: object) -> list[int]:
        return self.valid


def rectification(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Rates (px/s) of rectification and of cv2.remap with the maps given."""
    folder, repeats = arguments.folder, max(arguments.repeats, 3)
    model = EpipolarModel.load(folder / "epipolar.json")
    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(np.float64)
    col, line = (v.astype(np.float32) for v in model.epipolar_to_left(x, y))
    layers = {"image": Layer("uint16", 0)}

    def ours(source: Source, threads: int) -> None:
        store = folder / "remap" / "left.zarr"
        with resumable_grid(store, model.shape, layers, chunk=256, shard=1024) as target:
            key = str(time.perf_counter_ns())  # nothing of an earlier call is taken over
            rectify_image(source, model.left_image, target, model.shape, key=key, workers=threads)

    rows = []
    with Source(folder / "left.tif") as source:
        memory = InMemory(source)
        pixels = memory.pixels
        for threads in sorted({1, arguments.workers}):
            cv2.setNumThreads(threads)
            flags = {"remap, bicubic": cv2.INTER_CUBIC, "remap, Lanczos": cv2.INTER_LANCZOS4}
            calls = {
                name: lambda flag=flag: cv2.remap(
                    pixels, col, line, flag, borderMode=cv2.BORDER_CONSTANT
                )
                for name, flag in flags.items()
            }
            calls["stereotruth"] = lambda threads=threads: rectify_image(
                memory, model.left_image, memory, model.shape, key="", workers=threads
            )
            calls["stereotruth, file to store"] = lambda threads=threads: ours(source, threads)
            for name, call in calls.items():
                clock, cpu = fastest(call, repeats)
                row = {"what": name, "threads": threads}
                rows.append(row | {"per_s": x.size / clock, "per_cpu_s": x.size / cpu})
    cv2.setNumThreads(1)
    shutil.rmtree(folder / "remap")
    return rows


def rates(row: Mapping[str, Any], what: str) -> dict[str, str]:
    return {
        "": row["what"],
        f"M {what}/s": f"{row['per_s'] / 1e6:.2f}",
        f"M {what} per CPU s": f"{row['per_cpu_s'] / 1e6:.2f}",
    }


def show_kernels(report: Mapping[str, Any]) -> None:
    print_records(
        "geometry: rates, and greatest difference from GDAL or PROJ",
        [
            rates(row, "points") | {"difference": f"{row['difference']:.1e} {row['unit']}"}
            for row in report["geometry"]
        ],
    )
    print_records("the paper's filter", [rates(row, "points") for row in report["correlation"]])
    ours = {r["threads"]: r for r in report["rectification"] if r["what"] == "stereotruth"}
    print_records(
        "rectification, and cv2.remap with the maps given, in memory",
        [
            rates(row, "px")
            | {
                "threads": str(row["threads"]),
                "stereotruth / this": f"{ours[row['threads']]['per_s'] / row['per_s']:.2f}",
                "by CPU": f"{ours[row['threads']]['per_cpu_s'] / row['per_cpu_s']:.2f}",
            }
            for row in report["rectification"]
        ],
    )


def kernels(arguments: argparse.Namespace) -> dict[str, Any]:
    """All rates."""
    return {
        "geometry": geometry(arguments),
        "correlation": correlation(arguments),
        "rectification": rectification(arguments),
    }
