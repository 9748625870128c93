"""Tiles against their images: planted errors are flagged."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stereotruth.core.config.configuration import Limits
from stereotruth.core.errors import InputError
from stereotruth.tiles import label_doubts
from stereotruth.tiles.manifest import tells_of_change
from stereotruth.tiles.tile_checks import misfit_lines, reach_of, summary_lines
from stereotruth.tiles.verify import defects

from ...synthetic.tiled_scene import (
    NO_LIMITS,
    alignment_notes,
    make_scene,
    rough,
    rows_of,
    run,
)

SIZE = 96
LIMITS = Limits(min_warp_correlation=0.9)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Exported once each: a clean scene, labels 1 px off, right rows 1.5 px off."""
    found = {}
    for name, planted in (
        ("clean", {}),
        ("labels", {"label_offset": 1.0}),
        ("rows", {"row_shift": 1.5}),
    ):
        folder = tmp_path_factory.mktemp(name)
        scene = make_scene(folder / "s1", bare_from=240, texture=rough, **planted)
        scene = scene._replace(notes=alignment_notes(0.3, 0.4))
        out, matches = folder / "Town", folder / "matches.csv"
        summary = run([scene], out, size=SIZE, quality=LIMITS, matches=matches, workers=2)
        found[name] = SimpleNamespace(scene=scene, out=out, matches=matches, summary=summary)
    return found


def labelled(folder: Path) -> list[dict[str, str]]:
    return [row for row in rows_of(folder) if row["complete"] == "yes"]


def column(folder: Path, name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in labelled(folder)])


def test_clean_tiles_pass_and_their_figures_are_true(made):
    clean = made["clean"]
    rows = labelled(clean.out)
    assert len(rows) >= 4
    assert {row["quality"] for row in rows} == {"ok"}
    assert column(clean.out, "sift_matches").min() >= 10
    assert np.abs(column(clean.out, "sift_median_error_px")).max() < 0.1
    assert np.abs(column(clean.out, "y_parallax_median_px")).max() < 0.1
    assert column(clean.out, "warp_correlation").min() > 0.99
    quality = clean.summary["quality"]
    assert quality["flagged_tiles"] == {}
    assert quality["scenes"]["s1"]["quality"] == "ok"
    assert quality["scenes"]["s1"]["gcp_rms_px"] == 0.4
    assert any("within the limits" in line for line in summary_lines(clean.summary, "out"))
    assert {row["quality"] for row in rows_of(clean.out) if row["complete"] == "no"} == {""}
    assert defects(clean.out) == []


def test_labels_that_are_off_are_flagged(made):
    wrong = made["labels"]
    assert column(wrong.out, "sift_median_error_px") == pytest.approx(-1.0, abs=0.1)
    assert all("max_sift_error_px" in row["quality"] for row in labelled(wrong.out))
    assert not any("max_y_parallax_px" in row["quality"] for row in labelled(wrong.out))
    assert "max_sift_error_px" in wrong.summary["quality"]["scenes"]["s1"]["quality"]
    assert any("TN_0 (max_sift_error_px" in line for line in summary_lines(wrong.summary, "out"))


@pytest.mark.parametrize("planted", [0.0, 0.15])
def test_a_small_bias_is_a_doubt_that_names_its_amount(tmp_path, monkeypatch, caplog, planted):
    monkeypatch.setattr(label_doubts, "CELL_PX", 48)  # a scene so small has few of the usual size
    scene = make_scene(tmp_path / "s1", texture=rough, label_offset=-planted)
    summary = run([scene], tmp_path / "Town", size=SIZE, quality=LIMITS)
    lines, quality = summary_lines(summary, "out"), summary["quality"]
    ground = quality["surfaces"]["s1"]["open_ground"]
    assert ground["bias_px"] == pytest.approx(planted, abs=0.03)
    assert ground["standard_error_px"] < 0.03
    told = [row["doubt"] for row in labelled(tmp_path / "Town")]
    assert column(tmp_path / "Town", "sift_median_error_px").max() < 0.3  # no limit in px is missed
    assert any("All labelled pairs are within" in line for line in lines) == (not planted)
    if not planted:
        assert (quality["doubts"], set(told)) == ({}, {""})
        return
    text = quality["doubts"]["s1"][0]["text"]
    assert text.startswith("images say +0.1")
    assert lines[-2] == f"Doubt about s1: {text}"
    assert set(told) == {text}
    assert text in caplog.text
    assert quality["scenes"]["s1"]["quality"] == "min_agreement"


def test_what_the_alignment_doubts_stands_at_the_end(made, tmp_path):
    """In the last lines, the summary and the manifest; and nothing says then that all is well."""
    notes = alignment_notes(np.nan, np.nan, warnings=["RPCs may belong to other pixels"])
    scene = made["clean"].scene._replace(notes=notes)
    summary = run([scene], tmp_path / "Town", size=SIZE, quality=LIMITS, strict=False)
    lines = summary_lines(summary, "out")
    assert lines[-2] == "Doubt about s1: RPCs may belong to other pixels"
    assert not any("within the limits" in line for line in lines)
    assert summary["quality"]["doubts"]["s1"][0]["of"] == "alignment"
    assert {row["doubt"] for row in labelled(tmp_path / "Town")} == {
        "RPCs may belong to other pixels"
    }


def test_rows_that_are_off_are_flagged(made):
    wrong = made["rows"]
    rows = labelled(wrong.out)
    assert column(wrong.out, "y_parallax_median_px") == pytest.approx(1.5, abs=0.1)
    assert all(row["quality"].startswith("max_y_parallax_px;min_sift_matches") for row in rows)


@pytest.mark.slow
def test_a_strict_run_ends_with_scene_tile_gate_value_and_limit(made, tmp_path):
    settings = {"size": SIZE, "quality": LIMITS, "strict": True}
    with pytest.raises(InputError) as caught:
        run([made["labels"].scene], tmp_path / "T", **settings)
    assert "tile TN_0" in str(caught.value)
    strict = NO_LIMITS.model_copy(update={"max_gcp_rms_px": 0.1})
    with pytest.raises(InputError, match=r"gcp_rms_px 0\.4 is above max_gcp_rms_px 0\.1"):
        run([made["clean"].scene], tmp_path / "T", size=SIZE, quality=strict, strict=True)
    assert not (tmp_path / "T").exists()


def test_what_cannot_have_changed_does_not_fit_the_images():
    row = {"tile": "A_0", "complete": "yes", "size": "10", "count_changed": "9"}
    same_days = {"lidar_days_left": "0", "lidar_days_right": "0", "diachronic": "no"}
    for more in ({}, same_days):
        assert not tells_of_change(row | more)
        (line,) = misfit_lines([row | more])
        assert "9.0 %" in line
    for more in ({"lidar_days_right": "-3"}, {"diachronic": "yes"}):
        assert tells_of_change(row | more) and misfit_lines([row | more]) == []
    assert misfit_lines([row | {"count_changed": "3"}]) == []
    assert misfit_lines([row | {"complete": "no"}]) == []


def test_a_disparity_of_zero_is_one() -> None:
    rows = [{"disparity_min_px": 0.0, "disparity_max_px": 3.5}]
    blank = {"disparity_min_px": "", "disparity_max_px": ""}
    assert reach_of([*rows, blank]) == {"min": 0.0, "max": 3.5}
    assert reach_of([blank]) == {"min": None, "max": None}
