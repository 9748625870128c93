"""How fast: one command, ratios measured in one run on the same cores. See README.md beside this.

Makes a synthetic scene at the paper's LiDAR density, decodes its LAZ files with nothing but laspy
(T0), then ingests and projects them as the workflow does (T), and says where the time goes. Then
the rates of the kernels beside those of other software.
"""

from __future__ import annotations

import argparse
import cProfile
import importlib.util
import json
import logging
import math
import os
import platform
import pstats
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import laspy
import numpy as np
import pyproj
import rasterio
from rasterio.transform import RPCTransformer

import stereotruth
from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.align import align
from stereotruth.config.labels import LabelSettings
from stereotruth.disparity.image_patches import read_patch
from stereotruth.disparity.paper_correlation import correlate
from stereotruth.disparity.pixel_points import Collection
from stereotruth.disparity.project import project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.epipolar.image_reader import Source, open_pair
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rectify import rectify, rectify_image
from stereotruth.epipolar.rpc import RPC, SensorModel
from stereotruth.epipolar.rpc_files import read_rpc
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import Points, PointStore
from stereotruth.lidar.smooth_maps import PatchedTransform
from stereotruth.products.grids import Layer, require_complete
from stereotruth.products.provenance import source_digest
from stereotruth.products.resumable_grids import resumable_grid
from stereotruth.simulate.cities import CITIES, lidar_files
from stereotruth.simulate.lidar import simulate_lidar_tile
from stereotruth.simulate.render import simulate_image

PROJECT = Path(__file__).resolve().parents[1]
PACKAGE = Path(stereotruth.__file__).parent
CITY, SCENE = "Qichun", "Qichun-1"
POINTS_AT_25_CM = 82.6  # million, of this scene
BLOCK = 1 << 16
INGEST_JOB = """
import sys
from stereotruth.job import job
from stereotruth.lidar.ingest import ingest
from stereotruth.products.provenance import describe
lidar, store, log = sys.argv[1:]
with job(log, "ingest"):
    ingest(lidar, store, provenance=describe([lidar], {}, ""))
"""
PROJECT_JOB = """
import json, os, sys
from stereotruth.disparity.project import project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.config.labels import LabelSettings
from stereotruth.job import job
left, right, points, out, log, alignment, settings, options = sys.argv[1:]
points, settings = json.loads(points), LabelSettings(**json.loads(settings))
inputs = SceneInputs.of(left, right, points, settings, alignment=alignment)
with job(log, "project"):
    inputs = inputs.with_surface(os.path.dirname(out), json.loads(options).get("workers", 1))
    project_scene(inputs, out, **json.loads(options))
"""
BOUNDS = {  # part of a profile: what its time goes into
    "laspy": "arithmetic decoding, bit by bit: the floor",
    "to_wgs84": "two passes over 6 arrays: memory",
    "cell_sort": "scattered writes of the sort: cache misses",
    "point_store": "one pass over memory",
    "zarr": "LZ4 and three copies in Zarr",
    "smooth_maps": "27 or 80 multiplications and additions a point in vectors: memory, arithmetic",
    "pixel_points": "scattered writes of the sort: cache misses",
    "vertices": "scattered updates of the cells",
    "delaunay": "exact tests and cache misses, a vertex at a time",
    "facets": "passes over all triangles: memory",
    "step_points": "points on both sides of each edge",
    "breaklines": "half-planes of the points on both sides of each edge",
    "raster": "triangles drawn into both views",
    "pixel_labels": "exact sums by pixel: one pass over the points",
    "change_evidence": "windows of pixels, not of points",
    "paper_correlation": "200 samples a point in vectors: arithmetic",
}


def print_table(title: str, rows: Sequence[Mapping[str, str]]) -> None:
    """A table of text cells, columns as wide as needed."""
    columns = list(rows[0])
    width = {c: max(len(c), *(len(row[c]) for row in rows)) for c in columns}
    print(f"\n{title}")
    print("  ".join(f"{c:<{width[c]}}" for c in columns).rstrip())
    for row in rows:
        print("  ".join(f"{row[c]:<{width[c]}}" for c in columns).rstrip())


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


