"""What tables say of a method's training."""

from __future__ import annotations

import pytest

from stereobench.scores.training_data import training_data


@pytest.mark.parametrize(
    ("settings", "trained_on", "seen"),
    [
        ({"kind": "sgm"}, "nothing", "no"),
        ({"kind": "pandora"}, "nothing", "no"),
        ({"kind": "pandora", "pipeline": "mccnn"}, "US3D", "yes"),
        ({"kind": "function", "function": "a:b"}, "not stated", "not stated"),
        ({"kind": "stereonet", "weights": "my.pt"}, "not stated", "not stated"),
        ({"kind": "folder", "trained_on": ["us3d", "whu"]}, "us3d; whu", "yes"),
        ({"kind": "pandora", "pipeline": "own.json"}, "not stated", "not stated"),
        ({"kind": "stereonet", "weights": "my.pt", "trained_on": ["whu"]}, "whu", "no"),
        (
            {"kind": "stereonet", "weights": "results/train/us3d/stereonet/best.pt"},
            "us3d, training pairs",
            "training pairs only",
        ),
        (
            {"kind": "stereonet", "weights": "results/train/other/stereonet/best.pt"},
            "other, training pairs",
            "no",
        ),
    ],
)  # fmt: skip
def test_what_is_known_or_stated_of_a_method(settings, trained_on, seen):
    found = training_data({"dataset": "us3d", "settings": settings})
    assert found == {"trained_on": trained_on, "licence": "not stated", "seen_in_training": seen}


def test_the_licence_is_that_of_the_entry_or_of_the_installed_package():
    of = {"dataset": "d", "settings": {"kind": "sgm"}, "identity": {"licence": "Apache-2.0"}}
    assert training_data(of)["licence"] == "Apache-2.0"
    of["settings"]["licence"] = "MIT"
    assert training_data(of)["licence"] == "MIT"
