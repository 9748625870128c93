"""What lies below a folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path

FOREIGN = (  # what other programs leave beside the files that they open; in lower case
    "*.aux.xml",  # GDAL, QGIS: statistics
    "*.ovr",  # GDAL, QGIS: pyramids
    *("*.qgs", "*.qgz", "*.qgs~", "*.qgz~", "*.qml", "*.qmd", "*.points"),  # QGIS
    *(".ds_store", "._*", "thumbs.db", "desktop.ini", ".directory"),  # file managers
)


def is_foreign(name: str) -> bool:
    """Whether a file of this name is one that another program has left."""
    return any(fnmatch(name.lower(), pattern) for pattern in FOREIGN)


def files_below(
    folder: str | Path, enter: Callable[[Path], bool] = lambda folder: True
) -> Iterator[Path]:
    """All files below a folder, by name, links followed, each folder once.

    ``enter``: which of its folders are gone into.
    """
    seen = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        state = Path(place).stat()
        if (state.st_dev, state.st_ino) in seen:  # a link to a folder above, or a second one
            folders.clear()
            continue
        seen.add((state.st_dev, state.st_ino))
        folders[:] = sorted(name for name in folders if enter(Path(place, name)))
        yield from (Path(place, name) for name in sorted(names))
