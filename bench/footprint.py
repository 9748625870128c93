"""Reading a COPC file by footprint: points, bytes, time, memory, requests. See README.md.

Files are made (tests/synthetic/copc_server.py) and served on the loopback by a server that counts.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.synthetic.copc_server import (
    INFO_AT,
    make_copc,
    serving,
)

from stereotruth.errors import in_number
from stereotruth.lidar.footprint import CELL_DEG, Footprint
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_files import open_octree
from stereotruth.lidar.point_store import PointStore

DENSITY = 10.0  # points/m²
LON, LAT = 117.0, 29.83  # of the made files' corner


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
        place = server.stand_in()
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
        place = server.stand_in()
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
        ends = octree.nodes["start"] + octree.nodes["bytes"]
        nodes = octree.nodes[(octree.nodes["start"] >= first) & (ends - 1 <= last)]
        what = "chunk table" if last + 1 < hierarchy else "hierarchy"
        if last + 1 == hierarchy:
            what = "head of the record of the hierarchy"
        if first == 0:
            what = "header, coordinate system, cube and place of the hierarchy"
        elif len(nodes):
            levels = np.unique(nodes["key"][:, 0])
            points = nodes["points"].sum()
            of = f"level {levels[0]}" if len(levels) == 1 else f"levels {levels[0]}-{levels[-1]}"
            what = f"{in_number(len(nodes), 'node')} of {of}, {points} points"
        print(f"| {number} | {first}-{last} | {last + 1 - first} | {what} |")


def ingest_part(file: Path, store: str, footprint: Footprint) -> None:
    """:func:`.ingest` with its keyword."""
    ingest(file, store, footprint=footprint)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--levels", type=int, default=6)
    parser.add_argument("--trace", action="store_true", help="the requests of one run, alone")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        if options.trace:
            trace(options.points, options.levels)
        else:
            measure(options.points, options.levels)


if __name__ == "__main__":
    main()
