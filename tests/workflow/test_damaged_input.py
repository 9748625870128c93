"""Mutants of good files of every format."""

from __future__ import annotations

import pytest

from stereotruth.align.align import align
from stereotruth.align.figures import draw_residuals

from ..synthetic.damage_rounds import REST, rounds
from ..synthetic.damaged_cases import synthetic_cases


@pytest.mark.slow
def test_mutants_are_refused_or_right_or_cannot_be_told(tmp_path) -> None:
    """The table of docs/damaged_input.md, with a seed of its own."""
    cases = synthetic_cases(tmp_path / "good")
    outcomes = list(rounds(cases, 200, 20260, tmp_path))
    assert [o for o in outcomes if o.came in REST] == []
    assert max(o.seconds for o in outcomes) < 30
    assert {"refused", "right", "cannot be told"} <= {o.came for o in outcomes}


def test_ids_with_signs_of_formulas_do_not_break_the_figure(tmp_path) -> None:
    cases = synthetic_cases(tmp_path / "good")
    gcps = next(case.file for case in cases if case.format == "GCP CSV")
    text = gcps.read_text().replace("G01,", r"$\frac$,").replace("G02,", "$^,")
    (tmp_path / "gcps.csv").write_text(text)
    found = align(gcps.with_name("left.tif"), gcps.with_name("right.tif"), tmp_path / "gcps.csv")
    draw_residuals(found, tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 10_000
