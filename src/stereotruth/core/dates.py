"""Times of images and epochs of coordinates, as users write them."""

from __future__ import annotations

import re
from datetime import UTC, date, datetime


def acquisition_time(text: str) -> datetime | date:
    """The time, UTC, or the date that a cell ``acquired`` names. ValueError says what is wrong."""
    if re.fullmatch(r"\d{4}-\d{2}-\d{2}", text):
        return date.fromisoformat(text)
    if not re.match(r"\d{4}-\d{2}-\d{2}[T ]\d{2}:\d{2}", text):
        raise ValueError("is not of the form 2020-10-25T03:12:45Z")
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        if "Invalid isoformat" not in str(error):
            raise
        raise ValueError("is not of the form 2020-10-25T03:12:45Z") from error
    if time.tzinfo is None:
        raise ValueError("has no time zone: Z of UTC, or an offset such as +08:00")
    return time.astimezone(UTC)


def decimal_year(time: date) -> float:
    """Of a day's noon: 2020-07-02 is 2020.5 in a leap year."""
    first, last = date(time.year, 1, 1), date(time.year + 1, 1, 1)
    day = date(time.year, time.month, time.day)
    return time.year + ((day - first).days + 0.5) / (last - first).days


def epoch_year(text: str) -> float | None:
    """The decimal year that a cell names as 2016.4 or as a date; None where it is empty.

    ValueError says what is wrong.
    """
    if not text:
        return None
    if re.fullmatch(r"\d{4}-\d{2}-\d{2}", text):
        year = decimal_year(date.fromisoformat(text))
    elif re.fullmatch(r"\d{4}(\.\d+)?", text):
        year = float(text)
    else:
        raise ValueError("is neither a decimal year nor a date")
    if not 1980 <= year < 2100:
        raise ValueError("is no epoch between 1980 and 2100")
    return year
