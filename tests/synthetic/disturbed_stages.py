"""Stages of the workflow to be disturbed: what is edited of their input, and their products."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereotruth.simulate.__main__ import make_scene

from .project import ROOT, SIZE, TINY, Project, row_of
from .small_pairs import RANGE, small_dataset


def _edit_gcps(data: bytes) -> bytes:
    lines = data.decode().splitlines()
    cells = lines[1].split(",")
    cells[4] = f"{float(cells[4]) + 0.5:.4f}"
    return ("\n".join([lines[0], ",".join(cells), *lines[2:]]) + "\n").encode()


def _edit_laz(data: bytes) -> bytes:
    import io

    import laspy

    las, out = laspy.read(io.BytesIO(data)), io.BytesIO()
    las.z = np.asarray(las.z) + 1.0
    las.write(out, do_compress=True)
    return out.getvalue()


def _edit_image(data: bytes) -> bytes:
    """Another left image: brighter in every second pixel."""
    from rasterio.io import MemoryFile

    with MemoryFile(data) as there, there.open() as source:
        values, profile = source.read(), source.profile
    values[..., ::2] += 40
    with MemoryFile() as out:
        with out.open(**profile) as target:
            target.write(values)
        return out.read()


@dataclass(frozen=True)
class Stage:
    """A rule, what is edited of its input, and its products; ``{c}`` stands for the city.

    ``other`` makes the other version of a file that users give. The other version of a product is
    damaged: it is made again, and nothing is made of it.
    """

    rule: str
    log: str
    input: str
    products: tuple[str, ...]
    other: Callable[[bytes], bytes] | None = None


STAGES = {
    "ingest": Stage(
        "ingest",
        "logs/ingest/{c}/{c}-1/Tiny-1_0_0.log",
        "{c}/lidar/Tiny-1_0_0.laz",
        ("results/ingest/{c}/{c}-1/Tiny-1_0_0.points",),
        _edit_laz,
    ),
    "align": Stage(
        "align",
        "logs/align/{c}/{c}-1.log",
        "{c}/gcps.csv",
        tuple(f"results/align/{{c}}/{{c}}-1/{n}" for n in ("alignment.json", "residuals.csv")),
        _edit_gcps,
    ),
    "refine": Stage(
        "refine",
        "logs/refine/{c}/{c}-1.log",
        "results/align/{c}/{c}-1/alignment.json",
        tuple(f"results/refine/{{c}}/{{c}}-1/{n}" for n in ("alignment.json", "observations.csv")),
    ),
    "rectify": Stage(
        "rectify",
        "logs/rectify/{c}/{c}-1.log",
        "results/refine/{c}/{c}-1/alignment.json",
        tuple(
            f"results/rectify/{{c}}/{{c}}-1/{n}"
            for n in ("epipolar.json", "left.zarr", "right.zarr")
        ),
    ),
    "project": Stage(
        "project",
        "logs/project/{c}/{c}-1.log",
        "results/ingest/{c}/{c}-1/Tiny-1_0_0.points",
        ("results/project/{c}/{c}-1.zarr",),
    ),
    "export": Stage(
        "export",
        "logs/export/{c}.log",
        "results/project/{c}/{c}-1.zarr",
        ("tiles/{c}", "results/export/{c}/matches.csv", "results/export/{c}/summary.json"),
    ),
    "evaluate_images": Stage(
        "evaluate_images",
        "logs/evaluate_images/{c}.log",
        "results/export/{c}/matches.csv",
        tuple(f"results/evaluate/{{c}}/{n}.csv" for n in ("table4", "sift", "warping")),
    ),
    "report": Stage(
        "report_city",
        "logs/report_city/{c}.log",
        "results/evaluate/{c}/sift.csv",
        ("results/report/{c}/index.html",),
    ),
    "predict": Stage(
        "predict_scene",
        "logs/predict_scene/{c}/{c}-1/sgm.log",
        "results/rectify/{c}/{c}-1/left.zarr",
        ("results/predict/{c}/{c}-1/sgm.zarr",),
    ),
    "dsm": Stage(
        "dsm",
        "logs/dsm/{c}/{c}-1/sgm.log",
        "results/predict/{c}/{c}-1/sgm.zarr",
        ("results/predict/{c}/{c}-1/sgm_dsm.tif",),
    ),
    "match": Stage(
        "match",
        "logs/match/{c}/sgm.log",
        "{c}/pairs/val/left/QC_left_3.tiff",
        ("results/match/{c}/sgm",),
        _edit_image,
    ),
    "score": Stage(
        "score",
        "logs/score/{c}/sgm.log",
        "{c}/pairs/val/disp/QC_disparity_3.tiff",
        ("benchmark/{c}/sgm",),
        _edit_image,
    ),
    "audit": Stage(
        "audit",
        "logs/audit/{c}.log",
        "{c}/pairs/val/disp/QC_disparity_3.tiff",
        ("audit/{c}",),
        _edit_image,
    ),
    "train": Stage(
        "train",
        "logs/train/{c}/net.log",
        "{c}/pairs/train/left/QC_left_0.tiff",
        tuple(f"results/train/{{c}}/net/{n}" for n in ("best.pt", "curves.csv", "training.json")),
        _edit_image,
    ),
}
CONFIG = {
    **SIZE,
    "predict": {"block_px": 256, "overlap_px": 32},
    "training": {"epochs": 2, "crop_px": [32, 64], "device": "cpu"},
}


def city_names(count: int) -> list[str]:
    return [f"C{k}" for k in range(count)]


def make_cities(folder: Path, count: int, data: Path | None = None) -> Project:
    """The input of so many cities, equal but for their names, and of as many datasets of pairs."""
    project = Project(folder)
    if (folder / "my.yaml").exists():
        return project
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("Snakefile", "workflow", "profiles", "envs", "config", "src"):
        (folder / name).symlink_to(ROOT / name)
    cities = city_names(count)
    if data is None:
        data = folder / cities[0]
        make_scene(TINY, TINY.scenes[0], data, spacing_m=0.4, seed=1)
    for city in cities:
        if folder / city != data:
            skip = shutil.ignore_patterns("truth.zarr", "pairs")
            shutil.copytree(data, folder / city, ignore=skip)
        small_dataset(folder / city / "pairs")
    datasets = {
        c: {"root": f"{c}/pairs", "layout": "whu", "disparity_range": list(RANGE)} for c in cities
    }
    methods = {"net": {"kind": "stereonet"}, "sgm": {"kind": "sgm"}}
    bench = {"datasets": datasets, "methods": methods, "split": "val", "bootstrap": 50}
    rows = [row_of(Path(c), scene=f"{c}-1", city=c) for c in cities]
    project.add_scene("my", rows, **CONFIG, benchmark=bench)
    return project
