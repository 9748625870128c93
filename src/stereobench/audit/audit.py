"""The audit of a dataset: every pair measured, all judged together, and what is written of it.

====================  =============================================================================
``pairs.csv``         a row per pair: verdict, reasons, every figure with 95 % limits
``summary.json``      the dataset as a whole: verdicts, pooled figures, shared ground, limits
``README.txt``        the same in words
``index.html``        the page: pooled figures, the worst pairs in pictures, all pairs
====================  =============================================================================
"""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stereotruth.core.config.methods import Audit
from stereotruth.core.job import progress
from stereotruth.core.products.files import atomic_file, atomic_folder, write_table
from stereotruth.core.products.making import marks, refuse_replaced
from stereotruth.core.products.provenance import digest, file_sha256
from stereotruth.core.products.rasters import read_image
from stereotruth.core.products.resumable_grids import Ledger
from stereotruth.pages.page import way
from stereotruth.tiles.manifest import SPLITS
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from .errata import write_errata
from .matches import Features, Shared, features, find_shared
from .page import write_audit
from .pair import measure
from .verdicts import FAULT, NOTE, Audited, Finding, judge, readme, summarise, table_rows

log = logging.getLogger("stereotruth")


def audit(
    dataset: StereoDataset,
    out: str | Path,
    settings: Audit,
    *,
    work: str | Path,
    workers: int = 1,
    code: str = "",
    index: str | Path | None = None,
    delta: str | Path | None = None,
) -> dict[str, Any]:
    """Audit all pairs of a dataset into the folder ``out``; returns the summary.

    ``work``: what was measured of each pair stays there, with a record of the files that it was
    measured from and of the ``code``, for runs after a kill, with other limits or with more pairs;
    ``index``: the page of all pages, for a link; ``delta``: a folder for the errata of its labels
    (:mod:`.errata`), if they are wanted.

    Raises InputError if the dataset has no pairs or a file cannot be read.
    """
    out, work = Path(out), Path(work)
    pairs = dataset.pairs()
    measured = _measure_all(dataset, pairs, work, workers, code)
    log.info("looking for shared ground")
    shared = find_shared([_load_features(work / f"{pair.name}.npz") for pair in pairs])
    common = _sharing(pairs, measured, shared)
    audited = [
        Audited(pair, figures, [*_changed(pair), *judge(figures, settings, len(pairs)), *common[k]])
        for k, (pair, figures) in enumerate(zip(pairs, measured))
    ]
    summary = summarise(dataset, audited, shared, settings)
    text = json.dumps(summary, indent=2) + "\n"
    with atomic_folder(out) as scratch:
        write_table(scratch / "pairs.csv", table_rows(audited))
        (scratch / "summary.json").write_text(text, encoding="utf-8")
        (scratch / "README.txt").write_text(readme(summary), encoding="utf-8")
        page, to_index = scratch / "index.html", way(out / "index.html", index)
        write_audit(page, dataset, audited, summary, settings, index=to_index)
    if delta is not None:
        write_errata(delta, dataset, audited, settings)
    for line in summary["statements"]:
        log.info("%s", line)
    return summary


def _measure_all(
    dataset: StereoDataset, pairs: Sequence[Pair], work: Path, workers: int, code: str
) -> list[dict[str, Any]]:
    """Figures of all pairs; their features lie in the work folder."""
    ledger = Ledger(work / "done")
    work.mkdir(parents=True, exist_ok=True)
    ledger.keep_only({pair.name for pair in pairs})
    settings = {
        "range": list(dataset.disparity_range),
        "nodata": repr(dataset.nodata),
        "code": code,
    }

    def one(pair: Pair) -> dict[str, Any]:
        files = [file for file in (pair.left, pair.right, pair.disparity) if file is not None]
        before = marks(files)
        key = digest(settings | {"files": [file_sha256(file) for file in files]})
        products = {"features": work / f"{pair.name}.npz"}
        piece = ledger.find(pair.name, key, products)
        if piece is None:
            found = features(read_image(pair.left))
            with atomic_file(products["features"]) as scratch:
                np.savez(scratch, **asdict(found))
            figures = measure(dataset, pair)
            refuse_replaced(before)
            piece = ledger.put(pair.name, key, products, figures)
        return piece.result

    with ThreadPoolExecutor(workers) as pool:
        done = pool.map(one, pairs)
        return list(progress(done, len(pairs), f"{dataset.name}: pairs measured"))


def _changed(pair: Pair) -> Iterator[Finding]:
    """Files of a pair that are not those which the manifest or the seal has the checksums of."""
    for error in pair.changed():
        yield Finding("files", FAULT, f"{Path(str(error.file)).name} {error.problem}")


def _load_features(path: Path) -> Features:
    with np.load(path) as stored:
        return Features(stored["place"], stored["vector"], tuple(int(n) for n in stored["shape"]))


def _sharing(
    pairs: Sequence[Pair], measured: Sequence[Mapping[str, Any]], shared: Sequence[Shared]
) -> dict[int, list[Finding]]:
    """Findings by the number of a pair: ground that it shares with others."""
    found: dict[int, list[Finding]] = defaultdict(list)
    for common in shared:
        for me, other in ((common.first, common.second), (common.second, common.first)):
            a, b = pairs[me], pairs[other]
            same = [x for x in measured[me]["hashes"][:2] if x in measured[other]["hashes"][:2]]
            across = a.split != b.split and {a.split, b.split} <= set(SPLITS)
            kind = "the same image as" if same else f"{100 * common.share:.0f} % of the ground of"
            text = f"{kind} {b.name} of split {b.split} ({common.matches} matches)"
            found[me].append(Finding("shared", FAULT if across or same else NOTE, text))
    return found
