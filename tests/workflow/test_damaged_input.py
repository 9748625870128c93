"""Mutants of good files of every format."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.align.align import align
from stereotruth.align.figures import draw_residuals

from ..synthetic import damage_rounds
from ..synthetic.damage import BYTES, TEXT, damaged
from ..synthetic.damage_rounds import REST, Worker, rounds
from ..synthetic.damaged_cases import synthetic_cases
from ..synthetic.damaged_products import KINDS, product_cases


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    return synthetic_cases(tmp_path_factory.mktemp("damage") / "good")


@pytest.mark.slow
def test_mutants_are_refused_or_right_or_cannot_be_told(cases, tmp_path) -> None:
    """The table of docs/damaged_input.md, with a seed of its own."""
    outcomes = list(rounds(cases, 600, 20260, tmp_path))
    assert [o for o in outcomes if o.came in REST] == []
    assert max(o.seconds for o in outcomes) < 30
    assert max(o.mib for o in outcomes) < 2048
    assert {"refused", "right", "cannot be told"} <= {o.came for o in outcomes}


@pytest.mark.slow
def test_mutants_of_what_runs_have_made_are_refused_or_right(made, tmp_path) -> None:
    """The second table, with a seed of its own; only sheets may be what their user has meant."""
    cases = list(product_cases(made.folder))
    assert {case.format for case in cases} == set(KINDS)
    outcomes = list(rounds(cases, 20 * len(cases), 20261, tmp_path))
    assert [o for o in outcomes if o.came in REST] == []
    assert {o.format for o in outcomes if o.came == "cannot be told"} <= {"sheets"}
    assert {o.format for o in outcomes if o.came == "refused"} == set(KINDS)


@pytest.mark.slow
def test_the_harness_would_find_them(cases, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(damage_rounds, "SECONDS", 3.0)
    file = tmp_path / "good.bin"
    file.write_bytes(bytes(range(256)))
    kinds = ("abort", "hang", "memory", "traceback", "other values")
    wrong = [replace(cases[0], name=k, reader=f"misbehave: {k}", file=file) for k in kinds]
    worker = Worker(wrong, tmp_path)
    try:
        came = {kind: worker.outcome(kind, 5).came for kind in kinds}
    finally:
        worker.close()
    assert came == {k: "traceback" if k == "memory" else k for k in kinds}


def test_damage_follows_from_its_seed() -> None:
    text = b"id,lon\nA,1.5\nB,2.5\n" * 40
    for ways in (BYTES, TEXT):
        made = [damaged(text, k, ways) for k in range(300)]
        assert made == [damaged(text, k, ways) for k in range(300)]
        assert np.mean([data != text for data, _ in made]) > 0.9


def test_ids_with_signs_of_formulas_do_not_break_the_figure(cases, tmp_path) -> None:
    gcps = next(case.file for case in cases if case.format == "GCP CSV")
    text = gcps.read_text().replace("G01,", r"$\frac$,").replace("G02,", "$^,")
    (tmp_path / "gcps.csv").write_text(text)
    found = align(gcps.with_name("left.tif"), gcps.with_name("right.tif"), tmp_path / "gcps.csv")
    draw_residuals(found, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
