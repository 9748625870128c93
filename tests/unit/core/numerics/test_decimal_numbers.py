"""What counts as a number in the text files of users."""

from __future__ import annotations

import pytest

from stereotruth.core.tables import decimal_number


@pytest.mark.parametrize("text", ["0", "-0.5", "+1.25E-03", "5.", ".5", "1e5", "007"])
def test_numbers(text) -> None:
    assert decimal_number(text) == float(text)


@pytest.mark.parametrize(
    "text", ["", "1_000", "１２３", "٣", "nan", "inf", "0x10", "1,5", "1 0", "--1", "1e", "1" * 400]
)
def test_what_is_none(text) -> None:
    with pytest.raises(ValueError, match="is no number"):
        decimal_number(text)
