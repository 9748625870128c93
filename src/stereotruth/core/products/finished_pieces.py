"""What has been done, and what of it still holds: a record for each piece of a long work.

A record is written after the files of its piece, in one step: ``key``, a digest of all that the
files follow from; their SHA-256; what their maker returned. A piece is there if its record has the
key that is wanted and its files are as recorded, whatever has happened in between.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .files import atomic_file
from .provenance import file_sha256

FORMAT = 1  # of records


@dataclass(frozen=True)
class Piece:
    """A piece that is there: ``sha256`` of those of its files that exist, ``result`` as given."""

    sha256: Mapping[str, str]
    result: Any


@dataclass(frozen=True)
class Ledger:
    """The records in a folder, one file each. Names of pieces are file names."""

    folder: Path

    def _file(self, name: str) -> Path:
        return self.folder / f"{name}.json"

    def put(self, name: str, key: str, files: Mapping[str, Path], result: Any) -> Piece:
        """Record that a piece is done; ``result`` is JSON-ready."""
        sums = {label: file_sha256(path) for label, path in files.items() if path.exists()}
        record = {"format": FORMAT, "key": key, "sha256": sums, "result": result}
        with atomic_file(self._file(name)) as scratch:
            scratch.write_text(json.dumps(record))
        return Piece(sums, result)

    def get(self, name: str) -> Piece:
        """The record of a piece that is known to be there."""
        record = json.loads(self._file(name).read_text())
        return Piece(record["sha256"], record["result"])

    def find(self, name: str, key: str, files: Mapping[str, Path]) -> Piece | None:
        """The piece, if it is there as ``key`` wants it; else what is left of it is removed."""
        try:
            record = json.loads(self._file(name).read_text())
        except (FileNotFoundError, json.JSONDecodeError):
            record = {}
        if record.get("key") == key and record["format"] == FORMAT:
            sums = {label: file_sha256(path) for label, path in files.items() if path.exists()}
            if sums == record["sha256"]:
                return Piece(sums, record["result"])
        self._file(name).unlink(missing_ok=True)
        for path in files.values():
            path.unlink(missing_ok=True)
        return None

    def keep_only(self, names: set[str]) -> None:
        """Forget all other pieces."""
        for file in self.folder.glob("*.json"):
            if file.stem not in names:
                file.unlink()
