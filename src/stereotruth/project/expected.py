"""What a run gives and takes: tiles and labels by the headers of its files; time, disk, memory."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import Configuration
from ..core.errors import in_number
from ..core.kernels import folder, sources_digest
from ..core.numerics.arrays import Bools
from ..core.numerics.geometry import DEGREE_M
from ..core.numerics.windows import summed_area, window_sums
from ..epipolar.model import EpipolarModel
from ..lidar.ingest import SurveyedFile
from ..tiles.scene_stores import cell_step
from .findings import Findings, Level

# Shares of the pixels that both views see which get a label, by recipe, at so many points a pixel:
# means of three fresh cities by bench/density.py.
POINTS_PER_PX = (0.042, 0.106, 0.212, 0.424, 0.847, 1.7, 2.54)
LABELLED = {
    "paper": (0.0363, 0.0887, 0.17, 0.315, 0.541, 0.794, 0.878),
    "surface": (0.52, 0.63, 0.711, 0.776, 0.828, 0.881, 0.9),
}
# Seconds of one core, by bench/throughput.py and a run of 34000 x 30000 px with three scenes: for
# each point (ingest, project), pixel (rectify and the scan for points), pixel with LiDAR (project
# and export), scene, and start of a job.
POINT_S, PX_S, COVERED_PX_S, SCENE_S, JOB_S = 9.6e-7, 1.2e-6, 9.8e-6, 60.0, 8.0
JOBS = 5  # of a scene, beside one for each LiDAR file
POINT_BYTES, PX_BYTES = 12.0, 24.0  # on the disk
SPARE = 1.2  # of the disk: blocks in the making
RECORDS_BYTES = 2e8  # logs, pages, what Snakemake notes
MEMORY = 4.0e9  # that rules of the way to tiles ask for
SUPPORT_PX = 2.0  # around a place, of an image that is resampled by cubic convolution
NODES = 128  # along the longer side of the grid
SMALL_HOLE_M2, SMALL_HOLE = 10_000, 0.001  # rims that are not worth a line: area, and share
WRITTEN, NESTED = ("results", "tiles", "logs", ".snakemake"), ("results", "logs")  # by a run
COMPILED_LAST = "stereotruth.labels.pixel_labels"  # by a run to tiles, of the sources of all others
COMPILE_S = 70.0  # of the kernels of tiles, on a core (docs/explanation/speed.md)
BOX_SLACK = 2.0  # how much denser points may be than their header's box says: it may be half empty


@dataclass(frozen=True)
class Nodes:
    """Places of the epipolar grid, ``step`` px apart: ``seen`` where both images show ground.

    ``x``, ``y`` [rows, cols] px; the right image is taken as at the reference height.
    """

    model: EpipolarModel
    step: float
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    seen: Bools

    @classmethod
    def of(cls, model: EpipolarModel) -> Nodes:
        """Of a whole grid."""
        rows, cols = model.shape
        step = max(rows, cols) / NODES
        axes = [np.arange(step / 2, side, step) - 0.5 for side in (cols, rows)]
        x, y = np.meshgrid(*axes)
        seen = np.ones(x.shape, bool)
        for inverse, size in (
            (model.epipolar_to_left, model.left_size),
            (model.epipolar_to_right, model.right_size),
        ):
            place = inverse(x.ravel(), y.ravel())
            for values, side in zip(place, size):
                values = np.asarray(values).reshape(x.shape)
                seen &= (values >= SUPPORT_PX) & (values <= side - 1 - SUPPORT_PX)
        return cls(model, step, x, y, seen)

    def ground(self, height: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """lon, lat [rows, cols] of the nodes at an ellipsoidal height in m."""
        lon, lat = self.model.epipolar_to_ground(self.x.ravel(), self.y.ravel(), height)
        return np.asarray(lon).reshape(self.x.shape), np.asarray(lat).reshape(self.x.shape)

    def windows(self, values: NDArray, size: int) -> NDArray[np.float64]:
        """Means of values over all squares of ``size`` px, [rows, cols] of their first nodes."""
        n = max(round(size / self.step), 1)
        return window_sums(values, n) / n**2

    def windows_at(self, values: NDArray, size: int, step: int) -> NDArray[np.float64]:
        """Means of values over all squares of ``size`` px whose origins are multiples of ``step``.

        A square has all nodes whose cells it touches.
        """
        origins = [np.arange(0, side - size + 1, step) for side in self.model.shape]
        (top, left), (bottom, right) = (
            [((at + more) / self.step).astype(int) + end for at in origins]
            for more, end in ((0, 0), (size - 1, 1))
        )
        bottom, right = (np.minimum(at, n) for at, n in zip((bottom, right), values.shape))
        table = summed_area(values)
        sums = table[np.ix_(bottom, right)] - table[np.ix_(top, right)]
        sums = sums - table[np.ix_(bottom, left)] + table[np.ix_(top, left)]
        return sums / ((bottom - top)[:, None] * (right - left)[None, :])

    def fits(self, size: float) -> bool:
        """Whether a square of that size lies in what both images show."""
        means = self.windows(self.seen, int(size))
        return bool(means.size and means.max() > 1 - 1e-9)

    @property
    def largest(self) -> int:
        """Side of the largest square in px, a multiple of 32, 16 at least."""
        fitting = [side for side in range(32, min(self.model.shape) + 1, 32) if self.fits(side)]
        return fitting[-1] if fitting else 16


def check_frame(nodes: Nodes, settings: Configuration, found: Findings) -> None:
    """Refuse tiles that are larger than what both images show: all their pixels have to be seen."""
    size, rows, cols = settings.tiles.size, *nodes.model.shape
    if nodes.fits(size):
        return
    certain = not nodes.fits(size - 2 * nodes.step)
    found.say(
        "tiles",
        Level.ERROR if certain else Level.DOUBT,
        f"{'not one' if certain else 'maybe not one'} tile of {size} px lies wholly in what both "
        f"images show of the {cols} x {rows} px grid",
        f"set tiles.size to {nodes.largest} or less",
    )


def expected_share(points_per_px: float, recipe: str) -> float:
    """Share of the pixels which both views see that will have a label."""
    return float(np.interp(points_per_px, [0.0, *POINTS_PER_PX], [0.0, *LABELLED[recipe]]))


def pixel_m2(model: EpipolarModel) -> float:
    """Ground that a pixel in the middle of the grid shows, m²."""
    rows, cols = model.shape
    x, y = cols / 2 + np.array([0.0, 1.0, 0.0]), rows / 2 + np.array([0.0, 0.0, 1.0])
    lon, lat = map(np.asarray, model.epipolar_to_ground(x, y, model.reference_height))
    sides = np.stack([(lon[1:] - lon[0]) * np.cos(np.radians(lat[0])), lat[1:] - lat[0]])
    return float(abs(np.linalg.det(sides * DEGREE_M)))


def check_labels(
    nodes: Nodes, placed: Sequence[SurveyedFile], settings: Configuration, found: Findings
) -> float:
    """Say what share of the pixels will be labelled, by the headers' boxes and counts.

    ``placed``: files with box and heights. Returns the share of the images with LiDAR.
    """
    lon, lat = nodes.ground(float(np.mean([file.heights for file in placed])))
    density = np.zeros(lon.shape)  # points a m², of the boxes that a node lies in
    for file in placed:
        west, south, east, north = file.box
        inside = (lon >= west) & (lon <= east) & (lat >= south) & (lat <= north)
        density[inside] += file.points / max(file.area_m2, 1.0)
    covered = nodes.seen & (density > 0)
    share = float(covered.sum() / max(nodes.seen.sum(), 1))
    if not share:
        return 0.0
    per_m2 = float(density[covered].mean())
    per_px, recipe = per_m2 * pixel_m2(nodes.model), settings.project.recipe
    expected = expected_share(per_px, recipe)
    found.fact(
        "labels",
        f"{per_m2:.2g} points/m² by the headers, {per_px:.2g} a pixel, on {100 * share:.0f} % of "
        f"what both images show: some {100 * expected:.0f} % of the pixels that neither image "
        f"hides will have a label (project.recipe: {recipe}), "
        f"in {_tiles_in_words(nodes, covered, expected, settings)}",
    )
    _say_holes(nodes, density > 0, (lon, lat), found)
    _hold_against_tiles(nodes, covered, per_px, settings, found)
    return share


def _say_holes(
    nodes: Nodes, covered: Bools, ground: tuple[NDArray, NDArray], found: Findings
) -> None:
    """Name the ground that both images show and that lies in no file's bounds, with its area."""
    empty = nodes.seen & ~covered
    area = empty.sum() * nodes.step**2 * pixel_m2(nodes.model)
    if area < SMALL_HOLE_M2 and empty.sum() < SMALL_HOLE * nodes.seen.sum():
        return
    _, group, sizes, _ = cv2.connectedComponentsWithStats(empty.astype(np.uint8), connectivity=4)
    largest = group == 1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA]))
    lon, lat = (float(values[largest].mean()) for values in ground)
    found.fact(
        "LiDAR",
        f"{_area(area)} of what both images show lie in no file's bounds and get no label, "
        f"most of it around longitude {lon:.5f}, latitude {lat:.5f}",
    )