# ------------------------------------------------------------------ data


def make_scene(folder: Path, million: float, seed: int) -> list[Path]:
    """Images, LAZ files and rectified images, where they are not there yet; returns the LAZ."""
    city = CITIES[CITY]
    scene = city.scene(SCENE)
    for view in ("left", "right"):
        if not (image := folder / f"{view}.tif").is_file():
            print(f"rendering the {view} image", flush=True)
            simulate_image(city, scene, view, image, seed=seed)
    spacing = 0.25 * math.sqrt(POINTS_AT_25_CM / million)
    lidar = [folder / f"lidar_{million:g}" / name for name in lidar_files(city, scene)]
    for file in lidar:
        if not file.is_file():
            print(f"flying {file.name} at {spacing:.3f} m", flush=True)
            file.parent.mkdir(exist_ok=True)
            simulate_lidar_tile(city, scene, file.name, file, spacing_m=spacing, seed=seed)
    if not ((folder / "right.zarr").is_dir() and (folder / "alignment.json").is_file()):
        print("rectifying", flush=True)
        images = folder / "left.tif", folder / "right.tif"
        alignment = align(*images, PROJECT / "config" / "gcps" / f"{SCENE}.csv", scene=SCENE)
        alignment.save(folder / "alignment.json")
        model = epipolar_model(alignment)
        with open_pair(*images) as pair:
            rectify(
                *pair,
                model,
                folder / "epipolar.json",
                folder / "left.zarr",
                folder / "right.zarr",
                workers=os.cpu_count() or 1,
            )
    return lidar


# ------------------------------------------------------------------ the whole chain


def decode(files: Sequence[Path]) -> int:
    """T0: what laspy alone takes to decode x, y, z, classification and returns, on all cores."""
    wanted = laspy.DecompressionSelection
    count = 0
    for file in files:
        with laspy.open(
            file,
            laz_backend=laspy.LazBackend.LazrsParallel,
            decompression_selection=wanted.XY_RETURNS_CHANNEL | wanted.Z | wanted.CLASSIFICATION,
        ) as reader:
            for points in reader.chunk_iterator(1_000_000):
                count += len(points)
    return count


def environment(folder: Path) -> dict[str, str]:
    """As Snakemake sets it for a job of one thread; bytecode is kept, as where it is installed."""
    names = ("OMP", "OPENBLAS", "MKL", "NUMBA", "NUMEXPR", "VECLIB_MAXIMUM")
    rest = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    path = os.pathsep.join(p for p in (str(PACKAGE.parent), rest.get("PYTHONPATH")) if p)
    return rest | {f"{name}_NUM_THREADS": "1" for name in names} | {
        "PYTHONPATH": path,
        "PYTHONPYCACHEPREFIX": str(folder / "bytecode"),
    }  # fmt: skip


def job(code: str, *arguments: object, env: Mapping[str, str]) -> None:
    subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env=env,
        check=True,
        stderr=subprocess.DEVNULL,
    )


def ingest_all(files: Sequence[Path], folder: Path, workers: int, env: Mapping[str, str]) -> None:
    """One process a file, ``workers`` at once, as Snakemake does."""
    with ThreadPoolExecutor(workers) as pool:
        jobs = [
            pool.submit(
                job,
                INGEST_JOB,
                file,
                folder / f"{file.stem}.points",
                folder / "ingest.log",
                env=env,
            )
            for file in files
        ]
        for running in jobs:
            running.result()


def own_times(profile: cProfile.Profile) -> dict[tuple[str, str], float]:
    """Seconds by (part, function): each function of the package with all that it calls elsewhere.

    Zarr's share is told apart; Dask, which calls back, does not count.
    """
    stats = pstats.Stats(profile)
    times: dict[tuple[str, str], float] = {}

    def module(function: tuple[str, int, str]) -> str | None:
        path = Path(function[0])
        return path.stem if path.is_relative_to(PACKAGE) else None

    def add(part: str, name: str, seconds: float) -> None:
        times[part, name] = times.get((part, name), 0.0) + seconds

    stats.calc_callees()
    for function, (_, _, own, _, _) in stats.stats.items():
        part = module(function)
        if part is None:
            continue
        add(part, function[2], own)
        for callee, (_, _, _, seconds) in stats.all_callees.get(function, {}).items():
            if module(callee) is not None or "dask" in Path(callee[0]).parts:
                continue
            if "zarr" in Path(callee[0]).parts:
                add("zarr", function[2], seconds)
            elif "laspy" in Path(callee[0]).parts:
                add("laspy", "read_points", seconds)
            else:
                add(part, function[2], seconds)
    return times


