"""Holding a folder of tiles, or the dataset, against the checksums of its manifest."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.products.files import is_foreign, read_json
from ..core.products.provenance import file_sha256, own_digest
from .manifest import FOOTPRINTS, STATUS_COLOURS_FILE, STYLE, listed_files
from .orientation import save

log = logging.getLogger("stereotruth")


# files that the manifest does not list; STYLE is the user's to change
LOOSE = (
    *("manifest.csv", "export.json", "README.txt", FOOTPRINTS, STYLE, STATUS_COLOURS_FILE),
    *("README.md", "croissant.json", "stac/collection.json", "stac/rpc/*"),
    *("satnerf/pts3d.npy", "colmap/frame.json", "colmap/sparse/0/*.txt"),
)
SUMS = {"manifest_sha256": "manifest.csv", "footprints_sha256": FOOTPRINTS}  # in export.json


def write_export(folder: Path, record: Mapping[str, Any], provenance: Mapping[str, Any]) -> None:
    """Write the ``export.json`` of a folder whose manifest and footprints are written."""
    sums = {key: file_sha256(folder / name) for key, name in SUMS.items()}
    record = {**record, **sums, "provenance": provenance}
    save(folder / "export.json", record | {"digest": own_digest(record)})


def defects(folder: str | Path) -> list[str]:
    """What differs from the manifest: ``missing``, ``changed`` or ``not in the manifest`` files.

    ``export.json`` keeps its own digest, and those of the manifest and the footprints. Works on
    ``tiles/<City>`` and on ``dataset``. Files of other programs are no defects. Raises InputError
    if there is no manifest.
    """
    folder = Path(folder)
    found = []
    listed = set()
    for name, checksum in listed_files(folder):
        listed.add(name)
        if not (folder / name).is_file():
            found.append(f"{name}: missing")
        elif file_sha256(folder / name) != checksum:
            found.append(f"{name}: changed")
    files = (p for p in folder.rglob("*") if p.is_file())
    # a workflow manager may leave a hidden time stamp of its own
    present = {
        p.relative_to(folder).as_posix()
        for p in files
        if not p.name.startswith(".") and (p.name == STYLE or not is_foreign(p.name))
    }
    found += [
        f"{name}: not in the manifest"
        for name in sorted(present - listed)
        if not any(fnmatch(name, pattern) for pattern in LOOSE)
    ]
    if (record := folder / "export.json").is_file():
        try:
            said = read_json(record)
        except InputError:
            said = {}
        if said.get("digest") != own_digest(said):
            found.append("export.json: changed")
        for key, name in SUMS.items():
            if not (folder / name).is_file():
                found.append(f"{name}: missing")
            elif file_sha256(folder / name) != said.get(key):
                found.append(f"{name}: changed")
    return found


def verify(folders: Iterable[str | Path]) -> dict[str, int]:
    """Check folders; the number of files that the manifest of each lists.

    Files of other programs are left alone. Raises InputError, after all were looked at, naming the
    files that do not agree.
    """
    counts, bad = {}, []
    for folder in map(Path, folders):
        found = defects(folder)
        bad += [f"{folder}/{line}" for line in found]
        for line in found:
            log.error("%s/%s", folder, line)
        counts[str(folder)] = count = len(listed_files(folder))
        if not found:
            log.info("%s: %d files as in the manifest", folder, count)
    if bad:
        more = f" and {len(bad) - 5} more" if len(bad) > 5 else ""
        raise InputError(
            f"{len(bad)} files differ from the manifests: {'; '.join(bad[:5])}{more}",
            remedy="delete the folder and make it again (stereotruth run tiles/<City>)",
        )
    return counts