def _tiles_in_words(nodes: Nodes, covered: Bools, expected: float, settings: Configuration) -> str:
    """About how many tiles there will be, by the best position of their grid, as export has it."""
    size, needed = settings.tiles.size, settings.tiles.min_labelled
    stride = settings.tiles.stride or size
    step = cell_step(size, stride)
    whole = nodes.windows_at(nodes.seen, size, step)
    if not whole.size:
        return "no tile"
    labelled = expected * nodes.windows_at(covered, size, step)
    enough = (whole > 1 - 1e-9) & (labelled >= needed)
    every, jump = stride // step, max(size // step // 8, 1)
    counts = [
        int(enough[row::every, col::every].sum())
        for row in range(0, min(every, enough.shape[0]), jump)
        for col in range(0, min(every, enough.shape[1]), jump)
    ]
    return f"about {in_number(max(counts), 'tile')} of {size} px"


def _hold_against_tiles(
    nodes: Nodes, covered: Bools, per_px: float, settings: Configuration, found: Findings
) -> None:
    """Doubt or refuse settings by which even the best tile has too few labels."""
    size, needed, recipe = settings.tiles.size, settings.tiles.min_labelled, settings.project.recipe
    means = nodes.windows(covered, size)
    whole = nodes.windows(nodes.seen, size) > 1 - 1e-9 if means.size else means.astype(bool)
    if not whole.any():  # said by check_frame
        return
    best = float(means[whole].max())
    expected = best * expected_share(per_px, recipe)
    if expected >= needed:
        return
    remedy = f"set tiles.min_labelled below {expected:.2g}, or give more LiDAR"
    by_surface = best * expected_share(per_px, "surface")
    if recipe != "surface" and by_surface >= needed:
        remedy = f"set project.recipe to surface ({by_surface:.0%}), or {remedy}"
    dense = best * expected_share(BOX_SLACK * per_px, recipe)
    found.say(
        "labels",
        Level.DOUBT if dense >= needed else Level.ERROR,
        f"some {expected:.0%} of the best tile's pixels will have a label (LiDAR on {best:.0%} of "
        f"it), tiles.min_labelled asks for {needed:.0%}",
        remedy,
    )


