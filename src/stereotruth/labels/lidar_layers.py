"""What the LiDAR decides of the pixels of a window, as it is kept until the images are asked.

Of each block of the grid there is a file with the arrays of :data:`LAYERS`, one after the other, as
long as a block around needs it (:mod:`.project`). The images of a window then ask for the labels of
this and of what lies around, and for no point.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.products.files import atomic_file
from .layers import GREATEST_COUNT
from .pair_window import Labels, WindowLabels

Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Shorts = NDArray[np.uint16]
Block = tuple[slice, slice]


class LidarLabels(NamedTuple):
    """Labels of a window before its images are compared; arrays [h, w] of the types of LAYERS.

    Of :class:`.WindowLabels`: ``status``, ``disparity``, slope along x and y, ``variance``,
    ``height``, ``surface_class``, ``day``, ``point_count``. ``is_rough``: 1 where a rough surface
    may be seen. Of each pixel's own points: height of the ``highest`` (m, NaN for none) on the
    surface that the centre sees, and its class.
    """

    status: Bytes
    disparity: Singles
    slope_x: Singles
    slope_y: Singles
    variance: Singles
    height: Singles
    surface_class: Bytes
    day: Shorts
    point_count: Shorts
    is_rough: Bytes
    highest: Singles
    highest_class: Bytes

    @classmethod
    def of(
        cls, labels: WindowLabels, is_rough: NDArray[np.bool_], highest: NDArray, classes: Bytes
    ) -> LidarLabels:
        """From ``labels`` and what else there is of their pixels."""
        of_points = labels.labels
        count = np.minimum(labels.point_count, GREATEST_COUNT)
        values = (
            labels.status, of_points.disparity, *of_points.slope, of_points.variance,
            labels.height, labels.surface_class, labels.day, count, is_rough, highest, classes,
        )  # fmt: skip
        return cls(*(np.asarray(a, kind) for a, kind in zip(values, LAYERS.values())))

    @classmethod
    def none(cls, shape: tuple[int, int]) -> LidarLabels:
        """Of pixels without points."""
        fill = {"f4": np.nan, "u1": 0, "u2": 0}
        return cls(*(np.full(shape, fill[kind], kind) for kind in LAYERS.values()))

    @property
    def labels(self) -> WindowLabels:
        """As labels."""
        slope = np.stack([self.slope_x, self.slope_y]).astype(np.float64)
        of_points = Labels(self.disparity.astype(np.float64), slope, self.variance)
        count = self.point_count.astype(np.int64)
        return WindowLabels(
            self.status, of_points, self.height, self.surface_class, self.day, count
        )

    def write(self, path: Path) -> None:
        """To a file."""
        with atomic_file(path) as scratch, scratch.open("wb") as file:
            for values in self:
                np.ascontiguousarray(values).tofile(file)

    @classmethod
    def read(cls, files: Iterable[tuple[Path, Block]], rows: slice, cols: slice) -> LidarLabels:
        """Of a window, from the ``files`` of all blocks around it, as far as they are there."""
        out = cls.none((rows.stop - rows.start, cols.stop - cols.start))
        for path, block in files:
            ends = [
                (max(whole.start, part.start), min(whole.stop, part.stop))
                for whole, part in zip((rows, cols), block)
            ]
            if any(first >= end for first, end in ends) or not path.exists():
                continue
            here, there = (
                tuple(slice(a - edge.start, b - edge.start) for (a, b), edge in zip(ends, edges))
                for edges in ((rows, cols), block)
            )
            shape = tuple(edge.stop - edge.start for edge in block)
            kept = np.memmap(path, np.uint8, "r")
            start = 0
            for values in out:
                end = start + shape[0] * shape[1] * values.itemsize
                values[here] = kept[start:end].view(values.dtype).reshape(shape)[there]
                start = end
        return out


LAYERS = dict(
    zip(
        LidarLabels._fields,
        ("u1", "f4", "f4", "f4", "f4", "f4", "u1", "u2", "u2", "u1", "f4", "u1"),
    )
)
