"""Labels that are published as checksums first, and opened later: a challenge without a server.

A sealed copy of a dataset has all images, the labels of its other splits, and ``seal.json``: the
SHA-256 of each file that is held back, by its path. These are the labels and layers of a split and
the manifest that tells of them (the copy's manifest has the names and windows of these tiles only).
The seal's id is the checksum of that list: who publishes it cannot change a label afterwards. The
dataset itself is what opens the copy.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..core.errors import InputError, in_number
from ..core.products.files import (
    atomic_folder,
    copy,
    path_below,
    read_record,
    refuse_others,
    write_sealed,
    write_table,
)
from ..core.products.provenance import file_sha256
from .manifest import KINDS, PATHS, SUM, column, read_manifest, refuse_changed

FILE = "seal.json"
MANIFEST = "manifest.csv"
TOLD = (  # of a tile whose labels are sealed
    *("tile", "number", "city", "scene", "row0", "col0", "size", "right_offset_px", "complete"),
    *("split", *PATHS, *(f"{kind}{SUM}" for kind in PATHS)),
)
README = "README.txt"


@dataclass(frozen=True)
class Seal:
    """What is held back of a split: label files by pair, checksums of all files by path."""

    split: str
    pairs: Mapping[str, str]
    files: Mapping[str, str]

    @property
    def id(self) -> str:
        """64 hexadecimal digits, which another label would change."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()

    @classmethod
    def of(cls, root: str | Path) -> Seal | None:
        """That of a dataset's folder; None of one that has never been sealed.

        Raises InputError if it is damaged, or its id is not that of its list.
        """
        file = Path(root) / FILE
        if not file.is_file():
            return None

        def make(values: Mapping[str, Any]) -> Seal:
            seal = cls(values["split"], values["pairs"], values["files"])
            for name in seal.files:
                path_below(name, "the name of a sealed file,", file)
            if seal.id != values["id"] or not set(seal.pairs.values()) <= set(seal.files):
                raise ValueError("its id is not that of its list")
            return seal

        return read_record(file, make, what="seal", stage="sealing")


def seal_dataset(root: str | Path, pairs: Iterable[Any], split: str, to: str | Path) -> str:
    """Write a copy of a dataset without the labels of a split; what to say of it.

    ``pairs``: all of the dataset (:class:`.stereo_dataset.Pair`); ``to``: a new folder. Raises
    InputError if a file is not the one that the dataset's manifest has the checksum of.
    """
    root, to = Path(root), Path(to)
    refuse_others(to, source=root)
    if Seal.of(root) is not None:
        raise InputError("sealed before", file=root / FILE, remedy="seal what it was made of")
    kept, held, labels = [], [], {}
    for pair in pairs:
        layers = [root / pair.row[column(k)] for k in KINDS if pair.row.get(column(k))]
        kept += [pair.left, pair.right]
        (held if pair.split == split else kept).extend(filter(None, [pair.disparity, *layers]))
        if pair.split == split and pair.disparity:
            labels[pair.name] = pair.disparity.relative_to(root).as_posix()
    if not labels:
        raise InputError(
            f"no labelled pair of split {split!r}", file=root, remedy="name another split"
        )
    if has_manifest := (root / MANIFEST).is_file():
        refuse_changed(root)
    with atomic_folder(to) as scratch:
        for file in (*kept, *(filter(Path.is_file, [root / README]))):
            copy(file, scratch / file.relative_to(root))
        if has_manifest:
            rows = read_manifest(root)
            told = [
                {key: v if row["split"] != split or key in TOLD else "" for key, v in row.items()}
                for row in rows
            ]
            write_table(scratch / MANIFEST, told)
            held.append(root / MANIFEST)
        sums = {file.relative_to(root).as_posix(): file_sha256(file) for file in sorted(held)}
        seal = Seal(split, labels, sums)
        write_sealed({"id": seal.id, **asdict(seal)}, scratch / FILE)
    return (
        f"{to}: {in_number(len(sums), 'file')} of split {split} sealed. Publish the id with the "
        f"folder: {seal.id}"
    )


def is_shut(root: str | Path) -> bool:
    """Whether a dataset has labels that are sealed as yet."""
    seal = Seal.of(root)
    return seal is not None and not all((Path(root) / name).is_file() for name in seal.files)


def open_seal(root: str | Path, labels: str | Path) -> str:
    """Take the sealed files out of the dataset ``labels`` into the copy; what to say of it.

    Raises InputError that names the first file which is missing or is not the one that was sealed;
    then nothing is opened.
    """
    root, labels = Path(root), Path(labels)
    seal = Seal.of(root)
    if seal is None:
        raise InputError("no seal", file=root / FILE, remedy="name the sealed copy of a dataset")
    for name, sha256 in seal.files.items():
        if not (labels / name).is_file() or file_sha256(labels / name) != sha256:
            raise InputError(
                f"is not what seal {seal.id[:8]} was made of",
                file=labels / name,
                remedy="give the dataset that was sealed",
            )
    for name in sorted(seal.files, key=lambda name: name == MANIFEST):  # which names the others
        copy(labels / name, root / name)
    return f"{root}: {in_number(len(seal.files), 'file')} opened, all as seal {seal.id} has them"
