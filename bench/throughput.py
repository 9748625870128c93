"""How fast: one command, ratios measured in one run on the same cores. See README.md beside this.

Makes a synthetic scene at the paper's LiDAR density, decodes its LAZ files with nothing but laspy
(T0), then ingests and projects them as the workflow does (T), and says where the time goes. Then
the rates of the kernels beside those of other software.
"""

from __future__ import annotations

import argparse
import cProfile
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
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import laspy
import numpy as np
from figures import print_records
from kernel_rates import CITY, fastest, kernels, show_kernels
from rasterio.windows import Window
from synthetic_pairs import rectify_by

import stereotruth
from stereocities.cities import CITIES, lidar_files
from stereocities.lidar import simulate_lidar_tile
from stereocities.render import simulate_image
from stereotruth.align.adjustment import epipolar_model
from stereotruth.align.align import align
from stereotruth.align.alignment import Alignment
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.products.provenance import source_digest
from stereotruth.core.products.rasters import open_raster
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rectify import rectify
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.ingest import ingest
from stereotruth.sensor.images import open_pair
from stereotruth.sensor.rpc import SensorModel

PROJECT = Path(__file__).resolve().parents[1]
PACKAGE = Path(stereotruth.__file__).parent
SCENE = f"{CITY}-1"
POINTS_AT_25_CM = 82.6  # million, of this scene
INGEST_JOB = """
import sys
from stereotruth.core.job import job
from stereotruth.lidar.ingest import ingest
from stereotruth.core.products.provenance import describe
lidar, store, log = sys.argv[1:]
with job(log, "ingest"):
    ingest(lidar, store, provenance=describe([lidar], {}, ""))
"""
SURFACE_JOB = """
import json, os, sys
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.job import job
left, right, points, out, log, alignment, settings, options = sys.argv[1:]
points, settings = json.loads(points), LabelSettings(**json.loads(settings))
inputs = SceneInputs.of(left, right, points, settings, alignment=alignment)
with job(log, "surface"):
    inputs.with_surface(os.path.dirname(out), json.loads(options).get("workers", 1))
"""
PROJECT_JOB = """
import glob, json, os, sys
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.job import job
left, right, points, out, log, alignment, settings, options = sys.argv[1:]
points, settings = json.loads(points), LabelSettings(**json.loads(settings))
(surface,) = glob.glob(os.path.join(os.path.dirname(out), "*.surface"))
inputs = SceneInputs.of(left, right, points, settings, alignment=alignment, surface=surface)
with job(log, "project"):
    project_scene(inputs, out, **json.loads(options))
"""
STRIP_JOB = """
import json, sys
from stereotruth.core.job import job
from stereotruth.core.products.grids import Strip
from stereotruth.lidar.point_store import open_stores
from stereotruth.sensor.pair_geometry import GroundOfImages
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import ground_cell
image, points, out, log, strip = sys.argv[1:]
with job(log, "surface"):
    ground, strip = GroundOfImages.open([image]), Strip.parse(strip) if strip else None
    cell = ground_cell(ground.pixel_deg)
    make_surface(open_stores(json.loads(points)), out, cell=cell, ground=ground, strip=strip)
"""

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


def at_once(_pool: ThreadPoolExecutor, work: Callable[..., Any], *arguments: Any) -> Future:
    """In place of a pool's ``submit``: what it is given is done here and now."""
    done: Future = Future()
    try:
        done.set_result(work(*arguments))
    except BaseException as error:
        done.set_exception(error)
    return done


