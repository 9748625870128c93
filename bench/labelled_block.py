"""A block of a synthetic pair, labelled with its points thinned to any density, and its truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from synthetic_pairs import Pair

from stereotruth.config.labels import LabelSettings
from stereotruth.disparity.project import MAX_POINTS, SHARD
from stereotruth.disparity.recipe import label_window
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluation.epipolar_truth import truth_window
from stereotruth.evaluation.labels_against_truth import Truth
from stereotruth.lidar.point_store import Points, PointStore
from stereotruth.numerics.degrees import DEGREE_M


class Thinned(PointStore):
    """A point store of which a share of the pulses is seen, drawn by their place."""

    def __init__(self, path: Path, share: float) -> None:
        super().__init__(path)
        self.share = share
        self.count = int(self.count * share)

    @property
    def square_counts(self) -> NDArray[np.float64]:
        return super().square_counts * self.share

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


def density(store: PointStore) -> float:
    """First returns per m² in the hectare in the middle."""
    box = store.bounds
    middle = [(box[k] + box[k + 2]) / 2 for k in (0, 1)]
    half = 50.0 / DEGREE_M
    wide = half / np.cos(np.radians(middle[1]))
    found = store.query(middle[0] - wide, middle[1] - half, middle[0] + wide, middle[1] + half)
    return float((found.return_number <= 1).sum()) / 100.0**2


@dataclass
class Block:
    """A block [rows, cols] of the grid of a pair that was rectified into a folder."""

    pair: Pair
    rectified: Path
    rows: slice
    cols: slice
    view: str = "left"

    @cached_property
    def density(self) -> float:
        """First returns per m² of all points: of the fullest store's, since water returns few."""
        return max(density(PointStore(path)) for path in self.pair.points)

    @cached_property
    def _layers(self) -> dict[str, NDArray]:
        """The exact truth, by rays through the pixels."""
        model = EpipolarModel.load(self.rectified / "epipolar.json")
        pair = self.pair
        return truth_window(model, pair.city, pair.spec, self.rows, self.cols, self.view)

    @cached_property
    def truth(self) -> Truth:
        """The exact truth of the block."""
        layers = xr.Dataset({name: (("y", "x"), array) for name, array in self._layers.items()})
        return Truth.read(layers, *(slice(0, side) for side in self.surface.shape))

    @property
    def surface(self) -> NDArray[np.uint8]:
        """Kind of surface of each pixel, at edges too; index into the truth's SURFACES."""
        return self._layers["surface"]

    @property
    def megapixels(self) -> float:
        """Its size."""
        return self.surface.size / 1e6

    def job(self, points_per_m2: float | None, recipe: str = "surface") -> SceneInputs:
        """What labels the block; ``points_per_m2`` None, or more than there are: all points."""
        settings = LabelSettings(recipe=recipe)
        images = (self.rectified / f"{view}.zarr" for view in ("left", "right"))
        alignment = self.pair.alignment(self.rectified)
        job = SceneInputs(*images, tuple(self.pair.points), settings, self.view, alignment)
        share = min((points_per_m2 or self.density) / self.density, 1.0)
        stores = tuple(Thinned(path, share) for path in self.pair.points)
        job.__dict__["stores"] = stores  # the surface is made of these
        job = job.with_surface(self.rectified / f"surface_{share:.9f}", workers=2)
        job.__dict__["stores"] = stores  # and so are the labels: a copy has opened none
        return job

    def compile(self, job: SceneInputs) -> None:
        """Label a corner, so that what follows is compiled."""
        label_window(job, *(slice(edge.start, edge.start + 32) for edge in (self.rows, self.cols)))

    def labels(self, job: SceneInputs) -> dict[str, NDArray]:
        """The layers of the block, put together from its windows."""
        out: dict[str, NDArray] = {}
        for rows, seen in self.windows(job):
            found = label_window(job, rows, seen)
            if found is None:
                continue
            cols = job.pair.cols(seen)
            for name, part in job.pair.arrays(found[0]).items():
                nothing = np.nan if part.dtype.kind == "f" else 0
                whole = out.setdefault(name, np.full(self.surface.shape, nothing, part.dtype))
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
