"""A scene of the paper's size, 34000 x 30000 px: memory over time, cost per block.

One command, a table and a figure; see README.md beside this file.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import threading
import time
from itertools import cycle
from pathlib import Path

import laspy
import matplotlib
import numpy as np
import pyproj
import rasterio
import yaml
from numba import njit
from rasterio.rpc import RPC
from rasterio.windows import Window

from stereotruth.pages.pictures import SERIES
from stereotruth.simulate.camera import Pass, aim, locate, project
from stereotruth.simulate.geodesy import LocalFrame
from stereotruth.simulate.rpcs import draw_bias, fit_rpc

matplotlib.use("Agg")
import matplotlib.pyplot as plt

ROOT = Path(__file__).parents[1]
LON, LAT, HEIGHT, EPSG = 114.3, 30.6, 50.0, 32650
GSD = 0.65
STEP = 64  # px between exact places of the images; the ground is flat
STRIP = 1024  # rows written at once
STAGES = ("ingest", "align", "refine", "rectify", "project", "export")


# ------------------------------------------------------------------------------------ the scene


@njit(cache=True, nogil=True)
def _noise(i: int, j: int) -> float:
    h = (i * 374761393 + j * 668265263) & 0x7FFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0x7FFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) / 65536.0


@njit(cache=True, nogil=True)
def _texture(lon: float, lat: float, cell: float) -> float:
    u, v = lon / cell, lat / cell
    i, j = int(np.floor(u)), int(np.floor(v))
    f, g = u - i, v - j
    f, g = f * f * (3.0 - 2.0 * f), g * g * (3.0 - 2.0 * g)
    low = _noise(i, j) * (1.0 - f) + _noise(i + 1, j) * f
    high = _noise(i, j + 1) * (1.0 - f) + _noise(i + 1, j + 1) * f
    return low * (1.0 - g) + high * g


@njit(cache=True, nogil=True)
def _paint(ground: np.ndarray, step: int, out: np.ndarray) -> None:
    """Gray values at the ground places ``ground`` [k, l, 2] of every ``step``-th pixel."""
    for y in range(out.shape[0]):
        j, g = y // step, (y % step) / step
        for x in range(out.shape[1]):
            i, f = x // step, (x % step) / step
            low = ground[j, i] * (1.0 - f) + ground[j, i + 1] * f
            high = ground[j + 1, i] * (1.0 - f) + ground[j + 1, i + 1] * f
            lon, lat = low * (1.0 - g) + high * g
            value = 0.5 * _texture(lon, lat, 2e-5) + 0.5 * _texture(lon, lat, 6e-5)
            out[y, x] = np.uint16(100 + 900 * value)


def write_image(path: Path, camera, frame: LocalFrame, rpc, cols: int, rows: int) -> None:
    """A flat, textured ground as ``camera`` sees it, in tiles without compression."""
    line_off, samp_off, lat_off, lon_off, h_off, line_s, samp_s, lat_s, lon_s, h_s = map(
        float, rpc.numbers
    )
    names = ("line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff")
    metadata = RPC(
        height_off=h_off,
        height_scale=h_s,
        lat_off=lat_off,
        lat_scale=lat_s,
        line_off=line_off,
        line_scale=line_s,
        long_off=lon_off,
        long_scale=lon_s,
        samp_off=samp_off,
        samp_scale=samp_s,
        **dict(zip(names, (c.tolist() for c in rpc.coefficients))),
    )
    profile = {
        "driver": "GTiff",
        "width": cols,
        "height": rows,
        "count": 1,
        "dtype": "uint16",
        "nodata": 0,
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
        "BIGTIFF": "IF_SAFER",
        "rpcs": metadata,
    }
    with rasterio.open(path, "w", **profile) as target:
        for first in range(0, rows, STRIP):
            count = min(STRIP, rows - first)
            c, r = np.meshgrid(
                np.arange(0, cols + STEP, STEP), np.arange(first, first + count + STEP, STEP)
            )
            places = np.column_stack([c.ravel(), r.ravel()]).astype(float)
            xyz = locate(camera, frame, places, np.full(len(places), HEIGHT))
            ground = frame.to_geodetic(xyz)[:, :2].reshape(*c.shape, 2)
            out = np.empty((count, cols), np.uint16)
            _paint(ground, STEP, out)
            target.write(out, 1, window=Window(0, first, cols, count))


def write_lidar(folder: Path, files: int, side_m: float, spacing_m: float) -> int:
    """Squares of flat ground along the diagonal of the scene; returns the number of points."""
    folder.mkdir(parents=True, exist_ok=True)
    utm = pyproj.Transformer.from_crs(4979, EPSG, always_xy=True)
    east, north = utm.transform(LON, LAT)
    n = round(side_m / spacing_m)
    for k in range(files):
        rng = np.random.default_rng(k)
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales, header.offsets = [0.01] * 3, [round(east), round(north), 0]
        header.add_crs(pyproj.CRS.from_epsg(EPSG))
        middle = (k - (files - 1) / 2) * side_m * 0.7
        record = laspy.ScaleAwarePointRecord.zeros(n * n, header=header)
        x, y = np.meshgrid(np.arange(n) * spacing_m, np.arange(n) * spacing_m)
        jitter = rng.uniform(0, spacing_m, (2, n * n))
        record.x = east + middle - side_m / 2 + x.ravel() + jitter[0]
        record.y = north - middle * 0.8 - side_m / 2 + y.ravel() + jitter[1]
        record.z = HEIGHT + rng.normal(0, 0.03, n * n)
        record.classification = np.full(n * n, 2, np.uint8)
        record.return_number = record.number_of_returns = np.ones(n * n, np.uint8)
        with laspy.open(folder / f"{k:03d}.laz", "w", header=header) as writer:
            writer.write_points(record)
    return files * n * n


def make_scene(folder: Path, given: argparse.Namespace) -> dict[str, float]:
    """Images, LiDAR, exact control points, sheets and config; what it took (s)."""
    frame = LocalFrame(LON, LAT, HEIGHT)
    took, views = {}, {}
    for view in ("left", "right"):
        begin = time.monotonic()
        camera = aim(
            frame,
            np.zeros(3),
            Pass.drawn(view, 3, ascending=False),
            gsd=GSD,
            cols=given.cols,
            rows=given.rows,
        )
        bias = draw_bias(given.cols, given.rows, 3, view)
        rpc = fit_rpc(
            camera, frame, cols=given.cols, rows=given.rows, heights=(-50.0, 250.0), bias=bias
        )
        write_image(folder / f"{view}.tif", camera, frame, rpc, given.cols, given.rows)
        views[view] = camera
        took[view] = time.monotonic() - begin
    with (folder / "gcps.csv").open("w") as stream:
        print("id,lon,lat,height,left_col,left_row,right_col,right_row", file=stream)
        spots = np.linspace(0.1, 0.9, 5)
        for k, (a, b) in enumerate((a, b) for a in spots for b in spots):
            place = np.array([[a * given.cols, b * given.rows]])
            xyz = locate(views["left"], frame, place, np.array([HEIGHT]))
            image = [project(views[view], xyz)[0] for view in ("left", "right")]
            values = (*frame.to_geodetic(xyz)[0], *image[0], *image[1])
            print(f"g{k}", *(f"{v:.10f}" for v in values), sep=",", file=stream)
    begin = time.monotonic()
    took["points"] = write_lidar(folder / "lidar", given.files, 1000.0, given.spacing)
    took["lidar"] = time.monotonic() - begin
    header = "scene city left_image right_image lidar lidar_crs geoid gcps"
    row = f"Large-1 Large {folder}/left.tif {folder}/right.tif {folder}/lidar   {folder}/gcps.csv"
    (folder / "scenes.tsv").write_text("\n".join(s.replace(" ", "\t") for s in (header, row)))
    cities = ("city prefix training validation testing", "Large LG 6 1 3")
    (folder / "cities.tsv").write_text("\n".join(s.replace(" ", "\t") for s in cities))
    config = {"scenes": str(folder / "scenes.tsv"), "cities": str(folder / "cities.tsv")}
    (folder / "large.yaml").write_text(yaml.safe_dump(config | {"strips": given.strips}))
    return took


# ----------------------------------------------------------------------------------- the memory


class Watch(threading.Thread):
    """Proportional memory of a process and all below it, twice a second (Linux)."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self.pid, self.samples, self.ended = pid, [], threading.Event()

    def run(self) -> None:
        """Sample until told that it has ended."""
        while not self.ended.wait(0.5):
            self.samples.append((time.time(), *self.memory()))

    def memory(self) -> tuple[float, float]:
        """MiB of all processes, and of the largest job (a process below snakemake)."""
        parents: dict[int, list[int]] = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                try:
                    fields = (entry / "stat").read_text().rpartition(")")[2].split()
                except (FileNotFoundError, ProcessLookupError):
                    continue
                parents.setdefault(int(fields[1]), []).append(int(entry.name))

        def tree(pid: int) -> float:
            return pss(pid) + sum(tree(child) for child in parents.get(pid, []))

        jobs = [tree(child) for child in parents.get(self.pid, [])]
        return pss(self.pid) + sum(jobs), max(jobs, default=0.0)


