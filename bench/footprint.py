"""Reading a COPC file by footprint: points, bytes, time, memory, faults, requests. See README.md.

Files are made (tests/synthetic/copc_server.py) and served on the loopback by a server that counts.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import os
import shutil
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import laspy
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.synthetic.copc_server import (
    CORNER,
    FILE_FAULTS,
    INFO_AT,
    SERVER_FAULTS,
    damaged,
    make_copc,
    serving,
)
from tests.synthetic.ept import FAULTS, make_ept

from stereotruth.errors import InputError, in_number
from stereotruth.lidar.footprint import CELL_DEG, Footprint
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.octree_nodes import Octree
from stereotruth.lidar.point_files import open_octree
from stereotruth.lidar.point_store import PointStore

DENSITY = 10.0  # points/m²
LON, LAT = 117.0, 29.83  # of the made files' corner


class Square:
    """A square of ground in the system of the made file."""

    def __init__(self, side: float) -> None:
        self.low = CORNER[:2] + 700
        self.high = self.low + side

    def touches(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return ((low[:, :2] <= self.high) & (high[:, :2] >= self.low)).all(axis=1)

    def contains(self, xyz: np.ndarray) -> np.ndarray:
        x = xyz[:2].T
        return ((x >= self.low) & (x <= self.high)).all(axis=1)


def cells_of(share: float, side: float) -> Footprint:
    """A square of whole cells of a store that covers about a share of the made file's ground."""
    n = max(round(side * share**0.5 / 110), 1)
    row, col = (
        int((LAT + 0.4 * side / 111_000) / CELL_DEG),
        int((LON + 0.4 * side / 96_600) / CELL_DEG),
    )
    return Footprint(row, col, np.ones((n, n), bool))


def of_own_process(work: Callable[..., Any], *arguments: Any) -> tuple[float, float, float]:
    """Seconds of some work in a process of its own, by the clock and of a core, and its memory.

    The most of it, in MB. Where others use the cores as well, seconds of a core are those to hold
    against each other.
    """
    context = multiprocessing.get_context("fork")
    receiving, sending = context.Pipe(duplex=False)

    def measured() -> None:
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
        start, core = time.perf_counter(), time.process_time()
        work(*arguments)
        seconds, core_s = time.perf_counter() - start, time.process_time() - core
        status = Path("/proc/self/status").read_text()
        peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
        sending.send((seconds, core_s, int(peak.split()[1]) / 1e3))

    process = context.Process(target=measured)
    process.start()
    result: tuple[float, float, float] = receiving.recv()
    process.join()
    return result


def stand_in(url: str, size: int) -> Path:
    """What the workflow has in the place of a URL, in the working directory."""
    parts = urlsplit(url)
    place = Path("results", "remote", parts.scheme, parts.netloc, parts.path.lstrip("/"))
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(json.dumps({"size": size, "content": '"one"'}) + "\n")
    return place


def same_cells(whole: PointStore, part: PointStore) -> bool:
    """Whether a store has the cells of another one in its footprint, to the byte."""
    at = np.stack([whole.cell_row - part.footprint.row, whole.cell_col - part.footprint.col])
    good = ((at >= 0) & (at < np.array([part.footprint.held.shape]).T)).all(axis=0)
    good[good] = part.footprint.held[tuple(at[:, good])]
    points = np.load(whole.path / "points.npy", mmap_mode="r")
    starts = np.append(0, np.cumsum(whole.cell_counts))
    kept = [points[starts[k] : starts[k + 1]] for k in np.flatnonzero(good)]
    return np.concatenate(kept).tobytes() == np.load(part.path / "points.npy").tobytes()


def trace(points: int, levels: int) -> None:
    """Print the requests of one ingest of 1 % of a file, and those of a second one."""
    side = (points / DENSITY) ** 0.5
    file = Path("tile.copc.laz")
    file.write_bytes(make_copc(points, side, levels).content)
    with serving(file.read_bytes()) as server:
        place = stand_in(server.url, file.stat().st_size)
        for store in ("first.points", "second.points"):
            ingest(place, store, footprint=cells_of(0.01, side))
            nodes = PointStore(store).attrs["nodes"]
            print(f"{store}: {nodes[0]} of {nodes[1]} nodes, {PointStore(store).count} points kept")
            if server.requests:
                print_trace(file, server.requests)
            print(f"{in_number(len(server.requests), 'request')}, {server.sent} bytes sent")
            server.requests.clear()
            server.sent = 0


def measure(points: int, levels: int) -> None:
    """Bytes, time and memory of 1 % of a file against all of it."""
    side = (points / DENSITY) ** 0.5
    file = Path("tile.copc.laz")
    made = make_copc(points, side, levels)
    file.write_bytes(made.content)
    nodes, size = len(made.entries), len(made.content)
    print(f"{points} points, {size} bytes, {nodes} nodes, {side:.0f} m")
    del made
    footprint = cells_of(0.01, side)
    print(f"footprint of {footprint.area_m2 / side**2:.2%} of the ground")
    ingest(file, "warm.points", footprint=footprint)  # compiles
    part_s, part_core_s, part_mb = of_own_process(ingest_part, file, "part.points", footprint)
    whole_s, whole_core_s, whole_mb = of_own_process(ingest, file, "whole.points")
    part, whole = PointStore("part.points"), PointStore("whole.points")
    read = part.attrs["nodes"][0]
    print(f"1 %: {part.count} points of {part.attrs['points']['read']} in {read} nodes")
    print(f"store equals the whole file's, cropped: {same_cells(whole, part)}")
    print(f"time {part_s:.2f} s of {whole_s:.2f} s: {part_s / whole_s:.4f} (0.05 asked)")
    share = part_core_s / whole_core_s
    print(f"of a core {part_core_s:.2f} s of {whole_core_s:.2f} s: {share:.4f}")
    print(f"memory {part_mb:.0f} MB, of the whole file as LAZ {whole_mb:.0f} MB")
    with serving(file.read_bytes()) as server:
        place = stand_in(server.url, size)
        ingest(place, "web.points", footprint=footprint)
        nodes_bytes = PointStore("web.points").attrs["bytes"][0]
        print_trace(file, server.requests)
        print(
            f"bytes sent {server.sent}, of the nodes {nodes_bytes}: {server.sent / nodes_bytes:.3f}"
        )
        print(f"store equals that of the disk: {same_cells(part, PointStore('web.points'))}")


