"""Names that others state: plain ones, or refused."""

from __future__ import annotations

import pytest

from stereotruth.core.config.section import LONGEST_NAME
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import path_below, plain_name

OUTSIDE = ("/etc/x", "../../../../x", "..", ".", ".x", "a\\b", "C:\\x", "a\0b", "a\nb")
NO_NAMES = (*OUTSIDE, "a/b", "", "x" * (LONGEST_NAME + 1), "é" * 51, "a\udce9", 7)


@pytest.mark.parametrize("name", NO_NAMES)
def test_what_is_no_plain_name_is_refused(name):
    with pytest.raises(InputError, match=r"m\.csv: line 2: tile") as refused:
        plain_name(name, "line 2: tile", "m.csv")
    assert str(refused.value).isprintable() and len(str(refused.value)) < 400


@pytest.mark.parametrize("name", ["QC_1", "a b", "é", "-1", "=1+2", "$frac$", "x" * 100])
def test_plain_names_stay_as_they_are(name):
    assert plain_name(name, "tile", "m.csv") == name


@pytest.mark.parametrize("path", [*OUTSIDE, "a//b", "a/../b", "a/", "", None, "a/" * 600])
def test_what_is_no_path_below_its_folder_is_refused(path):
    with pytest.raises(InputError, match="no path below its folder"):
        path_below(path, "line 2: left", "m.csv")


def test_paths_below_their_folder_stay_as_they_are():
    path = "with ground truth/train/left/QC_left_1.tiff"
    assert path_below(path, "left", "m.csv") == path