def profiled(call: Callable[[], Any]) -> dict[tuple[str, str], float]:
    """CPU seconds by part and function, of all threads; for calls that work in one at a time."""
    profile = cProfile.Profile(time.process_time)
    profile.runcall(call)
    return own_times(profile)


def parts(times: Mapping[tuple[str, str], float], points: int) -> dict[str, Any]:
    """Nanoseconds a point by part, and of the functions that take most."""
    by_part: dict[str, float] = {}
    for (part, _), value in times.items():
        by_part[part] = by_part.get(part, 0.0) + value
    largest = sorted(times.items(), key=lambda item: -item[1])[:12]
    return {
        "ns_per_point": {p: 1e9 * v / points for p, v in by_part.items()},
        "functions_ns": {f"{p}.{f}": 1e9 * v / points for (p, f), v in largest},
    }


def chain(arguments: argparse.Namespace, settings: Mapping[str, Any]) -> dict[str, Any]:
    folder, workers = arguments.folder, arguments.workers
    files = make_scene(folder, arguments.points, arguments.seed)
    env = environment(folder)
    stores = [folder / "points" / f"{file.stem}.points" for file in files]
    left, right, out = (
        folder / "left.zarr",
        folder / "right.zarr",
        folder / "project" / "disparity.zarr",
    )
    smallest = min(files, key=lambda file: file.stat().st_size)
    stores[0].parent.mkdir(exist_ok=True)
    shutil.rmtree(out.parent, ignore_errors=True)

    print("compiling", flush=True)
    ingest_all([smallest], folder / "points", 1, env)
    smallest_store = folder / "points" / f"{smallest.stem}.points"
    code = source_digest("disparity.project")
    alignment, options = folder / "alignment.json", {"code": code}

    def inputs(points: Sequence[Path]) -> SceneInputs:
        return SceneInputs.of(left, right, points, LabelSettings(**settings), alignment=alignment)

    project_scene(inputs([smallest_store]).with_surface(out.parent), out, **options)

    print("T0, ingest, project", flush=True)
    count = decode(files)  # into the page cache
    seconds = {"T0": math.inf, "ingest": math.inf, "project": math.inf}
    cpu = dict(seconds)
    told = json.dumps(dict(settings)), json.dumps({"workers": workers} | options)
    for _ in range(arguments.repeats):
        for made in (folder / "points", out.parent):  # nothing of an earlier run is taken over
            shutil.rmtree(made, ignore_errors=True)
            made.mkdir()
        for name, call in (
            ("T0", lambda: decode(files)),
            ("ingest", lambda: ingest_all(files, folder / "points", workers, env)),
            (
                "project",
                lambda: job(
                    PROJECT_JOB,
                    left,
                    right,
                    json.dumps(list(map(str, stores))),
                    out,
                    folder / "project.log",
                    alignment,
                    *told,
                    env=env,
                ),
            ),
        ):
            clock, used = fastest(call, 1)
            seconds[name], cpu[name] = min(seconds[name], clock), min(cpu[name], used)
    start_up = fastest(lambda: job("import stereotruth.lidar.ingest, stereotruth.job", env=env), 3)[
        1
    ]
    total = seconds["ingest"] + seconds["project"]
    profiles = {}
    if arguments.profile:
        print("profile of ingest, then of project", flush=True)
        large = max(files, key=lambda file: file.stat().st_size)
        with laspy.open(large) as reader:
            of = reader.header.point_count
        made = folder / "profile.points"
        ingest(smallest, made)  # loads what is compiled
        profiles["ingest"] = parts(profiled(lambda: ingest(large, made)), of)
        shutil.rmtree(made)
        shutil.rmtree(out.parent)
        times = profiled(
            lambda: project_scene(
                inputs(stores).with_surface(out.parent), out, scheduler="synchronous", **options
            )
        )
        profiles["project"] = parts(times, count)

    return {
        "files": len(files),
        "points": count,
        "seconds": seconds,
        "cpu_seconds": cpu,
        "ingest / T0": seconds["ingest"] / seconds["T0"],
        "project / T0": seconds["project"] / seconds["T0"],
        "T / T0": total / seconds["T0"],
        "start_up_s": start_up,
        "profiles": profiles,
        "store_bytes_per_point": sum(
            f.stat().st_size for s in stores for f in s.rglob("*") if f.is_file()
        )
        / count,
    }


