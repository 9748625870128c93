"""A built city in a file, so that jobs which look at the same one need not build it each."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from ..products.files import atomic_file
from .cities import CitySpec
from .surfaces import Surfaces


def write_surfaces(city: CitySpec, out_npz: str | Path) -> None:
    """Build a city and write its surfaces: one array per field of :class:`.surfaces.Surfaces`."""
    built = surfaces_of(city)
    with atomic_file(out_npz) as scratch, scratch.open("wb") as stream:
        np.savez(stream, **built._asdict())


def surfaces_of(city: CitySpec, built: str | Path | None = None) -> Surfaces:
    """Everything that stands in a city, ready for casting rays.

    ``built``: a file of :func:`write_surfaces`, which is read in a hundredth of the seconds that
    building takes; None builds the city. Kept for further calls of the same process.
    """
    return _surfaces_of(city, None if built is None else Path(built))


@lru_cache(maxsize=2)
def _surfaces_of(city: CitySpec, built: Path | None) -> Surfaces:
    if built is None:
        from .world import build_surfaces  # its imports take longer than reading the file

        return build_surfaces(city)
    with np.load(built) as fields:
        return Surfaces(**{
            name: fields[name] if fields[name].ndim else fields[name].item() for name in fields
        })  # fmt: skip
