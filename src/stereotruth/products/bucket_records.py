"""Records of products in object storage, and whether its objects are still what runs put there.

Products that go to a bucket (profiles/s3) leave nothing on the machine that made them. So records
and marks of jobs (:mod:`.records`) are kept beside the products, under ``.records`` of the prefix:
any machine then plans what is left. A mark is there before the first byte of a product is, and goes
after its record has come: whenever a run is killed, the next one, from anywhere, makes again what
was not whole.

Snakemake looks at the times of objects alone: one that is deleted from a folder, or replaced by an
older one, changes nothing for it. So each run that ends keeps the size and content (ETag) of all
objects of its products, and each plan holds them against the bucket.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

from .provenance import digest
from .records import BEGUN, PLACES, all_records, mark_begun
from .remote_files import answering, bucket

log = logging.getLogger("stereotruth")

STATES = ".stored.json"
CONTENT = ("ETag", "LastModified", "created")  # what tells contents apart, the first that there is


class BucketRecords:
    """What is recorded of the products below ``prefix`` (``s3://bucket/folder``).

    ``copies``: folder in which the working directory calls them by their names in the bucket.
    """

    def __init__(self, prefix: str, copies: Path) -> None:
        self._copies = copies
        self._prefix = prefix
        self._storage, self._root = bucket(prefix.rstrip("/"))
        self._records = PurePosixPath(self._root, ".records", "made")
        self._states = f"{self._root}/{STATES}"
        self._known: dict[str, bytes] = {}  # records and marks in the bucket, by name

    def _here(self) -> Iterator[tuple[str, Path]]:
        folder = PLACES[0] / self._copies
        for file in sorted(folder.rglob("*")):
            if file.suffix in (".json", BEGUN) and not file.name.startswith("."):
                yield file.relative_to(folder).as_posix(), file

    def pull(self) -> None:
        """Make records and marks here those of the bucket.

        Raises InputError without credentials, and if nobody answers.
        """
        shutil.rmtree(PLACES[1] / self._copies, ignore_errors=True)  # one place holds them
        with answering(self._prefix):
            found = self._storage.find(str(self._records))
            held = self._storage.cat(found) if found else {}
        self._known = {
            str(PurePosixPath(path).relative_to(self._records)): content
            for path, content in held.items()
        }
        for name, file in list(self._here()):
            if name not in self._known:
                file.unlink()
        for name, content in self._known.items():
            place = PLACES[0] / self._copies / name
            if not place.is_file() or place.read_bytes() != content:
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)

    def push(self) -> None:
        """Make those of the bucket the ones here: first what is new, then what is gone."""
        here = {name: file.read_bytes() for name, file in self._here()}
        new = {name: data for name, data in here.items() if self._known.get(name) != data}
        if new:
            self._storage.pipe({str(self._records / name): data for name, data in new.items()})
        if gone := sorted(set(self._known) - set(here)):
            self._storage.rm([str(self._records / name) for name in gone])
        self._known = here

    def _key(self, product: str) -> str:
        """The name in the bucket of a product as records call it; empty if it lies elsewhere."""
        path = Path(product)
        inside = path.is_relative_to(self._copies)
        return path.relative_to(self._copies).as_posix() if inside else ""

    def _states_now(self, products: Iterable[str]) -> dict[str, str]:
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

    def _states_kept(self) -> dict[str, list[str]]:
        """Run and state of the products as they were kept; empty if nothing can be read."""
        try:
            kept = json.loads(self._storage.cat_file(self._states))
            return {str(product): list(map(str, of)) for product, of in kept.items()}
        except FileNotFoundError:
            return {}
        except (ValueError, TypeError, AttributeError):
            log.warning("%s cannot be read: objects of the bucket are not compared", self._states)
            return {}

    def keep_states(self, run: str) -> None:
        """At the end of a run: keep what the bucket holds of the products that it has made."""
        made = [path for record in all_records() if record.run == run for path in record.outputs]
        states = {product: [run, state] for product, state in self._states_now(made).items()}
        text = json.dumps(self._states_kept() | states, indent=1)
        self._storage.pipe_file(self._states, text.encode())

    def mark_changed(self) -> list[str]:
        """Before a plan: have what differs made again, as if its job had not ended; what differs.

        What a later run has made that was killed is not compared: nothing was kept of it.
        """
        kept = self._states_kept()
        records = [record for record in all_records() if any(map(self._key, record.outputs))]
        made = {path: record.run for record in records for path in record.outputs}
        now = self._states_now(made) if kept else {}
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
