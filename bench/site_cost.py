"""What one more pair of a site costs, and the first one beside the decoding of its LiDAR.

Draws a site, runs the workflow as a user does up to the labels of one pair, then of all others, and
adds up the processor time, memory and disk that the jobs' own records tell. See README.md beside
this.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from throughput import decode, fastest

from stereotruth.command import example_city
from stereotruth.command.new_project import begin
from stereotruth.simulate.sites import drawn_site

BEFORE = ("ingest", "surface", "align", "refine", "adjust", "adjusted_alignment", "rectify")
RULES = (*BEFORE, "project")
ONCE = ("ingest", "surface")


def make_project(folder: Path, arguments: argparse.Namespace, spacing_m: float) -> str:
    """A project with a site and rows of its best pairs; the city's name."""
    site = drawn_site(
        arguments.number, arguments.seed, images=arguments.images, side_px=arguments.side
    )
    city = site.city.name
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        begin(folder)
        example_city.SITE, example_city.SPACING_M = site, spacing_m
        example_city.make_site(folder)
        command = f"pairs {city} --most {arguments.pairs} --lidar data/lidar --gcps gcps/{city}.csv"
        stereotruth(folder, *command.split())
    return city


def stereotruth(folder: Path, *words: str) -> None:
    """The program, in a project."""
    subprocess.run([Path(sys.executable).with_name("stereotruth"), *words], cwd=folder, check=True)


def scenes_of(folder: Path) -> list[str]:
    """The pairs, in the order of the sheet."""
    with (folder / "scenes.tsv").open(encoding="utf-8") as sheet:
        return [row["scene"] for row in csv.DictReader(sheet, delimiter="\t")]


def label(folder: Path, city: str, scenes: Sequence[str]) -> None:
    """Label pairs."""
    grids = (f"results/project/{city}/{scene}.zarr" for scene in scenes)
    stereotruth(folder, "run", *grids, "--cores", "2", "--quiet", "all")


def spent(folder: Path) -> dict[str, tuple[int, float, float]]:
    """Jobs, seconds of processor time and the greatest memory (MiB), by rule."""
    out = {}
    for rule in RULES:
        jobs = []
        for file in (folder / "logs" / rule).rglob("*.tsv"):
            with file.open(encoding="utf-8") as stream:
                jobs += list(csv.DictReader(stream, delimiter="\t"))
        seconds, memory = ([float(job[name]) for job in jobs] for name in ("cpu_time", "max_rss"))
        out[rule] = len(jobs), sum(seconds), max(memory, default=0.0)
    return out


def megabytes(folder: Path) -> float:
    """Of all files below."""
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6


def measure(folder: Path, arguments: argparse.Namespace, spacing_m: float) -> dict[str, object]:
    """The figures of one site."""
    city = make_project(folder, arguments, spacing_m)
    pairs = scenes_of(folder)
    label(folder, city, pairs[:1])
    first = spent(folder)
    label(folder, city, pairs)
    every = spent(folder)
    further = {rule: (every[rule][1] - first[rule][1]) / max(len(pairs) - 1, 1) for rule in RULES}
    files = sorted((folder / "data" / "lidar").glob("*.la[sz]"))
    _, bare = fastest(lambda: decode(files), 2)
    alone = sum(first[rule][1] for rule in RULES)
    with_points = sum(first[rule][1] for rule in (*ONCE, "project"))
    return {
        "spacing_m": spacing_m,
        "points": decode(files),
        "pairs": len(pairs),
        "files": len(files),
        "jobs of ingest, of surface": [every[rule][0] for rule in ONCE],
        "first pair, s": {rule: round(first[rule][1], 1) for rule in RULES},
        "a further pair, s": {rule: round(further[rule], 1) for rule in RULES},
        "further / first": round(sum(further.values()) / alone, 3),
        "bare decoding, s": round(bare, 2),
        "ingest, surface and project of the first / decoding": round(with_points / bare, 2),
        "memory, MiB": {rule: round(every[rule][2]) for rule in RULES},
        "disk, MB": {
            name: round(megabytes(folder / "results" / name)) for name in (*ONCE, "project")
        },
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=1600, help="px of an image")
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--pairs", type=int, default=4)
    parser.add_argument(
        "--spacing", type=float, nargs="+", default=[0.25, 0.47], help="m, of LiDAR"
    )
    parser.add_argument("--number", type=int, default=0, help="of the site that is drawn")
    parser.add_argument("--seed", type=int, default=30)
    parser.add_argument("--folder", type=Path, default=Path("results/site_cost"))
    parser.add_argument("--json", type=Path, help="file of all figures")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    rows = []
    for spacing in arguments.spacing:
        name = f"{arguments.side}_{arguments.images}_{arguments.seed}_{spacing:g}"
        rows.append(measure(arguments.folder / name, arguments, spacing))
        print(json.dumps(rows[-1], indent=1), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
