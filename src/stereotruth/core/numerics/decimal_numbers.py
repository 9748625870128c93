"""Decimal numbers in the text files of users."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
LONGEST = 60  # characters; a float64 has 17 digits


def decimal_number(text: str) -> float:
    """The number that a word of text is, in ASCII digits with a point, as every program reads it.

    ``float`` takes more: ``1_000``, full-width digits, ``nan``. Raises ValueError.
    """
    if len(text) > LONGEST or not _NUMBER.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is no number")
    return float(text)
