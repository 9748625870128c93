"""The arrays of a disparity store: what their attributes say, and their values.

What the LiDAR decides of a block is kept in a file (:class:`LidarLabels`) until the images are
asked, which need it of the block and of what lies around, and no point.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import LabelSettings
from ..core.numerics.arrays import Bytes, Singles
from ..core.products.files import atomic_file
from ..core.products.grids import Layer
from ..core.status import Reason, Status, is_labelled, statuses_of
from .pair_window import Labels, WindowLabels
from .view_geometry import Pair

GREATEST_COUNT = 65535  # of points of a pixel that is stored

Shorts = NDArray[np.uint16]
Block = tuple[slice, slice]


def layers_of(
    labels: WindowLabels,
    correlation: NDArray[np.floating],
    change: NDArray[np.uint8],
    pair: Pair,
    rows: slice,
    cols: slice,
) -> dict[str, NDArray]:
    """The layers of a window of a pair from its ``labels``, the ``correlation`` of both images and
    why it has changed (:class:`.status.Reason`).

    The variance of the alignment joins that of the labels (eq. 13 of docs/explanation/surface.md).
    """
    y, x = (np.arange(grid.start, grid.stop, dtype=np.float64) for grid in (rows, cols))
    variance = labels.labels.variance + pair.alignment_variance(x, y, labels.labels.slope)
    values = {
        "disparity": labels.labels.disparity,
        "height": labels.height,
        "correlation": correlation,
        "uncertainty": np.sqrt(variance),
    }
    known = is_labelled(labels.status)
    layers = {name: np.where(known, v, np.nan).astype(np.float32) for name, v in values.items()}
    kept = known | (labels.status == Status.BELOW_MINIMUM_COUNT)
    count = np.where(kept, np.minimum(labels.point_count, GREATEST_COUNT), 0)
    layers["point_count"] = count.astype(np.uint16)
    layers["surface_class"] = np.where(known, labels.surface_class, 0).astype(np.uint8)
    layers["lidar_date"] = np.where(known, labels.day, 0).astype(np.uint16)
    layers["status"] = labels.status
    layers["change"] = change
    return layers


def layers(settings: LabelSettings, view: str, masked: bool = False) -> dict[str, Layer]:
    """The arrays of a disparity store of the ``view``, left or right.

    ``masked``: whether a mask hides something of an image.
    """
    on_surface = settings.recipe == "surface"
    used = "points whose image windows correlate"
    if on_surface:
        used = "points on the surface that the pixel's centre sees"
    height = {
        "units": "m",
        "long_name": "greatest height above the WGS 84 ellipsoid of the points used",
        "nodata": "NaN",
    }
    count = {
        "units": "1",
        "long_name": f"number of points used: {used}",
        "comment": f"counts above {GREATEST_COUNT} are stored as {GREATEST_COUNT}",
    }
    surface_class = {
        "units": "1",
        "long_name": "LAS class (ASPRS) of the highest point used",
        "comment": "0: never classified, or no label",
    }
    return {
        "disparity": Layer("float32", np.nan, _disparity(on_surface, view)),
        "status": Layer("uint8", 0, _status(settings, view, masked)),
        "height": Layer("float32", np.nan, height),
        "point_count": Layer("uint16", 0, count),
        "correlation": Layer("float32", np.nan, _correlation(settings, view)),
        "uncertainty": Layer("float32", np.nan, _uncertainty(settings)),
        "surface_class": Layer("uint8", 0, surface_class),
        "lidar_date": Layer("uint16", 0, _lidar_date(on_surface)),
        "change": Layer("uint8", 0, _change()),
    }


def _other(view: str) -> str:
    return {"left": "right", "right": "left"}[view]


def _disparity(on_surface: bool, view: str) -> dict[str, str]:
    """Attributes of the layer disparity."""
    match = {"left": "x - disparity", "right": "x + disparity"}[view]
    attributes = {
        "units": "px",
        "long_name": f"ground-truth disparity x_left - x_right of the {view} view",
        "nodata": "NaN",
        "match": f"what the {view} image shows at (x, y), the {_other(view)} one shows at "
        f"({match}, y)",
        "representative": "disparity of the point at mean longitude and latitude, greatest height",
    }
    if on_surface:
        attributes["representative"] = (
            "disparity at the pixel's centre, by a plane through the mean points of the pixel and "
            "of its neighbours on the same surface"
        )
        attributes["between"] = (
            "where the status is labelled_between, or a point is less sure than those around it: "
            "linear in the facet of points that the pixel's centre sees; where it is "
            "labelled_crown: linear in the triangle of the tops of a rough surface"
        )
    return attributes


def _status(settings: LabelSettings, view: str, masked: bool) -> dict[str, object]:
    """Attributes of the layer status."""
    other = _other(view)
    statuses = statuses_of(settings.recipe, masked)
    attributes = {
        "units": "1",
        "long_name": "why a pixel has a label or none",
        "flag_values": [int(status) for status in statuses],
        "flag_meanings": " ".join(status.label for status in statuses),
        "changed": "LiDAR and images show different surfaces there, or water",
        "precedence": "frame, correlation of points, number of points of pixels",
    }
    if settings.recipe == "surface":
        attributes |= {
            "labelled_crown": "a rough surface that both views must show; its uncertainty follows "
            "from the roughness of its points",
            "edge_in_pixel": "no facet of points, or a height step between points may be nearer to "
            "one of the cameras",
            "precedence": f"mask, frame, {other} view, edge, own points, points around; then "
            "crowns of pixels with an edge, and changes of pixels with a label",
        }
    if masked:
        attributes["masked"] = (
            f"a mask hides the pixel, or what the {other} image shows of it; or a mask reaches "
            "into the windows that are compared around it"
        )
    return attributes


def _change() -> dict[str, object]:
    """Attributes of the layer change."""
    return {
        "units": "1",
        "long_name": "what has changed between LiDAR and images, of pixels of the status changed",
        "flag_values": [int(reason) for reason in Reason],
        "flag_meanings": " ".join(reason.name.lower() for reason in Reason),
        "grown_or_felled": "trees and other vegetation",
        "moved": "vehicles, and what else is as small and low",
        "ground": "the ground itself, as crops, earthworks",
        "unknown": "the images contradict the LiDAR, and nothing tells what has changed",
    }


def _lidar_date(on_surface: bool) -> dict[str, object]:
    """Attributes of the layer lidar_date, which xarray reads as dates."""
    point = "nearest vertex of the surface, by the GPS time of its highest point"
    if not on_surface:
        point = "highest point used, by its GPS time"
    return {
        "units": "days since 1970-01-01",
        "calendar": "proleptic_gregorian",
        "long_name": f"day on which the LiDAR measured what the label shows: that of the {point}, "
        "else the middle of the days of its file by the list of tiles",
        "nodata": 0,
        "_FillValue": 0,  # not known, or no label
    }


def _correlation(settings: LabelSettings, view: str) -> dict[str, str]:
    """Attributes of the layer correlation."""
    compared = "mean correlation coefficient of the image windows at the points used"
    if settings.recipe == "surface":
        compared = (
            f"correlation coefficient of {view} and warped {_other(view)} image over the pixels of "
            f"the same surface in {settings.window} x {settings.window} px"
        )
    return {"units": "1", "long_name": compared, "nodata": "NaN"}


def _uncertainty(settings: LabelSettings) -> dict[str, str]:
    """Attributes of the layer uncertainty."""
    attributes = {
        "units": "px",
        "long_name": "standard uncertainty of the disparity",
        "nodata": "NaN",
        "formula": "sqrt(v / n + p + var(ed - gx ex - gy ey)): v variance of the points' "
        "disparities about their surface, pooled over 3 x 3 pixels; n point_count; p variance of "
        "the plane to the centre; (gx, gy) slope of the disparity; ed, (ex, ey) errors of a ground "
        "point's disparity and place by the alignment, whose covariance is that of alignment.json",
    }
    if settings.recipe == "surface":
        attributes["labelled_crown"] = (
            "v / n + p is what the roughness of the tops of the surface leaves between them"
        )
    if settings.recipe == "surface" and settings.diachronic:
        attributes["diachronic"] = (
            "p has the probability, px², that the surface has changed though images of two lights "
            "do not contradict it"
        )
    return attributes


class LidarLabels(NamedTuple):
    """Labels of a window before its images are compared; arrays [h, w] of the types of LIDAR_TYPES.

    Of :class:`.pair_window.WindowLabels`: ``status``, ``disparity``, slope along x and y,
    ``variance``, ``height``, ``surface_class``, ``day``, ``point_count``. ``is_rough``: 1 where a
    rough surface may be seen. Of each pixel's own points: height of the ``highest`` (m, NaN for
    none) on the surface that the centre sees, and its class.
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
        return cls(*(np.asarray(a, kind) for a, kind in zip(values, LIDAR_TYPES.values())))

    @classmethod
    def none(cls, shape: tuple[int, int]) -> LidarLabels:
        """Of pixels without points."""
        fill = {"f4": np.nan, "u1": 0, "u2": 0}
        return cls(*(np.full(shape, fill[kind], kind) for kind in LIDAR_TYPES.values()))

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


LIDAR_TYPES = dict(
    zip(
        LidarLabels._fields,
        ("u1", "f4", "f4", "f4", "f4", "f4", "u1", "u2", "u2", "u1", "f4", "u1"),
    )
)
