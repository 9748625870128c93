"""Whether products in object storage are still what runs have put there.

Snakemake looks at the times of objects alone: one that is deleted from a folder, or replaced by an
older one, changes nothing for it. So each run that ends keeps, beside the records in the bucket,
the size and content (ETag) of all objects of its products, and each plan holds them against the
bucket: products that differ are made again, with all that follows from them.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from .provenance import digest
from .records import all_records, mark_begun
from .remote_files import bucket

log = logging.getLogger("stereotruth")

STATES = ".stored.json"
CONTENT = ("ETag", "LastModified", "created")  # what tells contents apart, the first that there is


class StoredStates:
    """The objects of the products below ``prefix`` (``s3://bucket/folder``).

    ``copies``: folder in which the working directory calls them by their names in the bucket.
    """

    def __init__(self, prefix: str, copies: Path) -> None:
        self._copies = copies
        self._storage, self._root = bucket(prefix.rstrip("/"))
        self._file = f"{self._root}/{STATES}"

    def _key(self, product: str) -> str:
        """The name in the bucket of a product as records call it; empty if it lies elsewhere."""
        path = Path(product)
        inside = path.is_relative_to(self._copies)
        return path.relative_to(self._copies).as_posix() if inside else ""

    def _now(self, products: Iterable[str]) -> dict[str, str]:
        """A digest of each product's objects, by one listing; none for one that is not there."""
        keys = {key: product for product in products if (key := self._key(product))}
        found: dict[str, list[Any]] = {}
        for name, info in self._storage.find(self._root, detail=True).items():
            name = name.strip("/")
            content = next((str(info[key]) for key in CONTENT if info.get(key)), "")
            above = (str(part) for part in (PurePosixPath(name), *PurePosixPath(name).parents))
            if key := next((part for part in above if part in keys), ""):
                found.setdefault(keys[key], []).append([name, info.get("size"), content])
        return {product: digest({"objects": sorted(of)}) for product, of in found.items()}

    def _kept(self) -> dict[str, list[str]]:
        """Run and state of the products as they were kept; empty if nothing can be read."""
        try:
            kept = json.loads(self._storage.cat_file(self._file))
            return {str(product): list(map(str, of)) for product, of in kept.items()}
        except FileNotFoundError:
            return {}
        except (ValueError, TypeError, AttributeError):
            log.warning("%s cannot be read: objects of the bucket are not compared", self._file)
            return {}

    def keep(self, run: str) -> None:
        """At the end of a run: keep what the bucket holds of the products that it has made."""
        made = {path: of.run for of in all_records() for path in of.outputs}
        kept, now = self._kept(), self._now(made)
        states = {
            product: [made[product], state] if made[product] == run else kept[product]
            for product, state in now.items()
            if made[product] == run or product in kept
        }
        gone = {product: of for product, of in kept.items() if product not in now}
        text = json.dumps(gone | states, indent=1)
        self._storage.pipe_file(self._file, text.encode())

    def mark_changed(self) -> list[str]:
        """Before a plan: have what differs made again, as if its job had not ended; what differs.

        What a later run has made that was killed is not compared: nothing was kept of it.
        """
        kept = self._kept()
        records = [record for record in all_records() if any(map(self._key, record.outputs))]
        made = {path: record.run for record in records for path in record.outputs}
        now = self._now(made) if kept else {}
        differ = sorted(
            product
            for product, (run, state) in kept.items()
            if made.get(product) == run and now.get(product) != state
        )
        for record in records:
            if not set(differ).isdisjoint(record.outputs):
                mark_begun(next(iter(record.outputs)))
        for product in differ:
            log.warning("%s is made again: it is not what was stored", self._key(product))
        return differ
