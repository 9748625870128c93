"""A scene of 4096 x 4096 px predicted whole: seams, memory, errors of disparity and surface model.

One command, tables and a figure; see README.md beside this file.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import shutil
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from whole_images import match

from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.align import align
from stereotruth.config.methods import SceneMatching
from stereotruth.epipolar.image_reader import open_pair
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rectify import rectify
from stereotruth.evaluation.epipolar_truth import truth_window
from stereotruth.matching.benchmark.predictions import peak_memory_mb
from stereotruth.matching.methods import make_method
from stereotruth.matching.scenes.predict_scene import predict_scene
from stereotruth.matching.scenes.surface_model import Raster, write_dsm
from stereotruth.numerics.error_sums import ErrorSum
from stereotruth.numerics.robust import median_and_nmad
from stereotruth.pages.pictures import colours, stretch
from stereotruth.products.grids import Layer, atomic_store, blocks, create_grid, require_complete
from stereotruth.simulate.built_city import top_surface
from stereotruth.simulate.cities import Character, CitySpec, SceneSpec
from stereotruth.simulate.control_points import simulate_points
from stereotruth.simulate.render import simulate_image

ROOT = Path(__file__).parents[1]
SIZE = 4096
RANGE = (-64, 128)
BLOCK, OVERLAP = 1024, 64
KINDS = {"ground": 1, "roof": 2, "tree": 4, "water": 5}
EDGE_M = 1.0  # of height within a cell's neighbours: the cell lies at an edge
CITY = CitySpec(
    "Whole",
    lon=113.6,
    lat=24.8,
    epsg=32649,
    base_height_m=60.0,
    world_seed=23,
    character=Character(
        relief_m=240,
        valley=0.42,
        wavelength_m=2300,
        max_slope_deg=35,
        river_m=90,
        lakes=0,
        zones={
            "towers": 1.5,
            "slabs": 2,
            "lowrise": 2,
            "village": 2,
            "fields": 2,
            "industry": 1,
            "forest": 2,
        },
        towers_m=(30, 70),
        trees=1.0,
    ),
    scenes=(SceneSpec("Whole-1", (0.0, 0.0), 4600, 4600, 201),),
)
SCENE = CITY.scenes[0]


# ------------------------------------------------------------------------------------ the scene


def crop(source: Path, out: Path, model: EpipolarModel, first: tuple[int, int]) -> None:
    """The window of a rectified image that the model's grid is."""
    image, attrs = require_complete(source)["image"], dict(require_complete(source).attrs)
    attrs |= {"epipolar": model.to_dict(), "content": f"{attrs['content']} {first}"}
    layer = Layer("uint16", 0, dict(image.attrs))
    with atomic_store(out) as scratch:
        grids = {"image": layer}
        arrays = create_grid(scratch, model.shape, grids, chunk=256, shard=1024, attrs=attrs)
        for rows, cols in blocks(model.shape, 1024):
            there = (slice(w.start + f, w.stop + f) for w, f in zip((rows, cols), first))
            arrays["image"][rows, cols] = image[tuple(there)]