def pss(pid: int) -> float:
    """Proportional set size of one process, MiB."""
    try:
        text = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except (FileNotFoundError, ProcessLookupError, PermissionError):
        return 0.0
    return next(int(s.split()[1]) for s in text.splitlines() if s.startswith("Pss:")) / 1024


def run_workflow(folder: Path, cores: int) -> tuple[list[tuple], float]:
    """Make the tiles; samples of memory, and seconds."""
    command = [sys.executable, "-m", "snakemake", "--cores", str(cores), "tiles/Large"]
    command += ["--configfile", str(folder / "large.yaml")]
    work = folder / "work"
    work.mkdir(exist_ok=True)
    for name in ("Snakefile", "workflow", "config", "profiles", "envs"):
        if not (work / name).exists():
            (work / name).symlink_to(ROOT / name)
    begin = time.monotonic()
    run = subprocess.Popen(command, cwd=work)
    watch = Watch(run.pid)
    watch.start()
    status = run.wait()
    watch.ended.set()
    watch.join()
    if status:
        sys.exit(f"snakemake ended with {status}")
    return watch.samples, time.monotonic() - begin


def stages(work: Path) -> dict[str, dict[str, float]]:
    """Seconds and largest resident memory (MiB) of each stage's jobs, from their logs."""
    found = {}
    for stage in STAGES:
        rows = []
        for folder in (work / "logs").glob(f"{stage}*"):
            for file in folder.rglob("*.tsv"):
                with file.open() as stream:
                    rows += list(csv.DictReader(stream, delimiter="\t"))
        found[stage] = {
            "jobs": len(rows),
            "seconds": sum(float(row["s"]) for row in rows),
            "max_rss_mib": max((float(row["max_rss"]) for row in rows), default=0.0),
        }
    return found


