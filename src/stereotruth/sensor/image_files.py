"""The files beside an image that readers take into account: RPCs, masks, statistics, overviews."""

from __future__ import annotations

from collections import defaultdict
from functools import cache
from pathlib import Path

# By GDAL's names: after the whole name of the image, and after its stem.
AFTER_NAME = (".msk", ".aux.xml", ".ovr", ".msk.ovr", ".imd", ".rpb")
AFTER_STEM = ("_rpc.txt", ".rpb", ".imd", ".rpc", ".aux", ".aux.xml", ".tab", ".wld", ".rrd")
DIMAP = "rpc_", ".xml"  # RPC_*.XML, of both views of a delivery


@cache
def _names_in(folder: Path) -> dict[str, list[Path]]:
    """The files in a folder by their names in lower case; none if it cannot be listed."""
    found = defaultdict(list)
    if folder.is_dir():
        for path in sorted(folder.iterdir()):
            found[path.name.lower()].append(path)
    return found


def files_beside(image: str | Path) -> list[Path]:
    """What lies beside an image and is read with it, in any case of the letters, sorted.

    A plan asks once for each image; files that come later are seen by the next process.
    """
    image = Path(image)
    name, stem, suffix = image.name.lower(), image.stem.lower(), image.suffix.lower()
    world = {f"{stem}{suffix}w", f"{stem}.{suffix[1:2]}{suffix[-1:]}w"}
    names = {*(name + end for end in AFTER_NAME), *(stem + end for end in AFTER_STEM), *world}
    there = _names_in(image.parent)
    dimap = {n for n in there if n.startswith(DIMAP[0]) and n.endswith(DIMAP[1])}
    found = {path for other in (names | dimap) - {name} for path in there.get(other, ())}
    return sorted(path for path in found if path.is_file())
