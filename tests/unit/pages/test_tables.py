"""Values as people read them."""

from __future__ import annotations

import pytest

from stereotruth.pages import tables


@pytest.mark.parametrize(
    ("name", "text", "shown"),
    [
        ("labelled_share", "0.123456", "12.35 %"),
        ("mean_px", "-0.1", "−0.100"),
        ("mean_px", "-0.0001", "0.000"),
        ("labelled_share", "-0.00001", "0.00 %"),
        ("row0", "1024", "1024"),
        ("labels", "5061336", "5 061 336"),
        ("class", "building", "building"),
        ("lon", "114.30004567", "114.30005"),
        ("rms", "nan", "nan"),
        ("rms", "", ""),
    ],
)
def test_values_are_shown_as_people_read_them(name, text, shown):
    assert tables.show(name, text) == shown