def show_chain(report: Mapping[str, Any]) -> None:
    count, seconds, cpu = (report[name] for name in ("points", "seconds", "cpu_seconds"))
    whole = [name for name in seconds if name != "T0"]
    print_table(  # the CPU's time tells more than the clock where the machine is shared
        f"{count / 1e6:.1f} M points in {report['files']} files "
        f"({report['store_bytes_per_point']:.2f} bytes a point in the stores)",
        [
            {
                "": name,
                "s": f"{(value := sum(seconds[n] for n in names)):.2f}",
                "M points/s": f"{count / value / 1e6:.2f}",
                "/ T0": f"{value / seconds['T0']:.2f}",
                "CPU s": f"{(used := sum(cpu[n] for n in names)):.2f}",
                "/ that of T0": f"{used / cpu['T0']:.2f}",
            }
            for name, names in (
                ("T0: bare decoding", ["T0"]),
                ("ingest", ["ingest"]),
                ("project", ["project"]),
                ("T = ingest + project", whole),
            )
        ],
    )
    jobs = report["files"] + 1
    print(f"start-up of a job, in each of {jobs}: {report['start_up_s']:.2f} s of CPU")
    for stage, profile in report["profiles"].items():
        whole = sum(profile["ns_per_point"].values())
        print_table(
            f"{stage}: CPU time of one core, {whole:.0f} ns a point",
            [
                {
                    "part": part,
                    "ns / point": f"{value:.1f}",
                    "share": f"{100 * value / whole:.1f} %",
                    "bound": BOUNDS.get(part, ""),
                }
                for part, value in sorted(profile["ns_per_point"].items(), key=lambda p: -p[1])
                if value > 0.005 * whole
            ],
        )
        print_table(
            f"{stage}: functions",
            [
                {"function": name, "ns / point": f"{value:.1f}"}
                for name, value in profile["functions_ns"].items()
            ],
        )


# ------------------------------------------------------------------ kernels


def plain_projection(rpc: RPC, lon, lat, height) -> np.ndarray:
    """(col, row) [2, n] by RPC00B as it is written, in NumPy."""
    x = (lon - rpc.long_off) / rpc.long_scale
    y = (lat - rpc.lat_off) / rpc.lat_scale
    z = (height - rpc.height_off) / rpc.height_scale
    terms = [1, x, y, z, x * y, x * z, y * z, x**2, y**2, z**2, x * y * z, x**3, x * y**2]
    terms += [x * z**2, x**2 * y, y**3, y * z**2, x**2 * z, y**2 * z, z**3]

    def ratio(name: str) -> np.ndarray:
        top, bottom = (
            sum(c * t for c, t in zip(getattr(rpc, f"{name}_{part}_coeff"), terms))
            for part in ("num", "den")
        )
        return top / bottom * getattr(rpc, f"{name}_scale") + getattr(rpc, f"{name}_off")

    return np.stack([ratio("samp"), ratio("line")])


