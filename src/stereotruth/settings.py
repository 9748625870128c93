"""What settings are made of: types with limits, checked, with errors in the user's words.

Each stage has a class of settings in its package, a frozen dataclass made by :func:`settings`. A
key's type holds its limits, its docstring says what it does, and nowhere else does either stand:
:mod:`stereotruth.configuration` puts the classes together, checks what the user wrote, and writes
the reference table from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any, TypeVar, dataclass_transform

from pydantic import (
    AfterValidator,
    ConfigDict,
    Field,
    StrictBool,
    StrictFloat,
    StrictInt,
    StrictStr,
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


Odd = Annotated[Whole, AfterValidator(is_odd)]
Share = Annotated[Number, Field(ge=0, le=1), Unit("share")]
Range = Annotated[tuple[Whole, Whole], Unit("px, px")]  # the second is excluded


@dataclass_transform(frozen_default=True, field_specifiers=(Field,))
def settings(made: Class | None = None, *, more: bool = False) -> Any:
    """Class decorator: a frozen dataclass whose values are checked; InputError tells what is wrong.

    ``more``: keys that it does not know are let through to others, unchecked.
    """
    if made is None:
        return lambda given: settings(given, more=more)
    config = ConfigDict(extra="ignore" if more else "forbid", populate_by_name=True)
    found = validated(made, frozen=True, config=config)
    init = found.__init__

    def __init__(self: Any, *args: Any, **values: Any) -> None:
        try:
            init(self, *args, **values)
        except ValidationError as error:
            # by its name, so that the words of errors do not enter the code digests of stages
            words = import_module("stereotruth.settings_text")
            problem, remedy = words.complaint(error, found)
            raise InputError(problem, remedy=remedy) from None

    __init__.__signature__ = getattr(init, "__signature__", None)
    found.__init__ = __init__
    return found
