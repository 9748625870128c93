"""Arrays of Keras' weight files (HDF5), read without trusting who wrote them.

HDF5 can lead elsewhere: links to other files, arrays whose bytes lie in other files or are put
together of other arrays, links in circles, sizes that no memory holds. None of these is followed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, install_extra

Arrays = list[NDArray[np.float32]]
MOST_BYTES = 2 << 30  # of all arrays of a file, as they are in memory
MOST_NAMES = 20_000  # of layers and arrays
DEEPEST = 20  # groups in each other
REMEDY = "name an .h5 file that Keras has saved (weights or model), from somebody whom you trust"


def read_weights(path: str | Path) -> list[Arrays]:
    """The weight arrays of each layer of the network that has any, in the file's order.

    Raises InputError if h5py is missing, if the file is none of Keras' weight files, or if it
    leads to other files, in a circle, or to more than MOST_BYTES.
    """
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            "h5py is needed to read Keras weights",
            file=path,
            remedy=install_extra("networks"),
        ) from error
    try:
        with h5py.File(path, "r") as file:
            top = _inside(file, "model_weights", path) if "model_weights" in file else file
            layers = [_inside(top, name, path) for name in _names(top, "layer_names", path)]
            places = [
                [_inside(layer, name, path) for name in _names(layer, "weight_names", path)]
                for layer in layers
            ]
            _refuse_large([place for of in places for place in of], path)
            return [[np.asarray(place) for place in of] for of in places if of]
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError("no such weight file", file=path, remedy=REMEDY) from None
    except (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError) as error:
        raise InputError(
            f"not a weight file of Keras ({error})", file=path, remedy=REMEDY
        ) from error


def _names(group: Any, key: str, path: str | Path) -> Iterator[str]:
    """The names that an attribute lists."""
    listed = np.atleast_1d(group.attrs[key])
    if listed.size > MOST_NAMES:
        raise InputError(f"{listed.size} names in {key}", file=path, remedy=REMEDY)
    return (name.decode() if isinstance(name, bytes) else str(name) for name in listed.ravel())


def _inside(group: Any, name: str, path: str | Path) -> Any:
    """What a group holds under a name, by hard links alone. Raises InputError for other links."""
    import h5py

    parts = [part for part in name.split("/") if part]
    if len(parts) > DEEPEST:
        raise InputError(f"{len(parts)} groups in each other", file=path, remedy=REMEDY)
    for part in parts:
        link = group.get(part, getlink=True)
        if isinstance(link, (h5py.SoftLink, h5py.ExternalLink)):
            kind = "another file" if isinstance(link, h5py.ExternalLink) else "another place"
            raise InputError(f"{name[:80]!r} is a link to {kind}", file=path, remedy=REMEDY)
        group = group[part]
    return group


def _refuse_large(places: list[Any], path: str | Path) -> None:
    """Raise InputError if arrays are not of plain numbers in this file, or too large."""
    total = 0
    for place in places:
        if place.external or place.is_virtual:
            raise InputError(
                f"{place.name[:80]!r} has its values in other files", file=path, remedy=REMEDY
            )
        if place.dtype.kind not in "fiu":
            raise InputError(f"{place.name[:80]!r} holds no numbers", file=path, remedy=REMEDY)
        total += math.prod(place.shape) * place.dtype.itemsize
    if total > MOST_BYTES or len(places) > MOST_NAMES:
        raise InputError(
            f"{len(places)} arrays of {total / 1e9:.1f} GB are no network that is known here",
            file=path,
            remedy=REMEDY,
        )