def plain_splines(image: Mapping[str, Any], col: np.ndarray, row: np.ndarray) -> np.ndarray:
    """(x, y) [2, n] by the formula that a stored model holds, inside of the splines' domain."""
    n, box = image["n"], image["spline_domain"]
    s = (col - box["col_min"]) / (box["col_max"] - box["col_min"]) * (n - 3)
    t = (row - box["row_min"]) / (box["row_max"] - box["row_min"]) * (n - 3)
    i, j = (np.minimum(np.floor(v).astype(int), n - 4) for v in (s, t))

    def weights(f: np.ndarray) -> list[np.ndarray]:
        middle = (3 * f**3 - 6 * f**2 + 4) / 6, (-3 * f**3 + 3 * f**2 + 3 * f + 1) / 6
        return [(1 - f) ** 3 / 6, *middle, f**3 / 6]

    w, v = weights(s - i), weights(t - j)
    result = []
    for axis in ("x", "y"):
        a = image[f"{axis}_affine"]
        value = a[0] * col + a[1] * row + a[2]
        if image[f"{axis}_spline"] is not None:
            c = np.array(image[f"{axis}_spline"])
            value = value + sum(v[b] * w[k] * c[j + b, i + k] for b in range(4) for k in range(4))
        result.append(value)
    return np.stack(result)


def ground_points(folder: Path, wanted: int) -> Points:
    store = PointStore(max((folder / "points").glob("*.points"), key=lambda s: PointStore(s).count))
    points = store.query(*store.bounds[:4])
    return Points(*(getattr(points, name)[:wanted] for name in Points.__dataclass_fields__))


def in_threads(call: Callable[[slice], Any], total: int, threads: int) -> None:
    """Call for blocks of 65536, as the stages do it."""
    with ThreadPoolExecutor(threads) as pool:
        for _ in pool.map(call, [slice(k, min(k + BLOCK, total)) for k in range(0, total, BLOCK)]):
            pass


