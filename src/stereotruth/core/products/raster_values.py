"""What the values of a raster are: the one reader of heights, undulations, disparities, classes.

A value is that of the one band of real numbers, by its scale and offset, in the unit that its
reader states. There is none where the file's mask or alpha band hides it, where it is the declared
nodata value, or where it is not finite. Two rules find fill values that nobody has declared, and
refuse the file by the value:

Range. A value that its quantity cannot have (:class:`Quantity`).

Rim. A value that producers fill with (:data:`FILLS`, before scale and offset; or the lowest or
highest of all, farther from the next than the others reach and than :data:`FAR`) is a fill
if it is the only one, or occurs :data:`OFTEN` times as often as any other within 1 of it and its
neighbours differ from it by more than 1 and by more than nine tenths of all other neighbours do
from each other. False alarms: water that is flattened to exactly 0 inside of quays or cliffs
higher than 1 m; integer heights of a town whose streets are all at 0. A mask or alpha band that
shows such values ends the rule: it says what is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import ColorInterp, MaskFlags
from rasterio.windows import Window

from ..errors import InputError, in_number

Floats = NDArray[np.float64]

FILLS = (0, -1, -99, -999, -9999, -99999, -32767, -32768)  # and the ends of an integer type
OFTEN = 10
LEAST = 10  # cells of an extreme that is none of FILLS: fewer are blunders
FAR = 50.0  # m or px
RIMS = np.geomspace(1.0, 1e6, 121)  # bins of differences between neighbours, m or px
MOST_CELLS = 1 << 20  # that are read at once, where the file's blocks allow it


@dataclass(frozen=True)
class Quantity:
    """What values are: ``low`` to ``high`` is possible; ``what`` has them, ``remedy`` else."""

    name: str
    what: str
    low: float
    high: float
    remedy: str


HEIGHT = Quantity(
    "height on Earth",
    "surface model",
    -600.0,
    9500.0,
    "give a raster of one band of heights (gdal_translate -b N takes one out)",
)
MASK = Quantity("pixel of a mask", "mask", 0.0, np.inf, "give a mask of one band")


def is_value(raw: NDArray[Any], value: float) -> NDArray[np.bool_]:
    """Where stored numbers are a value, as precise as their type can tell it."""
    if np.dtype(raw.dtype).kind == "f":
        value = np.asarray(value, raw.dtype)
    return raw == value


def refuse_bands(dataset: Any, file: Path, quantity: Quantity) -> None:
    """Raise InputError for other than one band of real numbers beside an alpha band."""
    bands = dataset.count - (ColorInterp.alpha in dataset.colorinterp)
    if bands != 1 or np.dtype(dataset.dtypes[0]).kind not in "iuf":
        raise InputError(
            f"{in_number(dataset.count, 'band')} of {dataset.dtypes[0]} are no {quantity.what}",
            file=file,
            remedy=quantity.remedy,
        )


class Hidden:
    """What the file's own mask or alpha band hides, of an open raster; ``declared`` if it has one.

    GDAL takes alpha bands of floats for none, and a mask for what overrules the nodata value.
    """

    def __init__(self, dataset: Any) -> None:
        alpha = [i for i, c in enumerate(dataset.colorinterp, 1) if c == ColorInterp.alpha]
        self.alpha = alpha[0] if alpha else None
        self.mask = self.alpha is None and MaskFlags.per_dataset in dataset.mask_flag_enums[0]
        self.declared = self.alpha is not None or self.mask

    def read(self, dataset: Any, **how: Any) -> NDArray[np.bool_] | None:
        """bool[h, w] of a window (rasterio's ``window``, ``out_shape``); None if it has none."""
        if self.alpha is not None:
            return dataset.read(self.alpha, **how) == 0
        return dataset.read_masks(1, **how) == 0 if self.mask else None


class Values:
    """The values of an open raster. ``unit``: of what the band counts in, in m or px.

    Raises InputError: see :func:`refuse_bands`; and, as it is read, the range rule's.
    """

    def __init__(self, dataset: Any, file: Path, quantity: Quantity, unit: float = 1.0) -> None:
        refuse_bands(dataset, file, quantity)
        self.dataset, self.file, self.quantity, self.unit = dataset, file, quantity, unit
        self.hidden = Hidden(dataset)
        self.scale, self.offset = dataset.scales[0], dataset.offsets[0]

    def raw(self, **how: Any) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Stored values [h, w] of a window, and where there is one."""
        raw = self.dataset.read(1, **how)
        there = np.isfinite(raw)
        if self.dataset.nodata is not None:
            there &= ~is_value(raw, self.dataset.nodata)
        if (hidden := self.hidden.read(self.dataset, **how)) is not None:
            there &= ~hidden
        return raw, there

    def read(self, **how: Any) -> Floats:
        """Values [h, w] of a window in units of the band; NaN where there is none."""
        return self.of(*self.raw(**how))

    def of(self, raw: NDArray[Any], there: NDArray[np.bool_]) -> Floats:
        """Values of what :meth:`raw` returns."""
        found = np.where(there, raw * float(self.scale) + self.offset, np.nan)
        low, high = self.quantity.low / self.unit, self.quantity.high / self.unit
        with np.errstate(invalid="ignore"):
            wrong = (found < low) | (found > high)
        if wrong.any():
            self.refuse(raw[wrong][0], int(wrong.sum()), f"which is no {self.quantity.name}")
        return found

    def refuse(self, value: float, cells: int, why: str) -> None:
        """Raise InputError for a fill value."""
        nodata = self.dataset.nodata
        tagged = "no nodata value" if nodata is None else f"nodata {nodata:g}"
        raise InputError(
            f"{in_number(cells, 'cell')} of {float(value):g}, {why}; the file declares {tagged}",
            file=self.file,
            remedy=f"declare it as nodata (gdal_edit.py -a_nodata {float(value):g}), or correct "
            "the band's scale; if it is a value, give the file a mask that shows it",
        )

    def windows(self) -> Iterator[Window]:
        """The blocks of the file, row by row; several of them where they are as wide as it is."""
        (rows, cols), (height, width) = self.dataset.block_shapes[0], self.dataset.shape
        if cols >= width:
            rows *= max(1, MOST_CELLS // (rows * width))
        for row in range(0, height, rows):
            for col in range(0, width, cols):
                yield Window(col, row, min(cols, width - col), min(rows, height - row))

    def refuse_fills(self) -> None:
        """Read all, and raise InputError by one of the rules."""
        tally = Fills(self)
        for window in self.windows():
            tally.add(*self.raw(window=window))
        tally.refuse()


@dataclass
class _Value:
    """A value that may be a fill: cells, most cells of another within 1, rims in RIMS' bins."""

    cells: int = 0
    others: int = 0
    rims: NDArray[np.int64] = field(default_factory=lambda: np.zeros(RIMS.size + 1, np.int64))


class Fills:
    """The rim rule, of windows that are added one after the other.

    ``may_be_constant``: one value everywhere is no fill, as of a grid that somebody has made of 0.
    """

    def __init__(self, values: Values, *, may_be_constant: bool = False) -> None:
        self.values, self.may_be_constant = values, may_be_constant
        self.cells = 0
        dtype = np.dtype(values.dataset.dtypes[0])
        ends = (np.iinfo(dtype).min, np.iinfo(dtype).max) if dtype.kind in "iu" else ()
        self.fills = frozenset(map(float, (*FILLS, *ends)))
        self.found: dict[float, _Value] = {}
        self.rims = np.zeros(RIMS.size + 1, np.int64)  # of all others, in windows that have one
        # (value, cells) of the two lowest and of the two highest; stored values
        self.ends: tuple[dict[float, int], dict[float, int]] = {}, {}

    def add(self, raw: NDArray[Any], there: NDArray[np.bool_]) -> Floats:
        """Take in a window, see :meth:`Values.raw`; returns its values."""
        values = self.values.of(raw, there)
        if self.values.hidden.declared or not there.any():
            return values
        self.cells += int(there.sum())
        known = raw[there]
        here = []
        for end, pick in zip(self.ends, (np.min, np.max)):
            first = pick(known)
            end[float(first)] = end.get(float(first), 0) + int((known == first).sum())
            if (rest := known[known != first]).size:
                second = float(pick(rest))
                end[second] = end.get(second, 0) + int((rest == second).sum())
            here += [first]
            for value in sorted(end, reverse=pick is np.max)[2:]:
                del end[value]
        fills = {float(v) for v in here} | {v for v in self.fills if np.any(known == v)}
        metres = values * self.values.unit
        for value in fills:
            self._count(self.found.setdefault(value, _Value()), value, raw, there, metres)
        if fills & self.fills or any(self.found[v].cells >= LEAST for v in fills):
            plain = np.where(np.isin(raw, list(fills)), np.nan, metres)
            for axis in (0, 1):
                self.rims += _binned(np.abs(np.diff(plain, axis=axis)))
        return values

    def _count(
        self,
        found: _Value,
        value: float,
        raw: NDArray[Any],
        there: NDArray[np.bool_],
        metres: Floats,
    ) -> None:
        on = there & (raw == value)
        found.cells += int(on.sum())
        level = metres[on][0]
        with np.errstate(invalid="ignore"):
            near = raw[there & ~on & (np.abs(metres - level) <= 1.0)]
        if near.size:
            found.others += int(np.unique(near, return_counts=True)[1].max())
        for axis in (0, 1):
            first, second = (np.take(on, range(k, on.shape[axis] - 1 + k), axis) for k in (0, 1))
            step = np.abs(np.diff(metres, axis=axis))
            found.rims += _binned(step[first != second])

    def refuse(self) -> None:
        """Raise InputError if a value is a fill."""
        for value, found in sorted(self.found.items()):
            if self._is_fill(value, found):
                every = found.cells == self.cells
                why = "and no other value" if every else "which stand apart from all around"
                self.values.refuse(value, found.cells, why)

    def _is_fill(self, value: float, found: _Value) -> bool:
        if value in self.fills and found.cells == self.cells > 1:
            return not self.may_be_constant
        if not (value in self.fills or self._stands_apart(value, found)):
            return False
        if found.cells < OFTEN * found.others or not found.rims.sum():
            return False
        middle = int(np.searchsorted(np.cumsum(found.rims), found.rims.sum() / 2))
        steeper = self.rims[middle:].sum() / max(self.rims.sum(), 1)
        return middle > 0 and steeper < 0.1

    def _stands_apart(self, value: float, found: _Value) -> bool:
        """Whether it is the lowest or highest of all, far from the next."""
        lowest, highest = (sorted(end, reverse=bool(k)) for k, end in enumerate(self.ends))
        step = abs(self.values.scale) * self.values.unit
        for near, far in ((lowest, highest), (highest, lowest)):
            if found.cells >= LEAST and len(near) == 2 and value == near[0]:
                gap, rest = abs(near[1] - near[0]) * step, abs(far[0] - near[1]) * step
                return gap > max(rest, FAR)
        return False


def _binned(steps: NDArray[np.floating]) -> NDArray[np.int64]:
    steps = steps[np.isfinite(steps)]
    return np.bincount(np.searchsorted(RIMS, steps.ravel()), minlength=RIMS.size + 1)
