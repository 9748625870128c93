"""Labels of a scene that go into its tiles: those of rough surfaces only if they are sure enough.

A disparity store holds all labels. A tile's pixel whose label is left out has no disparity and the
status ``too_uncertain``, which occurs in tiles alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from ..core.status import Status


@dataclass(frozen=True, eq=False)
class SureLabels:
    """The array ``name`` of a disparity store, as the tiles have it; sliced as a Zarr array is.

    Of the labels of rough surfaces, those with an uncertainty above ``limit`` px are left out.
    """

    store: zarr.Group
    name: str
    limit: float

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, cols)."""
        return self.store[self.name].shape

    def __getitem__(self, key: Any) -> NDArray[Any]:
        values = np.array(self.store[self.name][key])
        doubtful = self.store["status"][key] == Status.LABELLED_CROWN
        if doubtful.any():
            doubtful &= ~(self.store["uncertainty"][key] <= self.limit)
            values[doubtful] = Status.TOO_UNCERTAIN if self.name == "status" else np.nan
        return values


Labels = zarr.Array | SureLabels


def tile_labels(store: zarr.Group, flags: Mapping[int, str], limit: float) -> dict[str, Labels]:
    """``disparity`` and ``status`` of a store as its tiles have them; ``flags``: names of its
    status values."""
    names = "disparity", "status"
    if Status.LABELLED_CROWN.label not in flags.values():
        return {name: store[name] for name in names}
    return {name: SureLabels(store, name, limit) for name in names}


def tile_flags(flags: Mapping[int, str]) -> dict[int, str]:
    """Names of the status values of tiles, from those of their store."""
    more = Status.LABELLED_CROWN.label in flags.values()
    added = {int(Status.TOO_UNCERTAIN): Status.TOO_UNCERTAIN.label} if more else {}
    return dict(flags) | added
