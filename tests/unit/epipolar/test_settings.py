"""Which bands are taken of images with several."""

from __future__ import annotations

import pytest

from stereotruth.epipolar.settings import Settings
from stereotruth.errors import InputError


def test_band_1_is_taken_without_colour_and_the_mean_with_it() -> None:
    assert Settings().mix(None) == {1: 1.0}
    assert Settings().mix((3, 2, 1)) == pytest.approx({3: 1 / 3, 2: 1 / 3, 1: 1 / 3})


def test_weights_are_of_sum_one() -> None:
    assert Settings(panchromatic=4).mix((1, 2, 3)) == {4: 1.0}
    assert Settings(panchromatic={1: 1, 2: 3}).mix(None) == {1: 0.25, 2: 0.75}


@pytest.mark.parametrize("wrong", [{"panchromatic": {}}, {"panchromatic": 0}, {"colour": [1, 2]}])
def test_what_names_no_bands_is_refused(wrong) -> None:
    with pytest.raises(InputError):
        Settings(**wrong).mix(None)