def make_scene(folder: Path) -> None:
    """Images by the rigorous camera, aligned by control points of 0.25 px noise, rectified."""
    simulate_points(CITY, SCENE, *(folder / f"{n}.csv" for n in ("gcps", "exact", "check")), seed=1)
    images = [folder / f"{view}.tif" for view in ("left", "right")]
    for image in images:
        simulate_image(CITY, SCENE, image.stem, image, seed=1)
    aligned = align(*images, folder / "gcps.csv")
    stores = [folder / f"whole_{image.stem}.zarr" for image in images]
    model = epipolar_model(aligned)
    with open_pair(*images) as pair:
        rectify(*pair, model, None, *stores, workers=2)
    row, col = ((n - SIZE) // 2 for n in model.shape)
    inner = replace(
        model,
        shape=(SIZE, SIZE),
        left_image=model.left_image.shifted(col, row),
        right_image=model.right_image.shifted(col, row),
    )
    for store in stores:
        crop(store, folder / store.name.removeprefix("whole_"), inner, (row, col))
        shutil.rmtree(store)
        shutil.rmtree(store.with_name(f".{store.name}.work"))


# ---------------------------------------------------------------------------------- what it took


def _measured(function: Callable, arguments: tuple, options: Mapping[str, Any]) -> tuple:
    begin = time.monotonic()
    result = function(*arguments, **options)
    seconds = time.monotonic() - begin
    return result, seconds, peak_memory_mb()


def measured(function: Callable, *arguments: Any, **options: Any) -> tuple[Any, float, float]:
    """Result, seconds and peak memory (MiB, libraries included) of a call in its own process."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(_measured, function, arguments, options).result()


# ----------------------------------------------------------------------------------- disparities


def steps_at_seams(disparity: np.ndarray, block: int) -> dict[str, dict[str, float]]:
    """Steps between neighbouring pixels across seams and elsewhere, px."""
    found: dict[str, list[np.ndarray]] = {"seams": [], "elsewhere": []}
    for grid in (disparity, disparity.T):
        step = np.abs(np.diff(grid, axis=1))
        at_seam = np.arange(1, grid.shape[1]) % block == 0
        for name, chosen in (("seams", at_seam), ("elsewhere", ~at_seam)):
            values = step[:, chosen]
            found[name].append(values[np.isfinite(values)])
    return {
        name: {
            "median": float(np.median(values)),
            "p90": float(np.percentile(values, 90)),
            "over_1px": float((values > 1).mean()),
            "unknown": float(1 - values.size / total),
        }
        for name, values, total in (
            (name, np.concatenate(parts), size)
            for (name, parts), size in zip(found.items(), _pairs(disparity.shape, block))
        )
    }


def _pairs(shape: tuple[int, int], block: int) -> tuple[int, int]:
    seams = sum((n - 1) // block * m for n, m in (shape, shape[::-1]))
    return seams, sum((n - 1) * m for n, m in (shape, shape[::-1])) - seams


def disparity_errors(store: Path) -> dict[str, Any]:
    """Errors of a prediction where both images show the surface, and how many have a value."""
    group = require_complete(store)
    model, total, visible = EpipolarModel.from_dict(group.attrs["epipolar"]), ErrorSum(), 0
    for window in blocks(model.shape, 1024):
        truth = truth_window(model, CITY, SCENE, *window)
        seen = (truth["visible"] == 1) & np.isfinite(truth["disparity"])
        error = group["disparity"][window] - truth["disparity"]
        visible += int(seen.sum())
        total.add(error[seen & np.isfinite(error)])
    return {"known": total.count / visible, **total.figures()}


def untiled(folder: Path, method: str, settings: dict[str, Any], part: tuple[int, int]) -> dict:
    """A method over a part of the scene at once and in tiles, with one offset: differences, px."""
    left, right = (
        require_complete(folder / f"{view}.zarr")["image"][: part[0], : part[1]]
        for view in ("left", "right")
    )
    matcher = make_method(method, settings, workers=2)
    given = {"overlap": OVERLAP, "offset": 0}
    whole = match(matcher, left, right, RANGE, block=max(part), **given)
    tiled = match(matcher, left, right, RANGE, block=BLOCK, **given)
    hard = match(matcher, left, right, RANGE, block=BLOCK, overlap=0, offset=0)
    rows, cols = (np.abs((np.arange(n) + BLOCK // 2) % BLOCK - BLOCK // 2) < OVERLAP for n in part)
    rows[:OVERLAP] = cols[:OVERLAP] = False  # the image's own edge
    zone = rows[:, None] | cols[None, :]
    found = {}
    for name, chosen in (("all", np.ones(part, bool)), ("blended", zone)):
        a, b = whole[chosen], tiled[chosen]
        difference = np.abs(a - b)
        difference = difference[np.isfinite(difference)]
        found[name] = {
            "median": float(np.median(difference)),
            "mean": float(difference.mean()),
            "over_0.05px": float((difference > 0.05).mean()),
            "over_1px": float((difference > 1).mean()),
            "validity_differs": float((np.isfinite(a) != np.isfinite(b)).mean()),
        }
    found["steps"] = {
        name: steps_at_seams(d, BLOCK)
        for name, d in (("whole", whole), ("tiled", tiled), ("cut", hard))
    }
    return found


# --------------------------------------------------------------------------------- surface model


def true_surface(raster: Raster) -> tuple[np.ndarray, np.ndarray]:
    """Top surface of the synthetic world at the cells' centres, m, and its kind (0: none)."""
    heights = np.full(raster.shape, np.nan, np.float32)
    kinds = np.zeros(raster.shape, np.uint8)
    for first in range(0, raster.shape[0], 256):
        rows = slice(first, min(first + 256, raster.shape[0]))
        row, col = np.mgrid[rows, 0 : raster.shape[1]].astype(float)
        heights[rows], kinds[rows] = top_surface(CITY, *raster.ground(col, row))
    return heights, kinds


def moved(values: np.ndarray, of: Raster, to: Raster) -> np.ndarray:
    """Cells of one raster on another one whose cells are the same, 0 where it has none."""
    down, right = (
        round((a - b) / of.resolution) for a, b in ((of.north, to.north), (to.west, of.west))
    )
    out = np.zeros(to.shape, values.dtype)
    cut = [
        (slice(max(-n, 0), max(-n, 0) + size), slice(max(n, 0), max(n, 0) + size))
        for n, size in zip((down, right), to.shape)
    ]
    part = values[tuple(source for _, source in cut)]
    ends = (slice(t.start, t.start + n) for (t, _), n in zip(cut, part.shape))
    into = out[tuple(ends)]
    into[...] = part[: into.shape[0], : into.shape[1]]
    return out


def read_dsm(path: Path) -> tuple[np.ndarray, Raster]:
    """Heights, NaN where there are none, and their grid."""
    with rasterio.open(path) as dataset:
        values = dataset.read(1)
        values[values == dataset.nodata] = np.nan
        t = dataset.transform
        return values, Raster(dataset.crs.to_epsg(), t.c, t.f, t.a, dataset.shape)


def _near_edges(truth: np.ndarray) -> np.ndarray:
    """Cells that have an edge of more than EDGE_M + a slope of 45° within 2 cells."""
    import cv2

    square = np.ones((5, 5), np.uint8)
    return cv2.dilate(truth, square) - cv2.erode(truth, square) > EDGE_M + 2 * 0.8 * 2


def surface_errors(dsm: np.ndarray, truth: np.ndarray, kinds: np.ndarray, inside: np.ndarray):
    """Errors in m by kind of surface; ``inside``: cells that the left grid shows."""
    edges = _near_edges(truth)
    groups = {"all": kinds > 0}
    groups |= {name: kinds == k for name, k in KINDS.items()}
    groups |= {f"{name}, 2 cells off edges": (kinds == KINDS[name]) & ~edges for name in KINDS}
    found = {}
    for name, chosen in groups.items():
        chosen = chosen & inside
        error = (dsm - truth)[chosen]
        error = error[np.isfinite(error)].astype(float)
        if not error.size:
            continue
        median, nmad = median_and_nmad(error)
        found[name] = {
            "cells": int(chosen.sum()),
            "known": error.size / int(chosen.sum()),
            "median": median,
            "nmad": nmad,
            "mean_absolute": float(np.abs(error).mean()),
            "rms": float(np.sqrt(np.mean(error**2))),
            "over_2m": float((np.abs(error) > 2).mean()),
        }
    return found


def shown(model: EpipolarModel, raster: Raster, truth: np.ndarray) -> np.ndarray:
    """Cells whose surface lies in the left grid."""
    inside = np.zeros(raster.shape, bool)
    for rows, cols in blocks(raster.shape, 1024):
        row, col = np.mgrid[rows, cols].astype(float)
        lon, lat = raster.ground(col, row)
        x, y = model.ground_to_epipolar(lon, lat, truth[rows, cols])[:2].reshape(2, *row.shape)
        inside[rows, cols] = (x >= 0) & (y >= 0) & (x < model.shape[1]) & (y < model.shape[0])
    return inside


# -------------------------------------------------------------------------------------- picture


def shaded(heights: np.ndarray, resolution: float, limits: tuple[float, float]) -> np.ndarray:
    """Heights in colour, light from the north-west at 45 degrees; NaN is light grey."""
    south, east = np.gradient(heights, resolution)
    light = (1.0 + east + south) / np.sqrt(1.0 + east**2 + south**2) / np.sqrt(3.0)
    light = np.where(np.isfinite(light), np.clip(0.25 + light, 0.0, 1.3), 1.0)
    return np.clip(colours(heights, limits, "cividis") * light[..., None], 0, 255).astype(np.uint8)


def draw(path: Path, folder: Path, methods: list[str], truth: np.ndarray, side: int = 760) -> None:
    """Left image and true surface, then disparity and surface model of each method.

    Below, a detail around the crossing of two seams, which are marked at its frame.
    """
    import cv2
    from matplotlib.figure import Figure
    from PIL import Image

    def small(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, (side, side * image.shape[0] // image.shape[1]), None, 0, 0, 3)

    seam, half = (3 * BLOCK, 2 * BLOCK), side // 2
    detail = tuple(slice(k - half, k + half) for k in seam)
    figure = Figure(figsize=(4.2 * (1 + len(methods)), 13.2), layout="constrained")
    axes = figure.subplots(3, 1 + len(methods))
    left = require_complete(folder / "left.zarr")["image"][:]
    found = {m: require_complete(folder / f"{m}.zarr")["disparity"][:] for m in methods}
    limits = tuple(np.nanpercentile(found[methods[0]][::8, ::8], (0.5, 99.5)))
    near = tuple(np.nanpercentile(found[methods[0]][detail], (0.5, 99.5)))
    heights = tuple(np.nanpercentile(truth[::8, ::8], (0.5, 99.5)))
    grey = stretch(left)
    panels = [
        [
            (small(grey), "left image, 4096 × 4096 px"),
            (small(shaded(truth, 0.8, heights)), "true surface"),
            (grey[detail], f"where four blocks meet, {side} × {side} px"),
        ]
    ]
    for method, disparity in found.items():
        dsm, raster = read_dsm(folder / f"{method}_dsm.tif")
        surface = shaded(dsm, raster.resolution, heights)
        panels.append(
            [
                (colours(disparity[2::5, 2::5], limits), f"{method}: disparity"),
                (small(surface), f"{method}: surface model"),
                (colours(disparity[detail], near), f"{method}: disparity"),
            ]
        )
    for column, of in zip(axes.T, panels):
        for ax, (picture, title) in zip(column, of):
            ax.imshow(picture, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
            ax.set_title(title, fontsize=10)
            ax.set_axis_off()
    for ax in axes[2]:  # where the seams are
        ax.set_axis_on()
        ax.set_xticks([half - 0.5], [""])
        ax.set_yticks([half - 0.5], [""])
        ax.tick_params(length=7, width=1.5, top=True, right=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    Image.open(path).convert("RGB").quantize(192).save(path, optimize=True)


# ----------------------------------------------------------------------------------------- table


def print_table(title: str, rows: Mapping[str, Mapping[str, float]]) -> None:
    """Rows by name, figures by column."""
    columns = list(dict.fromkeys(c for row in rows.values() for c in row))
    print(f"\n{title}")
    print(f"{'':34}" + "".join(f"{c:>18}" for c in columns))
    for name, row in rows.items():
        cells = (
            f"{row[c]:>18.4g}" if c in row and row[c] is not None else " " * 18 for c in columns
        )
        print(f"{name:34}" + "".join(cells), flush=True)


def parsed(text: str) -> tuple[str, dict[str, Any]]:
    """Name and settings of a method: ``sgm``, or ``stereonet=weights.pt``."""
    name, _, weights = text.partition("=")
    kind = name.partition("-")[0]
    return name, {"kind": kind, **({"weights": weights} if weights else {})}


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--folder", type=Path, default=ROOT / "results" / "whole_scene")
    parser.add_argument("--method", action="append", help="sgm, or stereonet[-x]=weights")
    parser.add_argument("--margin", type=int, help="px, for networks; default: their own")
    parser.add_argument("--part", type=int, nargs=2, default=(2048, 2048), help="tiled or not")
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    methods = dict(parsed(text) for text in given.method or ["sgm"])
    folder = given.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "right.zarr").exists():
        make_scene(folder)
    stores = folder / "left.zarr", folder / "right.zarr"
    facts: dict[str, Any] = {}
    first = None
    for method, settings in methods.items():
        store, tiff = folder / f"{method}.zarr", folder / f"{method}_dsm.tif"
        margin = None if settings["kind"] == "sgm" else given.margin
        of = SceneMatching(RANGE, block_px=BLOCK, overlap_px=OVERLAP, margin_px=margin)
        options = {"method": method, "entry": settings, "settings": of, "workers": 2}
        summary, seconds, peak = measured(predict_scene, *stores, store, **options)
        _, dsm_seconds, dsm_peak = measured(write_dsm, store, tiff, workers=2)
        dsm, raster = read_dsm(tiff)
        if first is None:
            first = raster, *true_surface(raster)
        truth, kinds = (moved(values, first[0], raster) for values in first[1:])
        model = EpipolarModel.from_dict(require_complete(store).attrs["epipolar"])
        inside = shown(model, raster, truth)
        compared, *_ = measured(untiled, folder, method, settings, tuple(given.part))
        facts[method] = {
            "cost": {
                "predict_s": seconds,
                "predict_peak_mib": peak,
                "dsm_s": dsm_seconds,
                "dsm_peak_mib": dsm_peak,
            },
            "summary": summary,
            "disparity": disparity_errors(store),
            "seams": steps_at_seams(require_complete(store)["disparity"][:], BLOCK),
            "untiled": compared,
            "surface": surface_errors(dsm, truth, kinds, inside),
        }
        of = facts[method]
        print_table(f"{method}: cost", {method: of["cost"]})
        print_table(f"{method}: disparity of visible pixels, px", {method: of["disparity"]})
        print_table(f"{method}: steps between neighbours, px", of["seams"])
        both = {name: compared[name] for name in ("all", "blended")}
        print_table(f"{method}: tiled against at once, {given.part} px", both)
        for name, steps in compared["steps"].items():
            print_table(f"{method}: steps in that part, {name}", steps)
        print_table(f"{method}: surface model, m", of["surface"])
    if given.json:
        given.json.write_text(json.dumps(facts, indent=2) + "\n")
    if given.figure:
        draw(given.figure, folder, list(methods), np.where(inside, truth, np.nan))


if __name__ == "__main__":
    sys.exit(main())
