"""The figures on top of a city's page: those of the last lines of a run, and in metres."""

from __future__ import annotations

import re

import pytest

from stereotruth.evaluate.report.sections import headlines
from stereotruth.tiles.tile_checks import summary_lines

SCENE = {
    "gcp_rms_px": 0.3,
    "sift_matches": 1315,
    "sift_mean_error_px": 0.0274,
    "sift_mean_absolute_error_px": 0.2416,
    "sift_median_error_px": 0.014,
    "y_parallax_median_px": -0.0131,
    "y_parallax_rms_px": 0.3132,
    "warp_correlation": 0.98283,
    "quality": "ok",
}
ROW = {
    "tile": "A_0",
    "complete": "yes",
    "split": "train",
    "labelled_share": "0.829",
    "disparity_min_px": "-5.5",
    "disparity_max_px": "33.3",
    # of the tile alone: another figure than the scene's
    "sift_mean_absolute_error_px": "0.32",
    "quality": "ok",
}


def cards(scenes, height=None, rows=(ROW,), truth=()):
    found = headlines(rows, {}, {}, truth, {"quality": {"scenes": scenes}}, height)
    return {card.title: card for card in found}


def test_what_the_images_say_is_one_number_on_the_page_and_in_the_terminal():
    summary = {
        "city": "A",
        "labelled_pairs": 1,
        "unlabelled_pairs": 0,
        "size_px": 256,
        "splits": {"realised": {"train": 1}},
        "share_of_pixels": {"labelled": 0.829, "no_points": 0.171},
        "disparity_px": {"min": -5.5, "max": 33.3},
        "disparity_rounding": {"largest_px": 0.0005},
        "label_uncertainty": {},
        "quality": {"scenes": {"A-1": SCENE}, "flagged_tiles": {}, "doubts": {}},
    }
    said = " ".join(summary_lines(summary, "tiles/A")).replace("-", "−")
    found = cards({"A-1": SCENE})
    assert found["SIFT disparity − label"].value == "0.24 px"
    for title in ("SIFT disparity − label", "pixels labelled"):
        assert re.search(rf"(?<![\d.]){re.escape(found[title].value)}(?!\d)", said), title
    assert "1315 matches" in found["SIFT disparity − label"].note


def test_how_well_labels_are_known_comes_first_with_the_surfaces():
    by = {
        "all": {"uncertainty_median_px": 0.0412, "uncertainty_p95_px": 0.104},
        "open_ground": {"uncertainty_median_px": 0.03, "uncertainty_p95_px": 0.05},
    }
    truth = [{"scope": "tiles", "mean_absolute_px": "0.021"}]
    export = {"quality": {"scenes": {"A-1": SCENE}}, "label_uncertainty": by}
    known, exact, *_ = headlines([ROW], {}, {}, truth, export, 1.0)
    assert (known.title, known.value) == ("labels known to", "0.041 px")
    assert "0.1 px for 95 %" in known.note and "open ground 0.03" in known.note
    assert exact.value == "0.021 px"


LIDAR = {
    "bytes": [1, 1],
    "files": [1, 1],
    "nodes": None,
    "holes_m2": 0.0,
    "not_read_m2": 0.0,
    "acquired": ["2019-05-04", "2019-05-09"],
    "surfaces": {"ellipsoid": 1},
}


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        ("365", "12", "images 12–365 days later"),
        ("-7", "30", "images from 7 days earlier to 30 days later"),
    ],
)
def test_days_from_the_lidar_to_the_images_stand_beside_its_own(left, right, said):
    row = ROW | {"lidar_days_left": left, "lidar_days_right": right}
    card = cards({"A-1": SCENE | {"lidar": LIDAR}}, rows=[row, ROW])["LiDAR measured"]
    assert (card.value, card.note) == ("2019-05-04 to 2019-05-09", said)


def test_what_alignment_and_lidar_doubt_stands_there_too():
    told = {"of": "alignment", "text": "RPCs", "explained_by_alignment": False}
    for explained in (False, True):
        quality = {
            "scenes": {"A-1": SCENE},
            "doubts": {"A-1": [told | {"explained_by_alignment": explained}]},
        }
        every = headlines([ROW], {}, {}, [], {"quality": quality})
        (gates,) = (c for c in every if c.title == "limits of quality")
        assert gates.bad != explained
        assert ("alignment or LiDAR of A-1 in doubt" in gates.note) != explained


def test_how_far_an_edit_has_moved_labels_and_the_worst_control_point():
    moved = {"count": 9, "median_px": 0.0213, "most_px": 0.35, "gone_share": 0.012}
    moved |= {"height_median_m": 0.3, "height_most_m": 0.4}
    record = {
        view: {
            "rms": {"before": 8.0, "after": 0.3},
            "gcps": [{"id": id, "after": [0, 0.5], "leave_one_out": [0, out]} for id, out in gcps],
        }
        for view, gcps in (("left", (("a", 0.1), ("b", 0.1), ("c", 0.6))), ("right", ()))
    }
    found = headlines((ROW,), {"A-1": record}, {}, (), {"since_last_run": {"A-1": moved}})
    by_title = {card.title: card for card in found}
    card = by_title["moved since the last run"]
    assert card.value == "0.021 px, 0.300 m" and "0.35 px" in card.note and "1.2 %" in card.note
    assert "c (left image): 0.50 px" in by_title["GCP residuals, rms"].note
    assert "moved since the last run" not in cards({"A-1": SCENE})


def test_the_first_card_has_the_exact_truth_where_there_is_one():
    export = {
        "label_uncertainty": {"all": {"uncertainty_median_px": 0.04, "uncertainty_p95_px": 0.1}}
    }
    truth = [{"scope": "tiles", "mean_absolute_px": "0.0213"}]
    first, *_ = headlines((ROW,), {}, {}, truth, export)
    assert first.value == "0.04 px" and "0.021 px" in first.note
    first, *_ = headlines((ROW,), {}, {}, (), export)
    assert "truth" not in first.note