def geometry(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Rates (points/s) of projections, and how far they are from the plain formula."""
    folder, repeats = arguments.folder, max(arguments.repeats, 3)
    points = ground_points(folder, 4_000_000)
    lon, lat, height = points.lon, points.lat, points.height
    model = EpipolarModel.load(folder / "epipolar.json")
    rows = []

    def row(
        name: str, seconds: tuple[float, float], count: int, difference: float, unit: str
    ) -> None:
        rows.append(
            {
                "what": name,
                "per_s": count / seconds[0],
                "per_cpu_s": count / seconds[1],
                "difference": difference,
                "unit": unit,
            }
        )

    some = slice(0, 200_000)
    few = lon[some], lat[some], height[some]
    stored = model.to_dict()
    expected = []
    for side, sensor in (("left", model.left), ("right", model.right)):
        col, line = sensor.affine[:, :2] @ plain_projection(sensor.rpc, *few)
        place = col + sensor.affine[0, 2], line + sensor.affine[1, 2]
        expected.append(plain_splines(stored[f"{side}_to_epipolar"], *place))
    expected = np.concatenate(expected)
    worst = float(np.abs(model.ground_to_epipolar(*few) - expected).max())
    for threads in sorted({1, arguments.workers}):
        seconds = fastest(
            lambda threads=threads: in_threads(
                lambda part: model.ground_to_epipolar(lon[part], lat[part], height[part]),
                lon.size,
                threads,
            ),
            repeats,
        )
        name = f"ground to epipolar coordinates of both images, {threads} threads"
        row(name, seconds, lon.size, worst, "px")

    image = folder / "left.tif"
    rpc = read_rpc(image)
    expected = plain_projection(rpc, *few)
    seconds = fastest(lambda: plain_projection(rpc, *few), repeats)
    row("ground to one image, NumPy as written", seconds, few[0].size, 0.0, "px")
    sensor = SensorModel(rpc)
    worst = float(np.abs(np.stack(sensor.project(*few)) - expected).max())
    seconds = fastest(
        lambda: in_threads(
            lambda part: sensor.project(lon[part], lat[part], height[part]), lon.size, 1
        ),
        repeats,
    )
    row("ground to one image, stereotruth", seconds, lon.size, worst, "px")
    if importlib.util.find_spec("shareloc"):
        from shareloc.geomodels import GeoModel

        shareloc = GeoModel(str(image), "RPC")
        theirs = shareloc.inverse_loc(*few)
        worst = float(np.abs(np.stack([theirs[1], theirs[0]]) - 0.5 - expected).max())
        seconds = fastest(lambda: shareloc.inverse_loc(*few), repeats)
        row("ground to one image, shareloc", seconds, few[0].size, worst, "px")
    if importlib.util.find_spec("rpcm"):
        from rpcm import rpc_from_geotiff

        rpcm = rpc_from_geotiff(str(image))
        worst = float(np.abs(np.stack(rpcm.projection(*few)) - expected).max())
        seconds = fastest(lambda: rpcm.projection(*few), repeats)
        row("ground to one image, rpcm", seconds, few[0].size, worst, "px")
    with rasterio.open(image) as dataset, RPCTransformer(dataset.rpcs) as gdal:
        line, col = gdal.rowcol(*few, op=float)
        worst = float(np.abs(np.stack([col, line]) - 0.5 - expected).max())
        seconds = fastest(lambda: gdal.rowcol(*few, op=float), repeats)
        row("ground to one image, GDAL", seconds, few[0].size, worst, "px")

    code = CITIES[CITY].epsg
    to_map = pyproj.Transformer.from_crs("EPSG:4979", f"EPSG:{code}", always_xy=True)
    source = pyproj.CRS(code).to_3d()
    exact = pyproj.Transformer.from_crs(source, "EPSG:4979", always_xy=True)
    east, north = to_map.transform(*few[:2])
    patches = PatchedTransform(exact.transform, 1.0)
    got, truth = patches(east, north, few[2]), exact.transform(east, north, few[2])
    worst = float(np.abs(np.subtract(got, truth)[:2]).max())
    seconds = fastest(lambda: patches(east, north, few[2]), repeats)
    row("UTM to WGS 84, stereotruth", seconds, east.size, worst, "degree")
    seconds = fastest(lambda: exact.transform(east, north, few[2]), repeats)
    row("UTM to WGS 84, pyproj", seconds, east.size, 0.0, "degree")
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
        origin = int(points.lon_q.min()), int(points.lat_q.min())
        collection = Collection((512, 1024), (rows.start, cols.start), origin, *patches)
        names = "lon_q", "lat_q", "h_q", "classification"
        attributes = [getattr(points, name)[inside] for name in names]
        day = np.zeros_like(attributes[-1])
        collection.add(*attributes, day, np.ascontiguousarray(xy[:, inside]))
        found = collection.sorted()
        windows.append((found, np.ones(found.points.size, np.bool_), *patches, 9))
    count = sum(window[1].size for window in windows)
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
    print_table(
        "geometry: rates, and greatest difference from the plain formula or PROJ",
        [
            rates(row, "points") | {"difference": f"{row['difference']:.1e} {row['unit']}"}
            for row in report["geometry"]
        ],
    )
    print_table("the paper's filter", [rates(row, "points") for row in report["correlation"]])
    ours = {r["threads"]: r for r in report["rectification"] if r["what"] == "stereotruth"}
    print_table(
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


# ------------------------------------------------------------------ the command


def machine(workers: int) -> dict[str, Any]:
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = [v for v in info.read_text().splitlines() if v.startswith("model name")]
        name = lines[0].partition(":")[2].strip() if lines else name
    return {"processor": name, "cores_used": workers, "python": platform.python_version()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=float, default=POINTS_AT_25_CM, help="million, about")
    parser.add_argument("--folder", type=Path, default=Path("results/throughput"), help="scratch")
    parser.add_argument("--workers", type=int, default=2, help="cores to use")
    parser.add_argument("--repeats", type=int, default=2, help="the fastest counts")
    parser.add_argument("--seed", type=int, default=20230213)
    parser.add_argument("--kernels", action="store_true", help="not the chain again")
    parser.add_argument("--no-profile", dest="profile", action="store_false")
    parser.add_argument("--json", type=Path, help="file for all figures")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.ERROR, format="%(message)s")
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.workers])
    arguments.folder.mkdir(parents=True, exist_ok=True)
    settings = LabelSettings().model_dump()
    report: dict[str, Any] = {"machine": machine(arguments.workers)}
    print(", ".join(f"{k} {v}" for k, v in report["machine"].items()))
    if not arguments.kernels:
        report["chain"] = chain(arguments, settings)
        show_chain(report["chain"])
    report |= {
        "geometry": geometry(arguments),
        "correlation": correlation(arguments),
        "rectification": rectification(arguments),
    }
    show_kernels(report)
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
