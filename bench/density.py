"""Labels between points by density of the points, against exact truth. See README.md beside this.

One block of a synthetic scene is projected with its points thinned to several densities, in either
view; the truth of its grid is that of rule grid_truth. Nothing is written.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from stereotruth.disparity.label_window import label_window
from stereotruth.disparity.project import MAX_POINTS, SHARD
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.disparity.settings import Settings
from stereotruth.disparity.status import Status, is_labelled
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluation.epipolar_truth import truth_window
from stereotruth.evaluation.labels_against_truth import (
    CLASSES,
    ROOF_EDGE,
    TREE_EDGE,
    WATER,
    Truth,
)
from stereotruth.lidar.lattice import DEGREE_M
from stereotruth.lidar.point_store import Points, PointStore
from stereotruth.products.pictures import SERIES
from stereotruth.simulate.cities import CITIES

TARGETS = {  # points/m²: visible labelled at least, hidden, off by more than 1 px at most, %
    4: (95, 0.2, 0.03),
    2: (94, 0.2, 0.03),
    1: (92.5, 0.2, 0.03),
    0.5: (90.5, 0.2, 0.03),
    0.25: (88, 0.3, 0.05),
}


class Thinned(PointStore):
    """A point store of which a share of the pulses is seen, drawn by their place."""

    def __init__(self, path: Path, share: float) -> None:
        super().__init__(path)
        self.share = share
        self.count = int(self.count * share)

    @property
    def cell_counts(self) -> NDArray[np.int64]:
        return np.maximum((super().cell_counts * self.share).astype(np.int64), 1)

    def query(self, *box: float) -> Points:
        points = super().query(*box)
        if self.share >= 1.0:
            return points
        mixed = points.lon_q.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= points.lat_q.astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
        mixed ^= mixed >> np.uint64(29)
        mixed *= np.uint64(0xBF58476D1CE4E5B9)
        mixed ^= mixed >> np.uint64(32)
        kept = mixed < np.uint64(self.share * 2.0**64)
        return Points(*(getattr(points, name)[kept] for name in points.__dataclass_fields__))


def density(stores: list[PointStore]) -> float:
    """First returns per m² in the median cell."""
    store = stores[0]
    box = store.bounds
    middle = [(box[k] + box[k + 2]) / 2 for k in (0, 1)]
    half = 50.0 / DEGREE_M
    wide = half / np.cos(np.radians(middle[1]))
    found = store.query(middle[0] - wide, middle[1] - half, middle[0] + wide, middle[1] + half)
    return float((found.return_number <= 1).sum()) / 100.0**2


@dataclass
class Block:
    """A block of a scene, its truth and its points at any density."""

    scene: str
    results: Path
    rows: slice
    cols: slice
    view: str = "left"

    def __post_init__(self) -> None:
        city = self.scene.rsplit("-", 1)[0]
        at = self.results
        self.images = [at / "rectify" / city / self.scene / f"{v}.zarr" for v in ("left", "right")]
        self.paths = sorted((at / "ingest" / city / self.scene).glob("*.points"))
        self.truth = self.true(at / "rectify" / city / self.scene / "epipolar.json", city)
        self.density = density([PointStore(path) for path in self.paths])

    def true(self, epipolar_json: Path, city: str) -> Truth:
        """The exact truth of the block, by rays through its pixels."""
        made, model = CITIES[city], EpipolarModel.load(epipolar_json)
        window = truth_window(
            model, made, made.scene(self.scene), self.rows, self.cols, self.view
        )  # fmt: skip
        layers = xr.Dataset({name: (("y", "x"), array) for name, array in window.items()})
        height, width = window["disparity"].shape
        return Truth.read(layers, slice(0, height), slice(0, width))

    def job(self, points_per_m2: float | None, fill: str, method: str = "both") -> SceneInputs:
        """What labels the block; ``points_per_m2`` None: all points."""
        settings = Settings(method=method, fill=fill)
        job = SceneInputs(*self.images, tuple(self.paths), settings, self.view)
        share = 1.0 if points_per_m2 is None else points_per_m2 / self.density
        job.__dict__["stores"] = tuple(Thinned(path, share) for path in self.paths)
        return job

    def labels(self, job: SceneInputs) -> dict[str, NDArray]:
        """The layers of the block, put together from its windows."""
        out: dict[str, NDArray] = {}
        for rows, seen in self.windows(job):
            found = label_window(job, rows, seen)
            if found is None:
                continue
            cols = job.pair.cols(seen)
            for name, part in job.pair.arrays(found[0]).items():
                whole = out.setdefault(
                    name,
                    np.full(self.truth.kind.shape, np.nan if part.dtype.kind == "f" else 0)
                    .astype(part.dtype),
                )  # fmt: skip
                whole[
                    rows.start - self.rows.start : rows.stop - self.rows.start,
                    cols.start - self.cols.start : cols.stop - self.cols.start,
                ] = part
        return out

    def windows(self, job: SceneInputs) -> list[tuple[slice, slice]]:
        """Of the blocks of stage project, as far as they lie in this one, as the pair sees them."""
        return [
            window
            for r in range(self.rows.start, self.rows.stop, SHARD)
            for c in range(self.cols.start, self.cols.stop, SHARD)
            for window in job.windows.parts(
                slice(r, min(r + SHARD, self.rows.stop)),
                job.pair.cols(slice(c, min(c + SHARD, self.cols.stop))),
                MAX_POINTS,
            )
        ]

    def figures(self, found: dict[str, NDArray]) -> dict[str, Any]:
        """Shares (%) and errors (px) of the labels."""
        groups = self.truth.groups()
        land = self.truth.kind != WATER
        visible, hidden = groups["visible"] & land, groups["hidden"] & land
        known = is_labelled(found["status"])
        error = found["disparity"].astype(np.float64) - self.truth.disparity
        kinds = {
            "measured": Status.LABELLED,
            "between": Status.LABELLED_BETWEEN,
            "by images": Status.LABELLED_BY_IMAGES,
        }
        kinds = {name: visible & (found["status"] == kind) for name, kind in kinds.items()}
        edge = visible & np.isin(self.truth.kind, (ROOF_EDGE, TREE_EDGE))
        steps = np.abs(np.diff(self.truth.disparity, axis=1, prepend=np.nan)) > 1.0
        steps |= np.abs(np.diff(self.truth.disparity, axis=0, prepend=np.nan)) > 1.0
        near = visible & known & binary_dilation(steps, np.ones((7, 7)))
        sigma = found["uncertainty"].astype(np.float64)

        def share(part: NDArray[np.bool_], of: NDArray[np.bool_]) -> float:
            return 100.0 * float((part & of).sum()) / max(int(of.sum()), 1)

        off = np.abs(np.nan_to_num(error)) > 1.0
        result = (
            {
                "visible": share(known, visible),
                "hidden": share(known, hidden),
                "hidden by the LiDAR's world, too": share(known, hidden & ~groups["hidden_bared"]),
                "over 1 px": share(off, visible & known),
            }
            | {name: share(part, visible) for name, part in kinds.items()}
            | {
                "edges": share(known, edge),
                "edges > 1 px": share(off, edge & known),
                "within 3 px of a step > 1 px": share(off, near),
            }
        )
        for name, part in kinds.items():
            e, s = error[part], sigma[part]
            if e.size:
                result |= {
                    f"mean abs {name}": float(np.abs(e).mean()),
                    f"bias {name}": float(np.median(e)),
                    f"{name} < 1 sigma": 100.0 * float((np.abs(e) < s).mean()),
                    f"{name} < 2 sigma": 100.0 * float((np.abs(e) < 2 * s).mean()),
                }
        return result

    def losses(self, found: dict[str, NDArray]) -> dict[str, dict[str, float]]:
        """By kind of surface: share of visible pixels, and of these by status, %."""
        groups, land = self.truth.groups(), self.truth.kind != WATER
        visible, hidden = groups["visible"] & land, groups["hidden"] & land
        known = is_labelled(found["status"])
        wrong = known & (np.abs(found["disparity"] - self.truth.disparity) > 1.0)
        result = {}
        for number, name in enumerate(CLASSES):
            part = visible & (self.truth.kind == number)
            if not part.any():
                continue
            statuses = found["status"][part]
            result[name] = {
                "all": 100.0 * part.sum() / visible.sum(),
                "hidden labelled (of all hidden)": 100.0
                * float((known & hidden & (self.truth.kind == number)).sum() / hidden.sum()),
                "off (of all labelled)": 100.0 * float((wrong & part).sum() / known.sum()),
            } | {s.name.lower(): 100.0 * float((statuses == s).mean()) for s in Status}
        return result


def draw(path: Path, scene: str, figures: dict[str, dict[float, dict[str, Any]]]) -> None:
    """Shares of visible and of hidden pixels with a label by density, for each fill."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    titles = {
        "visible": "visible pixels with a label, %",
        "hidden": "hidden pixels with a label, %",
    }
    for panel, (name, title) in zip(panels, titles.items()):
        for fill, found, colour, shape in zip(figures, figures.values(), SERIES, "os^D"):
            shares = [f[name] for f in found.values()]
            panel.plot(list(found), shares, f"{shape}-", color=colour, ms=4, label=fill)
        panel.set_xscale("log", base=2)
        densities = sorted({d for found in figures.values() for d in found})
        panel.set_xticks(densities, [f"{d:.2g}" for d in densities])
        panel.set(title=title, xlabel="LiDAR points per m²", ylim=(0, None))
        panel.grid(alpha=0.3)
    panels[0].legend(title="project.fill", frameon=False)
    figure.suptitle(scene, fontsize="medium")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", help="whose results/rectify, ingest and truth are made")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--densities", type=float, nargs="+", default=list(TARGETS))
    parser.add_argument("--fill", nargs="+", default=["none", "surface", "surface_and_images"])
    parser.add_argument("--first", type=int, nargs=2, default=(1024, 1024), help="row, column")
    parser.add_argument("--size", type=int, default=1024, help="px; 0: to the end of the grid")
    parser.add_argument("--view", choices=("left", "right"), default="left")
    parser.add_argument("--kinds", action="store_true", help="statuses by kind of surface")
    parser.add_argument("--figure", type=Path, help="PNG of the shares by density")
    options = parser.parse_args()
    drawn: dict[str, dict[float, dict[str, Any]]] = {}
    city = options.scene.rsplit("-", 1)[0]
    rectified = options.results / "rectify" / city / options.scene
    shape = EpipolarModel.load(rectified / "epipolar.json").shape
    rows, cols = (
        slice(at, min(at + (options.size or end), end)) for at, end in zip(options.first, shape)
    )
    megapixels = (rows.stop - rows.start) * (cols.stop - cols.start) / 1e6
    block = Block(options.scene, options.results, rows, cols, options.view)
    print(f"{options.scene}, {options.view}: {block.density:.2f} first returns per m²")
    for fill in options.fill:
        for target in options.densities:
            job = block.job(None if target >= block.density else target, fill)
            first = (slice(edge.start, edge.start + 32) for edge in (rows, cols))
            label_window(job, *first)  # compiles
            start = time.process_time()
            found = block.labels(job)
            took = (time.process_time() - start) / megapixels
            figures = block.figures(found)
            drawn.setdefault(fill, {})[min(target, block.density)] = figures
            print(f"\n{fill}, {target:g} points/m²: {took:.1f} s a megapixel")
            if target in TARGETS and fill != "none":
                print("  to reach: {} / {} / {}".format(*TARGETS[target]))
            print("  " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()))
            if options.kinds:
                for name, row in block.losses(found).items():
                    shown = ", ".join(f"{k} {v:.2f}" for k, v in row.items() if v >= 0.005)
                    print(f"    {name}: {shown}")
    if options.figure:
        draw(options.figure, options.scene, drawn)


if __name__ == "__main__":
    main()