def block_times(work: Path) -> dict[str, list[float]]:
    """When the blocks of each grid were done, s."""
    found = {}
    for folder in sorted((work / "results").rglob(".*.work/done")):
        name = folder.parent.name.removeprefix(".").removesuffix(".work")
        times = sorted(file.stat().st_mtime for file in folder.glob("*.json"))
        if times:
            found[f"{folder.parent.parent.name}/{name}"] = times
    return found


def draw(path: Path, samples: list[tuple], blocks: dict[str, list[float]], start: float) -> None:
    """Memory over time, and blocks done over time."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    at = np.array([s[0] for s in samples]) - start
    above.plot(at, [s[1] for s in samples], color=SERIES[0], label="all processes")
    above.plot(at, [s[2] for s in samples], color=SERIES[1], label="largest job")
    above.set_ylabel("memory (PSS), MiB")
    above.legend()
    for (name, times), colour in zip(blocks.items(), cycle(SERIES)):
        below.plot(np.array(times) - start, np.arange(1, len(times) + 1), color=colour, label=name)
    below.set_ylabel("blocks done")
    below.set_xlabel("s")
    below.legend()
    for axes in (above, below):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", type=Path, default=ROOT / "results" / "scale")
    parser.add_argument("--cols", type=int, default=34000)
    parser.add_argument("--rows", type=int, default=30000)
    parser.add_argument("--files", type=int, default=20, help="LiDAR files, of 1 km² each")
    parser.add_argument("--spacing", type=float, default=0.5, help="m between LiDAR points")
    parser.add_argument("--strips", type=int, default=1)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--figure", type=Path, default=ROOT / "results" / "scale.png")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    folder = given.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    took = {}
    if not (folder / "large.yaml").exists():
        took = make_scene(folder, given)
        print("made:", ", ".join(f"{name} {value:.0f}" for name, value in took.items()), flush=True)
    samples, seconds = run_workflow(folder, given.cores)
    blocks = block_times(folder / "work")
    facts = {
        "pixels": given.cols * given.rows,
        "cores": given.cores,
        "seconds": seconds,
        "peak_mib": max(s[1] for s in samples),
        "peak_job_mib": max(s[2] for s in samples),
        "stages": stages(folder / "work"),
        "blocks": {name: len(times) for name, times in blocks.items()},
    }
    given.figure.parent.mkdir(parents=True, exist_ok=True)
    draw(given.figure, samples, blocks, samples[0][0])
    if given.json:
        given.json.write_text(json.dumps(facts, indent=2) + "\n")
    print(f"{seconds:.0f} s; peak {facts['peak_mib']:.0f} MiB, of one job", end=" ")
    print(f"{facts['peak_job_mib']:.0f} MiB")
    print(f"{'stage':10} {'jobs':>5} {'s':>8} {'max RSS, MiB':>14}")
    for stage, row in facts["stages"].items():
        print(f"{stage:10} {row['jobs']:5} {row['seconds']:8.0f} {row['max_rss_mib']:14.0f}")


if __name__ == "__main__":
    main()
