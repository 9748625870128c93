"""What the labels of a view need to know of a pair's geometry.

Rays from the ground to both cameras, and the cells of ground that follow from a pixel's size:
nothing is tuned to a scene, and all follows from the epipolar model, so that results do not depend
on blocks, files or their order.

The right view is the reference by mirroring. A pair whose images are exchanged and mirrored along
the rows is a pair like any other: with x' = last - x, the new left image is the old right one, and
d' = x'_left' - x'_right' = x_left - x_right. So the right view's labels are those of the mirrored
pair, mirrored back. :func:`seen_from` is the one place where the views part: what works on its
:class:`Pair` labels the left image, windows go in by :meth:`Pair.cols`, and labels come out by
:meth:`Pair.arrays`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..align.label_uncertainty import LabelUncertainty
from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import DEGREE_M
from ..core.status import Status
from ..epipolar.model import EpipolarModel
from ..lidar.lattice import LATTICE_DEG
from ..surface.scale import GROUND_CELL_PX, SurfaceScale
from .pair_window import Array2D, MaskedImage


class ViewGeometry(Protocol):
    """What is used of :class:`stereotruth.epipolar.model.EpipolarModel`."""

    shape: tuple[int, int]
    reference_height: float

    def ground_to_epipolar(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> Floats:
        """float64[4, n]: x_left, y_left, x_right, y_right in px."""

    def epipolar_to_ground(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees where the left image's ray meets a height."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Directions of the rays to both cameras, and the size of the surface's cells.

    ``track`` float64[2, 2, 3]: (view, lon or lat, coefficients of 1, x, y): degrees that a ray to
    the left (0) or right (1) camera moves over the ground per metre of height, as a linear function
    of the left epipolar pixel. ``cell``: (lon, lat) size of a cell in lattice steps.
    ``px_per_m``: disparity per metre of height in the scene's middle.
    """

    track: Floats
    cell: tuple[int, int]
    px_per_m: float

    @classmethod
    def of(cls, model: ViewGeometry) -> Rays:
        """From the epipolar model alone."""
        rows, cols = model.shape
        # An odd count, so that the middle of the grid is among the places.
        y, x = (
            c.reshape(-1)
            for c in np.meshgrid(
                np.linspace(0, rows - 1, 5), np.linspace(0, cols - 1, 5), indexing="ij"
            )
        )
        low = np.full(x.size, float(model.reference_height))
        rise = 50.0  # m
        lon, lat = model.epipolar_to_ground(x, y, low)
        base = model.ground_to_epipolar(lon, lat, low)
        x_high = x.copy()
        left = np.stack(model.epipolar_to_ground(x, y, low + rise))
        right = left
        disparity = np.zeros(x.size)
        for step in range(4):  # x_left of the point of the right ray at the greater height
            right = np.stack(model.epipolar_to_ground(x_high, y, low + rise))
            there = model.ground_to_epipolar(*right, low + rise)
            if step == 0:
                disparity = there[0] - there[2] - (base[0] - base[2])
            x_high += base[2] - there[2]
        design = np.stack([np.ones(x.size), x, y], axis=1)
        seen = np.isfinite(lon) & np.isfinite(left).all(0) & np.isfinite(right).all(0)
        track = np.empty((2, 2, 3))
        for view, end in enumerate((left, right)):
            for axis, start in enumerate((lon, lat)):
                values = (end[axis] - start)[seen] / rise
                track[view, axis] = np.linalg.lstsq(design[seen], values, rcond=None)[0]
        track = np.round(track, 15)  # degrees: drops what depends on the linear algebra library
        # Square cells on the ground, of the area of a left pixel.
        middle = (
            np.array([cols / 2, cols / 2 + 1, cols / 2]),
            np.array([rows / 2] * 2 + [rows / 2 + 1]),
        )
        lon3, lat3 = model.epipolar_to_ground(*middle, np.full(3, float(model.reference_height)))
        shrink = np.cos(np.radians(lat3[0]))
        area = abs(
            (lon3[1] - lon3[0]) * (lat3[2] - lat3[0]) - (lon3[2] - lon3[0]) * (lat3[1] - lat3[0])
        )  # degrees²
        side = GROUND_CELL_PX * np.sqrt(area * shrink) / LATTICE_DEG  # steps of latitude
        cell = (max(round(side / shrink), 1), max(round(side), 1))
        return cls(track, cell, float(np.round(np.nanmedian(disparity) / rise, 9)))

    @property
    def cell_m(self) -> float:
        """Side of a cell on the ground, m."""
        return self.cell[1] * LATTICE_DEG * DEGREE_M

    @property
    def pixel_m(self) -> float:
        """Side of a pixel on the ground, m."""
        return self.cell_m / GROUND_CELL_PX

    def moves(self, cols: slice, rows: slice) -> Floats:
        """[2, 2] (lon, lat; lowest, highest) degrees per metre that any ray from a window moves."""
        corners = np.array(
            [[1.0, x, y] for x in (cols.start, cols.stop) for y in (rows.start, rows.stop)]
        )
        moves = self.track @ corners.T  # [view, axis, corner]
        low = np.minimum(moves.min(axis=(0, 2)), 0.0)
        high = np.maximum(moves.max(axis=(0, 2)), 0.0)
        return np.stack([low, high], axis=1)


