"""All methods of a dataset: tables, figure 10 and the page, from their scores and predictions."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stereotruth.core.products.rasters import read_image
from stereotruth.tiles.stereo_dataset import StereoDataset

from .confidence_table import confidence_table
from .differences import differences
from .page import write_benchmark
from .panels import Column, draw_columns
from .prediction_files import read_prediction
from .protocols import one_id
from .published_rows import beside_published
from .score_method import choose
from .scores import Scorer
from .tables import make_tables, read_scores, write_tables

log = logging.getLogger("stereotruth")


COLUMNS = 6  # pairs of figure 10


def compare(
    dataset: StereoDataset,
    split: str | None,
    scores: Sequence[str | Path],
    predictions: Sequence[str | Path],
    out: str | Path,
    *,
    seed: int,
    index: str | Path | None = None,
) -> None:
    """Write tables, ``figure10.png`` and ``index.html`` to ``out``.

    ``scores``, ``predictions``: folders of the methods, in one order; ``seed``: of the samples that
    intervals of differences come from; ``index``: the page of all pages, for a link.

    Raises InputError if a method has no scores, or two have theirs by different protocols.
    """
    out = Path(out)
    methods = read_scores(scores)
    trained = [pair.city for pair in dataset.pairs() if pair.split == "train"]
    tables = make_tables(methods, trained, beside_paper=dataset.layout != "us3d")
    tables.append(differences(methods, scores, seed=seed))
    tables.append(confidence_table(methods))
    tables.append(beside_published(methods))
    protocol = one_id(methods)
    tables = [table.by(protocol) for table in tables]
    write_tables(tables, out)
    scorer = Scorer(dataset.disparity_range)
    columns = []
    for pair in choose(dataset.pairs(split, labelled=True), COLUMNS):
        truth = dataset.labels(pair)
        columns.append(
            Column(
                pair.name if pair.city in pair.name else f"{pair.city}, {pair.name}",
                read_image(pair.left),
                read_image(pair.right),
                np.where(scorer.counted(truth), truth, np.float32(np.nan)),
                {
                    of["label"]: read_prediction(folder, pair)
                    for of, folder in zip(methods, predictions)
                },
            )
        )
    draw_columns(out / "figure10.png", columns)
    figure = out / "figure10.png"
    write_benchmark(
        out / "index.html",
        dataset.name,
        methods,
        tables,
        scores,
        figure,
        pairs=columns,
        index=index,
    )
    for line in tables[0].markdown().splitlines():
        if line.startswith("|"):
            log.info(line)
