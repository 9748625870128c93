"""The right view as the reference, by mirroring.

A pair whose images are exchanged and mirrored along the rows is a pair like any other: with
x' = last - x, the new left image is the old right one, and d' = x'_left' - x'_right' =
x_left - x_right. So the right view's labels are those of the mirrored pair, mirrored back.

:func:`seen_from` is the one place where the views part: what works on its :class:`Pair` labels the
left image, windows go in by :meth:`Pair.cols`, and labels come out by :meth:`Pair.arrays`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..align.label_uncertainty import LabelUncertainty
from ..core.status import Status
from ..epipolar.model import EpipolarModel
from .pair_window import Array2D, MaskedImage
from .view_geometry import ViewGeometry

Floats = NDArray[np.float64]


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
        """px² [rows, cols] at columns ``x`` and rows ``y``; see :class:`LabelUncertainty`."""
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
