"""Records of products in object storage, kept beside them: any machine then plans what is left.

Products that go to a bucket (profiles/s3) leave nothing on the machine that made them, so the
records of what they were made of (:mod:`.records`) and Snakemake's marks of products in the making
go to the bucket, too, under ``.records`` of the prefix. A mark is there before the first byte of a
product is, and goes after its record has come: whenever a run is killed, the next one, from
anywhere, makes again what was not whole.
"""

from __future__ import annotations

import base64
import binascii
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from .records import PLACES
from .remote_files import bucket

log = logging.getLogger("stereotruth")


def _named(file: PurePosixPath) -> str:
    """The product that a record of Snakemake's is of: its name in base 64, cut into folders."""
    try:
        return base64.urlsafe_b64decode("".join(p.lstrip("@") for p in file.parts)).decode()
    except (binascii.Error, UnicodeDecodeError):
        return ""


class RecordMirror:
    """What is recorded of the products below ``prefix``, here and in the bucket.

    ``prefix``: URL (``s3://bucket/folder``); ``copies``: folder in which the working directory
    holds copies of them for a while.
    """

    def __init__(self, prefix: str, copies: Path, snakemake: Path = Path(".snakemake")) -> None:
        self.prefix = prefix.rstrip("/")
        self._copies = copies
        self._folders = {
            "made": PLACES[0] / copies,
            "incomplete": snakemake / "incomplete",
        }
        self._storage, root = bucket(f"{self.prefix}/.records")
        self._root = PurePosixPath(root)
        self._known: dict[str, bytes] = {}  # what is in the bucket, by name

    def _here(self) -> Iterator[tuple[str, Path]]:
        for kind, folder in self._folders.items():
            for file in sorted(folder.rglob("*")):
                inside = PurePosixPath(file.relative_to(folder).as_posix())
                ours = kind == "made" or _named(inside).startswith(f"{self.prefix}/")
                if ours and file.is_file() and not file.name.startswith("."):
                    yield f"{kind}/{inside}", file

    def _place(self, name: str) -> Path:
        kind, _, inside = name.partition("/")
        return self._folders[kind] / inside

    def pull(self) -> None:
        """Make the records here those of the bucket."""
        shutil.rmtree(PLACES[1] / self._copies, ignore_errors=True)  # one place holds them
        found = self._storage.find(str(self._root))
        held = self._storage.cat(found) if found else {}
        self._known = {
            str(PurePosixPath(path).relative_to(self._root)): content
            for path, content in held.items()
        }
        for name, file in list(self._here()):
            if name not in self._known:
                file.unlink()
        for name, content in self._known.items():
            place = self._place(name)
            if not place.is_file() or place.read_bytes() != content:
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)

    def push(self) -> None:
        """Make those of the bucket the records here: first what is new, then what is gone."""
        here = {name: file.read_bytes() for name, file in self._here()}
        new = {name: data for name, data in here.items() if self._known.get(name) != data}
        if new:
            self._storage.pipe({str(self._root / name): data for name, data in new.items()})
        if gone := sorted(set(self._known) - set(here)):
            self._storage.rm([str(self._root / name) for name in gone])
        self._known = here