@dataclass(frozen=True)
class PixelScale:
    """The scale of a pair's labels: ``px_per_m``, disparity of a metre of height; ``pixel_m``, side
    of a pixel on the ground; ``surface``."""

    px_per_m: float
    pixel_m: float
    surface: SurfaceScale

    @classmethod
    def of(cls, surface: SurfaceScale, rays: Rays) -> PixelScale:
        """From the surface, and the rays to both cameras."""
        return cls(rays.px_per_m, rays.pixel_m, surface)

    @property
    def spacing_px(self) -> float:
        """Mean spacing of points in pixels."""
        return self.surface.spacing_m / self.pixel_m


def mirrored(cols: slice, width: int) -> slice:
    """The columns of a window, as seen in the mirrored grid of ``width`` px."""
    return slice(width - cols.stop, width - cols.start)


@dataclass(frozen=True, eq=False)
class MirroredModel:
    """The epipolar model of the exchanged and mirrored pair."""

    model: EpipolarModel

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the grid."""
        return self.model.shape

    @property
    def reference_height(self) -> float:
        """Ellipsoidal m."""
        return self.model.reference_height

    def ground_to_epipolar(self, lon: ArrayLike, lat: ArrayLike, height: ArrayLike) -> Floats:
        """float64[4, n]: x, y in the mirrored right image, then in the mirrored left one, px."""
        x_left, y_left, x_right, y_right = self.model.ground_to_epipolar(lon, lat, height)
        last = self.shape[1] - 1
        return np.stack([last - x_right, y_right, last - x_left, y_left])

    def epipolar_to_ground(
        self, x: ArrayLike, y: ArrayLike, height: ArrayLike
    ) -> tuple[Floats, Floats]:
        """(lon, lat) in degrees where a ray of the mirrored right image meets a height."""
        last = self.shape[1] - 1
        col, row = self.model.epipolar_to_right(last - np.asarray(x, dtype=np.float64), y)
        return self.model.right.localize(col, row, height)


@dataclass(frozen=True, eq=False)
class MirroredImage:
    """An image [y, x] read from right to left."""

    image: Array2D

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, cols)."""
        return self.image.shape

    def __getitem__(self, key: tuple[slice, slice]) -> NDArray[np.uint16]:
        rows, cols = key
        return self.image[rows, mirrored(cols, self.shape[1])][:, ::-1]


def _mirrored_image(image: Array2D) -> Array2D:
    if isinstance(image, MaskedImage):
        return MaskedImage(MirroredImage(image.image), MirroredImage(image.mask))
    return MirroredImage(image)


@dataclass(frozen=True, eq=False)
class Pair:
    """A pair whose left image gets labels.

    ``images``: left, right, [y, x]; ``uncertainty``: what the alignment adds to that of the labels,
    on the grid of the view that gets them.
    """

    images: tuple[Array2D, Array2D]
    model: ViewGeometry
    uncertainty: LabelUncertainty

    def cols(self, cols: slice) -> slice:
        """The columns here of a window of the view's own grid."""
        return cols

    def alignment_variance(self, x: Floats, y: Floats, slope: Floats) -> Floats:
        """px² [rows, cols] at columns ``x`` and rows ``y``; see
        :class:`.label_uncertainty.LabelUncertainty`."""
        return self.uncertainty.variance(x, y, slope)

    def arrays(self, arrays: Mapping[str, NDArray]) -> dict[str, NDArray]:
        """The layers [y, x] of a window here, as they are in the view's own grid."""
        return dict(arrays)


class MirroredPair(Pair):
    """A pair exchanged and mirrored: the right image gets labels."""

    @classmethod
    def of(cls, pair: Pair) -> MirroredPair:
        """From the pair as it is."""
        left, right = pair.images
        images = _mirrored_image(right), _mirrored_image(left)
        return cls(images, MirroredModel(pair.model), pair.uncertainty)

    def cols(self, cols: slice) -> slice:
        """See :class:`Pair`."""
        return mirrored(cols, self.model.shape[1])

    def alignment_variance(self, x: Floats, y: Floats, slope: Floats) -> Floats:
        """See :class:`Pair`; slopes along x change sign with it."""
        own = np.stack([-slope[0], slope[1]])
        return self.uncertainty.variance(self.model.shape[1] - 1 - x, y, own)

    def arrays(self, arrays: Mapping[str, NDArray]) -> dict[str, NDArray]:
        """See :class:`Pair`; what the mirrored pair calls left is right in the view's grid."""
        out = {name: array[:, ::-1] for name, array in arrays.items()}
        if "status" in out:
            out["status"] = _exchanged(out["status"])
        return out


def _exchanged(status: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The status with the views in which pixels are hidden exchanged."""
    out = status.copy()
    out[status == Status.HIDDEN_IN_LEFT] = Status.HIDDEN_IN_RIGHT
    out[status == Status.HIDDEN_IN_RIGHT] = Status.HIDDEN_IN_LEFT
    return out


def seen_from(view: str, pair: Pair) -> Pair:
    """The pair in which the ``view``, left or right, is the left one."""
    return MirroredPair.of(pair) if view == "right" else pair