def profiled(call: Callable[[], Any]) -> dict[tuple[str, str], float]:
    """CPU seconds by part and function.

    A profile knows one thread, and would have all that others do as time that this one waits: it
    was 6 µs a point of ``job.progress``. So pools of threads do their work in it.
    """
    profile = cProfile.Profile(time.process_time)
    with patch.object(ThreadPoolExecutor, "submit", at_once):
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
    left, right = folder / "left.zarr", folder / "right.zarr"
    out = folder / "project" / "disparity.zarr"
    smallest = min(files, key=lambda file: file.stat().st_size)
    stores[0].parent.mkdir(exist_ok=True)
    shutil.rmtree(out.parent, ignore_errors=True)

    print("compiling", flush=True)
    ingest_all([smallest], folder / "points", 1, env)
    smallest_store = folder / "points" / f"{smallest.stem}.points"
    code = source_digest("stereotruth.labels.project")
    alignment, options = folder / "alignment.json", {"code": code}

    def inputs(points: Sequence[Path]) -> SceneInputs:
        return SceneInputs.of(left, right, points, LabelSettings(**settings), alignment=alignment)

    project_scene(inputs([smallest_store]).with_surface(out.parent), out, **options)

    print("T0, ingest, project", flush=True)
    count = decode(files)  # into the page cache
    seconds = dict.fromkeys(("T0", "ingest", "surface", "project"), math.inf)
    cpu = dict(seconds)
    told = json.dumps(dict(settings)), json.dumps({"workers": workers} | options)
    points = json.dumps(list(map(str, stores)))
    of_scene = left, right, points, out, folder / "project.log", alignment, *told
    for _ in range(arguments.repeats):
        for made in (folder / "points", out.parent):  # nothing of an earlier run is taken over
            shutil.rmtree(made, ignore_errors=True)
            made.mkdir()
        for name, call in (
            ("T0", lambda: decode(files)),
            ("ingest", lambda: ingest_all(files, folder / "points", workers, env)),
            ("surface", lambda: job(SURFACE_JOB, *of_scene, env=env)),
            ("project", lambda: job(PROJECT_JOB, *of_scene, env=env)),
        ):
            clock, used = fastest(call, 1)
            seconds[name], cpu[name] = min(seconds[name], clock), min(cpu[name], used)
    start = "import stereotruth.lidar.ingest, stereotruth.core.job"
    _, start_up = fastest(lambda: job(start, env=env), 3)
    total = seconds["ingest"] + seconds["surface"] + seconds["project"]
    profiles = {}
    if arguments.profile:
        print("profile of ingest, then of surface and project", flush=True)
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

    stored = sum(f.stat().st_size for s in stores for f in s.rglob("*") if f.is_file())
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
        "store_bytes_per_point": stored / count,
    }


def show_chain(report: Mapping[str, Any]) -> None:
    count, seconds, cpu = (report[name] for name in ("points", "seconds", "cpu_seconds"))
    whole = [name for name in seconds if name != "T0"]
    print_records(  # the CPU's time tells more than the clock where the machine is shared
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
                ("surface", ["surface"]),
                ("project", ["project"]),
                ("T = ingest + surface + project", whole),
            )
        ],
    )
    jobs = report["files"] + 1
    print(f"start-up of a job, in each of {jobs}: {report['start_up_s']:.2f} s of CPU")
    for stage, profile in report["profiles"].items():
        whole = sum(profile["ns_per_point"].values())
        print_records(
            f"{stage}: CPU time of one core, {whole:.0f} ns a point",
            [
                {
                    "part": part,
                    "ns / point": f"{value:.1f}",
                    "share": f"{100 * value / whole:.1f} %",
                }
                for part, value in sorted(profile["ns_per_point"].items(), key=lambda p: -p[1])
                if value > 0.005 * whole
            ],
        )
        print_records(
            f"{stage}: functions",
            [
                {"function": name, "ns / point": f"{value:.1f}"}
                for name, value in profile["functions_ns"].items()
            ],
        )


# ------------------------------------------------------------------ growth