@dataclass
class SceneFacts:
    """What the run's time and disk follow from."""

    scene: str
    pixels: int = 0  # of the epipolar grid
    points: int = 0  # of the LiDAR
    lidar_files: int = 0
    covered: float = 1.0  # share of the grid


def duration(seconds: float) -> str:
    """A time span in the words of a person."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def check_resources(
    facts: Sequence[SceneFacts], found: Findings, others: Collection[str] = ()
) -> None:
    """Say what a run from nothing takes, and refuse a disk that is too small for it, or on which
    it cannot write. ``others``: cities that it makes nothing of."""
    if not facts:
        return
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    points, pixels = (sum(getattr(f, name) for f in facts) for name in ("points", "pixels"))
    covered = sum(fact.pixels * fact.covered for fact in facts)
    seconds = POINT_S * points + PX_S * pixels + COVERED_PX_S * covered + SCENE_S * len(facts)
    seconds += JOB_S * sum(JOBS + fact.lidar_files for fact in facts)
    compiling = "" if is_compiled() else f" + {duration(COMPILE_S)} compiling, once"
    needed = SPARE * (POINT_BYTES * points + PX_BYTES * pixels) + RECORDS_BYTES
    free = shutil.disk_usage(Path.cwd()).free
    found.fact(
        "time",
        f"about {duration(seconds / max(cores or 1, 1))}{compiling} on the {cores} cores of this "
        "machine, from nothing to tiles",
    )
    for path in locked_folders(others):
        found.fault(
            "disk",
            f"{path}: nothing can be written there",
            "take the write protection off (chmod u+w), or work in a folder of your own",
        )
    if needed > free:
        found.fault(
            "disk",
            f"{_gb(needed)} are needed in {Path.cwd()}, {_gb(free)} are free",
            "make space, or work in a folder on a larger disk",
        )
    else:
        found.fact("disk", f"{_gb(needed)} of the {_gb(free)} that are free")
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if memory < MEMORY:
        found.doubt(
            "memory",
            f"{_gb(memory)} in all, jobs ask for up to {_gb(MEMORY)}",
            "run with --cores 1",
        )
    else:
        found.fact("memory", f"up to {_gb(MEMORY)} a job, of {_gb(memory)}")


def is_compiled() -> bool:
    """Whether the kernels of tiles are kept, of their present sources."""
    import_module(COMPILED_LAST)
    return any((folder() / sources_digest(COMPILED_LAST)).rglob("*.nbc"))


def locked_folders(others: Collection[str] = ()) -> list[Path]:
    """Folders of the products of a run in which nothing can be written: those that are there, with
    the ones in them that products lie in, else the nearest above. Not those of ``others``, cities
    that nothing is made of."""
    found = {top if top.is_dir() else Path() for top in map(Path, WRITTEN)}
    found |= {path for top in NESTED for end in ("*", "*/*") for path in Path(top).glob(end)}
    found = {path for path in found if path.name not in others}
    folders = (path for path in found if path.is_dir() and not path.suffix)
    return sorted(path for path in folders if not os.access(path, os.W_OK | os.X_OK))


def _area(m2: float) -> str:
    return f"{m2 / 1e6:.3f} km²" if m2 >= SMALL_HOLE_M2 else f"{m2:.0f} m²"


def _gb(count: float) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 5e7 else "less than 0.1 GB"
