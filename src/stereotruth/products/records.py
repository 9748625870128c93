"""Records of what products were made of; they lie in ``results``, and travel with it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from .inputs import Checksums
from .runs import KEPT

RECORDS = Path("results", ".records")


def record_file(product: str | Path) -> Path:
    """Where the record of a job lies, by the first of its products."""
    return RECORDS / "made" / f"{os.path.relpath(product).replace(os.pardir, '_')}.json"


def write_record(product: str | Path, record: Mapping[str, Any]) -> None:
    """Keep the record of a job, by the first of its products."""
    file = record_file(product)
    file.parent.mkdir(parents=True, exist_ok=True)
    scratch = file.with_name(f".{file.name}.{os.getpid()}")
    scratch.write_text(json.dumps(record))
    scratch.replace(file)


def read_record(product: str | Path) -> dict[str, Any]:
    """The record of a job; empty if there is none that can be read."""
    return _read(record_file(product))


def all_records() -> Iterator[dict[str, Any]]:
    """The records of all jobs that have ended well."""
    for file in sorted((RECORDS / "made").rglob("*.json")):
        if "inputs" in (record := _read(file)):
            yield record


def _read(file: Path) -> dict[str, Any]:
    try:
        return json.loads(file.read_text())
    except (OSError, json.JSONDecodeError):
        return {}


@cache
def _checksums() -> Checksums:
    return Checksums(KEPT / "checksums")


@cache
def _checksum(path: str) -> str | None:
    return _checksums().of(path)[1] if Path(path).exists() else None


def changed_inputs(record: Mapping[str, Any]) -> dict[str, str]:
    """The inputs, of those that are there, that are not what they were, and their checksums."""
    now = {path: _checksum(path) for path in record["inputs"]}
    return {path: found for path, found in now.items() if found and found != record["inputs"][path]}
