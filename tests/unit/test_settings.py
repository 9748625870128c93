"""Values that classes of settings refuse, in plain words; the user's are in test_sheets."""

from __future__ import annotations

import pytest

from stereotruth.dataset.settings import Tiles
from stereotruth.errors import InputError
from stereotruth.matching.scenes.settings import Settings
from stereotruth.settings import WrongValues
from stereotruth.settings_text import in_words


def test_a_wrong_value_is_named_by_its_key_and_class():
    with pytest.raises(InputError, match=r"min_labelled: 1.5: .* Remedy: .*Tiles of .*dataset"):
        Tiles(min_labelled=1.5)


def test_what_a_class_says_itself_stays_as_it_is():
    with pytest.raises(WrongValues, match="blocks of 1024 px with an overlap of 600 px") as refusal:
        Settings(overlap_px=600)
    assert in_words(refusal.value)[1].startswith("take a multiple of 256")


def test_the_users_words_have_the_meaning_of_the_key():
    with pytest.raises(WrongValues) as refusal:
        Tiles(size=3)
    problem, remedy = in_words(refusal.value)
    assert problem.startswith("size: 3 should be greater than or equal to 16")
    assert "side of a tile" in remedy