def print_trace(file: Path, requests: Sequence[str]) -> None:
    """The requests of a run: which bytes of the file, how many, and what for."""
    octree, size = open_octree(file), file.stat().st_size
    with file.open("rb") as stream:
        head = stream.read(INFO_AT + 160)
    (hierarchy,) = struct.unpack_from("<Q", head, INFO_AT + 40)
    print("| request | bytes of the file | how many | what for |\n|---|---|---|---|")
    for number, text in enumerate(requests, 1):
        first, last = map(int, text.rpartition("=")[2].split("-"))
        last = min(last, size - 1)
        nodes = [n for n in octree.nodes if first <= n.start and n.start + n.bytes - 1 <= last]
        what = "chunk table" if last + 1 < hierarchy else "hierarchy"
        if last + 1 == hierarchy:
            what = "head of the record of the hierarchy"
        if first == 0:
            what = "header, coordinate system, cube and place of the hierarchy"
        elif nodes:
            levels = sorted({node.key[0] for node in nodes})
            points = sum(node.points for node in nodes)
            of = f"level {levels[0]}" if len(levels) == 1 else f"levels {levels[0]}-{levels[-1]}"
            what = f"{in_number(len(nodes), 'node')} of {of}, {points} points"
        print(f"| {number} | {first}-{last} | {last + 1 - first} | {what} |")


def ingest_part(file: Path, store: str, footprint: Footprint) -> None:
    """:func:`.ingest` with its keyword."""
    ingest(file, store, footprint=footprint)


def plant(rounds: int) -> None:
    """Faults of servers and files, each ``rounds`` times: overcome, refused, or lost silently."""
    made, patience_s, ground = make_copc(), 3.0, Square(2048 * 0.05**0.5)
    las = laspy.read(io.BytesIO(made.content))
    kept = ground.contains(np.stack([las.x, las.y]))
    truth = np.stack([np.asarray(las[axis])[kept] for axis in "XYZ"])
    totals = {"right": 0, "refused": 0, "silent": 0, "traceback": 0}
    longest = 0.0
    for fault in (*SERVER_FAULTS, *FILE_FAULTS):
        for seed in range(rounds):
            rng = np.random.default_rng([seed, len(fault)])
            in_file = fault in FILE_FAULTS
            content = damaged(made, fault, rng) if in_file else made.content
            start = time.perf_counter()
            with serving(content, "" if in_file else fault, int(rng.integers(0, 6))) as server:
                opened = partial(open_octree, server.url, patience_s=patience_s)
                outcome = outcome_of(opened, ground, truth, f"{fault}, round {seed}")
            longest = max(longest, time.perf_counter() - start)
            totals[outcome] += 1
    plant_in_ept(ground, totals)
    kinds = len(SERVER_FAULTS) + len(FILE_FAULTS) + len(FAULTS)
    print(f"{sum(totals.values())} faults of {kinds} kinds: {totals}")
    print(f"longest {longest:.1f} s, patience {patience_s} s for each part of a file")


def outcome_of(
    opened: Callable[[], Octree], ground: Square, truth: NDArray[np.int32], name: str
) -> str:
    """What reading a ``ground`` of a damaged octree ends in: right (the points are those of the
    ``truth`` [3, n]), silent, refused or traceback. Bad ends are printed with the fault's name."""
    try:
        octree = opened()
        records = list(octree.read(octree.plan(ground.touches)))
        got = np.hstack([np.stack([r.array[axis] for axis in "XYZ"]) for r in records])
        world = got.T * octree.header.scales + octree.header.offsets
        right = np.array_equal(got[:, ground.contains(world.T)], truth)
        outcome = "right" if right else "silent"
    except InputError:
        return "refused"
    except Exception as error:
        outcome = "traceback"
        print(f"{name}: {error!r}")
    if outcome != "right":
        print(f"{name}: {outcome}")
    return outcome


def plant_in_ept(ground: Square, totals: dict[str, int]) -> None:
    """Faults of a dataset of Entwine Point Tiles on the disk, added to the ``totals``."""
    whole = make_ept(Path("set"))
    las = laspy.read(whole.with_name("all.las"))
    stored = np.stack([las.X, las.Y, las.Z])
    truth = stored[:, ground.contains(np.stack([las.x, las.y]))]
    for fault, plant_it in FAULTS.items():
        shutil.copytree(whole.parent, "damaged")
        plant_it(Path("damaged"))
        totals[outcome_of(partial(open_octree, "damaged/ept.json"), ground, truth, fault)] += 1
        shutil.rmtree("damaged")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--levels", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--trace", action="store_true", help="the requests of one run, alone")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        if options.trace:
            trace(options.points, options.levels)
        else:
            measure(options.points, options.levels)
            plant(options.rounds)


if __name__ == "__main__":
    main()
