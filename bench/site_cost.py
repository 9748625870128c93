"""What one more pair of a site costs, and the first one beside the decoding of its LiDAR.

Draws a site, runs the workflow as a user does up to the labels of its first pair in a project of
that pair alone, then of all pairs in another, and adds up the processor time and memory that the
jobs tell at their end, and the disk. See README.md beside this.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from kernel_rates import fastest
from throughput import decode

from stereocities.sites import drawn_site
from stereotruth.project import example_city
from stereotruth.project.new_project import begin

RULES = (
    "ingest", "compare_strips", "surface", "align", "refine", "adjust", "adjusted_alignment",
    "rectify", "project",
)  # fmt: skip
ONCE = ("ingest", "surface")
# For all processes of a run: rule, script and file where a script of a rule opens LiDAR; at its end
# the processor time that it took, of which Snakemake's records hold a sample of up to 30 s before.
TRACE = """
import atexit, os, resource, sys
def job():
    folder, script = os.path.split(getattr(sys, "argv", [""])[0])
    if folder.endswith("scripts") and script.endswith(".py"):
        number, rule, _ = script.split(".")
        return rule, number
def note(file, *values):
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_APPEND | os.O_CREAT), "a") as log:
        print(*values, sep="\\t", file=log)
def opened(event, arguments):
    if event == "open" and str(arguments[0]).endswith((".las", ".laz")) and job():
        note({opened!r}, *job(), os.path.basename(arguments[0]))
def spent():
    if job():
        used = [resource.getrusage(of) for of in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        seconds = sum(of.ru_utime + of.ru_stime for of in used)
        note({spent!r}, *job(), seconds, max(of.ru_maxrss for of in used) / 1024.0)
sys.addaudithook(opened)
atexit.register(spent)
"""


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


def stereotruth(folder: Path, *words: str, env: Mapping[str, str] | None = None) -> None:
    """The program, in a project."""
    program = Path(sys.executable).with_name("stereotruth")
    subprocess.run([program, *words], cwd=folder, env=env, check=True)


def scenes_of(folder: Path) -> list[str]:
    """The pairs, in the order of the sheet."""
    with (folder / "scenes.tsv").open(encoding="utf-8") as sheet:
        return [row["scene"] for row in csv.DictReader(sheet, delimiter="\t")]


def alone(folder: Path) -> Path:
    """A project of the same data whose sheet has the first pair alone."""
    other = folder.with_name(f"{folder.name}_alone")
    if not other.is_dir():
        other.mkdir()
        (other / "data").symlink_to(folder / "data")
        (other / "gcps").symlink_to(folder / "gcps")
        for name in ("config.yaml", "cities.tsv", "images.tsv", "scenes.tsv"):
            shutil.copyfile(folder / name, other / name)
        head, first, *_ = (other / "scenes.tsv").read_text(encoding="utf-8").splitlines()
        (other / "scenes.tsv").write_text(f"{head}\n{first}\n", encoding="utf-8")
    return other


def label(folder: Path, city: str, scenes: Sequence[str]) -> None:
    """Label pairs, from nothing but the data, with a record of the jobs that open LiDAR files, and
    of what each takes (:data:`TRACE`)."""
    trace = folder / "trace"
    for earlier in (trace, folder / "results"):
        shutil.rmtree(earlier, ignore_errors=True)
    trace.mkdir()
    files = {name: str(trace / f"{name}.txt") for name in ("opened", "spent")}
    (trace / "sitecustomize.py").write_text(TRACE.format(**files), "utf-8")
    paths = filter(None, [str(trace), os.environ.get("PYTHONPATH")])
    grids = (f"results/project/{city}/{scene}.zarr" for scene in scenes)
    stereotruth(
        folder,
        *("run", *grids, "--cores", "2", "--quiet", "all"),
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
    )


def opened(folder: Path) -> dict[str, dict[str, int]]:
    """How many jobs of each rule opened each LiDAR file."""
    lines = (folder / "trace" / "opened.txt").read_text(encoding="utf-8").splitlines()
    found: dict[str, dict[str, int]] = {}
    for rule, _, file in (line.split("\t") for line in sorted(set(lines))):
        files = found.setdefault(rule, {})
        files[file] = files.get(file, 0) + 1
    return found


class Spent(NamedTuple):
    """Of the jobs of a rule: how many, seconds of processor time, the greatest memory (MiB)."""

    jobs: int
    cpu_s: float
    memory: float


def spent(folder: Path) -> dict[str, Spent]:
    """By rule, as the jobs told at their end."""
    lines = (folder / "trace" / "spent.txt").read_text(encoding="utf-8").splitlines()
    jobs: dict[str, list[tuple[float, float]]] = {rule: [] for rule in RULES}
    for rule, _, seconds, memory in (line.split("\t") for line in lines):
        jobs.setdefault(rule, []).append((float(seconds), float(memory)))
    return {
        rule: Spent(len(of), sum(s for s, _ in of), max((m for _, m in of), default=0.0))
        for rule, of in jobs.items()
    }


def megabytes(folder: Path) -> float:
    """Of all files below; one that has two names counts once."""
    files = {(s.st_ino, s.st_size) for f in folder.rglob("*") if (s := f.lstat()) and f.is_file()}
    return sum(size for _, size in files) / 1e6


def figures(folder: Path, first: dict[str, Spent]) -> dict[str, object]:
    """Memory and disk of a project's stages."""
    return {
        "memory, MiB": {rule: round(of.memory) for rule, of in first.items()},
        "disk, MB": {
            name: round(megabytes(folder / "results" / name)) for name in (*ONCE, "project")
        },
    }


def measure(folder: Path, arguments: argparse.Namespace, spacing_m: float) -> dict[str, object]:
    """The figures of one site."""
    city = make_project(folder, arguments, spacing_m)
    pairs, one = scenes_of(folder), alone(folder)
    label(one, city, pairs[:1])
    if others := len(pairs) - 1:
        label(folder, city, pairs)
    else:
        folder = one
    first, every = spent(one), spent(folder)
    further = {rule: (every[rule].cpu_s - first[rule].cpu_s) / max(others, 1) for rule in RULES}
    files = sorted((folder / "data" / "lidar").glob("*.la[sz]"))
    _, bare = fastest(lambda: decode(files), 2)
    with_points = sum(first[rule].cpu_s for rule in (*ONCE, "project"))
    return {
        "spacing_m": spacing_m,
        "points": decode(files),
        "images": arguments.images,
        "pairs": len(pairs),
        "LiDAR files": len(files),
        "jobs that opened LiDAR, by rule and file": opened(folder),
        "jobs of surface": every["surface"].jobs,
        "first pair alone, s": {rule: round(of.cpu_s, 1) for rule, of in first.items()},
        "a further pair, s": {rule: round(s, 1) for rule, s in further.items()},
        "further / first": round(sum(further.values()) / sum(of.cpu_s for of in first.values()), 3),
        "bare decoding, s": round(bare, 2),
        "ingest, surface and project of the first / decoding": round(with_points / bare, 2),
        "first pair alone": figures(one, first),
        "all pairs": figures(folder, every),
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
        rows.append(measure(arguments.folder.resolve() / name, arguments, spacing))
        print(json.dumps(rows[-1], indent=1), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
