"""What settings are made of: types with limits, checked, with errors in the user's words.

Each stage has a class of settings in its package, a frozen dataclass made by :func:`settings`. A
key's type holds its limits, its docstring says what it does, and nowhere else does either stand:
:mod:`stereotruth.configuration` puts the classes together, checks what the user wrote, and writes
the reference table from them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Annotated, Any, TypeVar, dataclass_transform

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
    StringConstraints,
    ValidationError,
)
from pydantic.dataclasses import dataclass as validated

from .errors import InputError

Class = TypeVar("Class", bound=type)
Values = TypeVar("Values", bound=tuple)

Whole = StrictInt
Number = StrictInt | StrictFloat  # a whole one stays whole, in records too
Flag = StrictBool
Text = StrictStr
LONGEST_NAME = 100  # characters; a file's name has 255 bytes, with what is added to it
PATTERN = re.compile(r"\{[^{}]*\w[^{}]*\}")
REPEATED = re.compile(r"(.+)\1{18}$")  # once more, and Snakemake takes it for an endless recursion


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of both; where both have one, ``above``'s, unless both are mappings themselves."""
    found = dict(below)
    for key, value in above.items():
        under = found.get(key)
        both = isinstance(under, Mapping) and isinstance(value, Mapping)
        found[key] = merged(under, value) if both else value
    return found


@dataclass(frozen=True)
class Unit:
    """The unit of a key, or in a few words what its values are."""

    text: str


def is_odd(value: int) -> int:
    """The value; ValueError if it is even."""
    if value % 2 == 0:
        raise ValueError("should be odd")
    return value


def each_once(values: Values) -> Values:
    """The values; ValueError if one stands there twice."""
    if len(set(values)) < len(values):
        raise ValueError("has a value twice")
    return values


def not_repeated(value: str) -> str:
    """The name; ValueError if it ends with the same characters again and again."""
    if REPEATED.search(value):
        raise ValueError("ends with the same characters again and again")
    return value


def no_pattern(value: str) -> str:
    """The path; ValueError if Snakemake would take a part of it for a wildcard and replace it."""
    if PATTERN.search(value):
        raise ValueError("has a name in { }, which stands for something else in the workflow")
    return value


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


def name_of(characters: str) -> Any:
    """The type of names that paths are made of: so many of the ``characters`` (of a pattern)."""
    limits = StringConstraints(pattern=f"^[{characters}]+$", max_length=LONGEST_NAME)
    return Annotated[Text, limits, AfterValidator(not_repeated)]


def over(defaults: Mapping[str, Any]) -> BeforeValidator:
    """What lays a given mapping over ``defaults``: a key that is not given keeps its value."""

    def laid_over(given: Any) -> Any:
        return merged(defaults, given) if isinstance(given, Mapping) else given

    return BeforeValidator(laid_over)


FilePath = Annotated[Text, AfterValidator(no_pattern)]
Odd = Annotated[Whole, AfterValidator(is_odd)]
Share = Annotated[Number, Field(ge=0, le=1), Unit("share")]
Range = Annotated[tuple[Whole, Whole], Unit("px, px")]  # the second is excluded


class WrongValues(InputError):
    """Values that a class of settings refuses: what :mod:`.settings_text` says in the user's words.

    Its own text is plain: stages take checked values, and the user's words stay out of the code
    digests of the stages.
    """

    def __init__(self, error: ValidationError, of: type) -> None:
        self.error, self.of = error, of
        first = error.errors(include_url=False)[0]
        cause = first.get("ctx", {}).get("error")
        name = ".".join(map(str, first["loc"]))
        if isinstance(cause, InputError):
            problem, remedy = cause.problem, cause.remedy
        else:
            problem = f"{first['input']!r}: {first['msg']}"
            remedy = f"correct it in the {of.__name__} of {of.__module__}"
        super().__init__(f"{name}: {problem}" if name else problem, remedy=remedy)


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def settings(made: Class | None = None, *, more: bool = False) -> Any:
    """Class decorator: a frozen dataclass whose values are checked. Raises WrongValues.

    ``more``: keys that it does not know are kept unchecked, as attributes, for others to check.
    """
    if made is None:
        return lambda given: settings(given, more=more)
    config = ConfigDict(extra="allow" if more else "forbid", populate_by_name=True)
    found = validated(made, frozen=True, config=config)
    init = found.__init__

    def __init__(self: Any, *args: Any, **values: Any) -> None:
        try:
            init(self, *args, **values)
        except ValidationError as error:
            raise WrongValues(error, found) from None

    __init__.__signature__ = getattr(init, "__signature__", None)
    found.__init__ = __init__
    return found