def cut(folder: Path, number: int) -> Path:
    """A folder with a quarter of the scene's left image, rectified with all of the right one."""
    made = folder / "growth" / f"quarter {number}"
    made.mkdir(parents=True)
    alignment = Alignment.read(folder / "alignment.json")
    with open_raster(folder / "left.tif") as source:
        size = source.width // 2, source.height // 2
        first = number % 2 * size[0], number // 2 * size[1]
        pixels = source.read(1, window=Window(*first, *size))
        profile, rpcs = source.profile, source.rpcs
    rpcs.samp_off, rpcs.line_off = rpcs.samp_off - first[0], rpcs.line_off - first[1]
    profile |= {"width": size[0], "height": size[1]}
    with open_raster(made / "left.tif", "w", **profile, rpcs=rpcs) as target:
        target.write(pixels, 1)
    affine = alignment.left.affine - [[0.0, 0.0, first[0]], [0.0, 0.0, first[1]]]
    fit = replace(alignment.left_fit, size=size, affine=affine, gcps=())
    left = SensorModel(alignment.left.rpc, affine)
    images = made / "left.tif", folder / "right.tif"
    rectify_by(replace(alignment, left=left, left_fit=fit), images, made)
    return made


def growth(folder: Path, stores: Sequence[Path], settings: Mapping[str, Any]) -> dict[str, Any]:
    """CPU seconds of `surface` and `project` for the scene, and for its quarters one by one.

    Quarters have the content of the whole, and more margins. `project` takes the whole surface in
    all of them, so that a list that is gone through too often shows; and `surface` in two strips.
    """
    env, points = environment(folder), json.dumps(list(map(str, stores)))
    told = json.dumps(dict(settings)), json.dumps({"code": "growth"})
    shutil.rmtree(folder / "growth", ignore_errors=True)
    quarters = [cut(folder, number) for number in range(4)]

    start = fastest(lambda: job("import stereotruth.labels.project", env=env), 3)[1]

    def spent(code: str, *arguments: object) -> float:
        return round(fastest(lambda: job(code, *arguments, env=env), 1)[1] - start, 2)

    def surface(name: str, image: Path, strip: str = "") -> float:
        made = folder / "growth" / name / "s.surface"
        return spent(STRIP_JOB, image, points, made, folder / "growth.log", strip)

    def project(place: Path) -> float:
        made = folder / "growth" / f"labels of {place.name}"
        shutil.rmtree(made, ignore_errors=True)
        made.mkdir()
        (made / "s.surface").symlink_to(folder / "growth" / "whole" / "s.surface")
        rectified, log = (place / "left.zarr", place / "right.zarr"), folder / "growth.log"
        out, alignment = made / "disparity.zarr", place / "alignment.json"
        return spent(PROJECT_JOB, *rectified, points, out, log, alignment, *told)

    def megapixels(place: Path) -> float:
        return float(np.prod(EpipolarModel.load(place / "epipolar.json").shape)) / 1e6

    surface("compiled", quarters[0] / "left.tif")
    whole = surface("whole", folder / "left.tif")
    parts = [surface(place.name, place / "left.tif") for place in quarters]
    strips = [surface("strips", folder / "left.tif", strip) for strip in ("0-of-2", "1-of-2", "")]
    found = {
        "surface, s: whole, quarters": (whole, parts),
        "surface, s: two strips, their joining": strips,
        "surface, a megapixel, whole / quarters": whole / sum(parts),
        "surface, the longer of two strips / one job": max(strips[:2]) / whole,
    }
    print(json.dumps(found, indent=1), flush=True)
    project(quarters[0])  # compiles
    labels, of_quarters = project(folder), [project(place) for place in quarters]
    sizes = megapixels(folder), sum(map(megapixels, quarters))
    return {
        "Mpx: whole, quarters": sizes,
        "project, s: whole, quarters": (labels, of_quarters),
        "project, a megapixel, whole / quarters": labels / sizes[0] * sizes[1] / sum(of_quarters),
    }


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
    parser.add_argument("--growth", action="store_true", help="that alone; needs a run before")
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
    if arguments.growth:
        stores = sorted((arguments.folder / "points").glob("*.points"))
        print(json.dumps(growth(arguments.folder.resolve(), stores, settings), indent=1))
        return 0
    if not arguments.kernels:
        report["chain"] = chain(arguments, settings)
        show_chain(report["chain"])
    report |= kernels(arguments)
    show_kernels(report)
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
