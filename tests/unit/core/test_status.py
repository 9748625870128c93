"""The statuses as they are published: numbers, names, and which have a label."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereotruth.core.status import BY_LABEL, Status, carries_label, is_labelled, statuses_of

FILES = Path(__file__).parents[3] / "docs" / "reference" / "files.md"


def test_numbers_names_and_meanings_are_those_of_the_documentation():
    rows = [
        f"| {status:d} | `{status.label}` | {status.meaning} | "
        f"{'yes' if status.carries_label else 'no'} |"
        for status in Status
    ]
    assert "\n".join(rows) in FILES.read_text(encoding="utf-8")


def test_labels_are_told_by_number_and_by_name():
    values = np.array([[1, 8], [12, 13]], np.uint8)
    assert is_labelled(values).tolist() == [[True, False], [True, False]]
    assert not carries_label("of_other_software")
    assert all(is_labelled(status) == carries_label(name) for name, status in BY_LABEL.items())
    assert len(statuses_of("paper", masked=False)) == 9
    assert statuses_of("surface", masked=True)[9:] == [9, 12, 11]
