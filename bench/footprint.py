"""Reading a COPC file by footprint from a web server: points, bytes, time, faults. See README.md.

Files are made (tests/synthetic/copc_server.py) and served on the loopback by a server that counts.
"""

from __future__ import annotations

import argparse
import io
import sys
import time
from pathlib import Path

import laspy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.synthetic.copc_server import (
    CORNER,
    FILE_FAULTS,
    SERVER_FAULTS,
    damaged,
    make_copc,
    serving,
)

from stereotruth.errors import InputError
from stereotruth.lidar.footprint import Footprint
from stereotruth.lidar.octree import open_octree

SIDE = 2048.0


def square(share: float) -> Footprint:
    """A square footprint that covers a share of the made file's ground."""
    side = SIDE * share**0.5
    ring = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]) * side + CORNER[:2] + 700
    return Footprint((ring,))


def stored(octree, footprint: Footprint | None, plan=None) -> np.ndarray:
    """Coordinates, in their order, of what a footprint has."""
    records = octree.read(plan or octree.plan(footprint))
    parts = [np.stack([r.array[axis] for axis in "XYZ"]) for r in records]
    return np.concatenate(parts, axis=1) if parts else np.empty((3, 0), np.int32)


def measure(points: int, levels: int) -> None:
    """Bytes and time of 1 % of a file against all of it; each of them from the server."""
    made = make_copc(points, SIDE, levels)
    print(f"{points} points, {len(made.content)} bytes, {len(made.entries)} nodes")
    with serving(made.content) as server:
        stored(open_octree(server.url), square(0.0001))  # compiles
        server.sent, server.requests = 0, []
        start = time.perf_counter()
        octree = open_octree(server.url)
        plan = octree.plan(square(0.01))
        part = stored(octree, None, plan)
        part_s, sent, requests = time.perf_counter() - start, server.sent, list(server.requests)
        start = time.perf_counter()
        octree = open_octree(server.url)
        whole_s, whole = 0.0, 0
        inside = []
        crop = square(0.01)
        for record in octree.read(octree.plan(None)):
            whole += len(record)
            seconds = time.perf_counter()
            xyz = np.stack([record.array[axis] for axis in "XYZ"])
            world = xyz * octree.header.scales[:, None] + octree.header.offsets[:, None]
            inside.append(xyz[:, crop.contains(world)])
            start += time.perf_counter() - seconds
        whole_s = time.perf_counter() - start
    same = np.array_equal(np.concatenate(inside, axis=1), part)
    print("requests: " + "; ".join(text.split("=")[1] for text in requests))
    print(f"1 %: {part.shape[1]} points of {len(plan.nodes)} nodes ({plan.touched} touched)")
    print(f"bytes sent {sent}, of the nodes {plan.bytes}: {sent / plan.bytes:.3f} (1.2 asked)")
    print(f"same as the whole file's {whole}, cropped: {same}")
    print(f"time {part_s:.3f} s of {whole_s:.3f} s: {part_s / whole_s:.4f} (0.05 asked)")


def plant(rounds: int) -> None:
    """Faults of servers and files, each ``rounds`` times: overcome, refused, or lost silently."""
    made, patience_s, footprint = make_copc(), 3.0, square(0.05)
    las = laspy.read(io.BytesIO(made.content))
    kept = footprint.contains(np.stack([las.x, las.y, las.z]))
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
                try:
                    got = stored(open_octree(server.url, patience_s=patience_s), footprint)
                    outcome = "right" if np.array_equal(got, truth) else "silent"
                except InputError:
                    outcome = "refused"
                except Exception as error:
                    outcome = "traceback"
                    print(f"{fault}: {error!r}")
            longest = max(longest, time.perf_counter() - start)
            totals[outcome] += 1
            if outcome in ("silent", "traceback"):
                print(f"{fault}, round {seed}: {outcome}")
    kinds = len(SERVER_FAULTS) + len(FILE_FAULTS)
    print(f"{sum(totals.values())} faults of {kinds} kinds: {totals}")
    print(f"longest {longest:.1f} s, patience {patience_s} s for each part of a file")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--levels", type=int, default=6)
    parser.add_argument("--rounds", type=int, default=4)
    options = parser.parse_args()
    measure(options.points, options.levels)
    plant(options.rounds)


if __name__ == "__main__":
    main()
