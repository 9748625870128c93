"""What classes of settings say of themselves: keys, values, meanings, and errors in words."""

from __future__ import annotations

import ast
import difflib
import inspect
import re
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import ValidationError

from .errors import InputError
from .settings import Unit, WrongValues, is_odd

LONGEST_VALUE = 300  # characters of a value in messages
AT_FIRST = re.compile("^(Input|String|Tuple|Dictionary|Value error,) ")  # of pydantic's messages
ALTERNATIVE = re.compile(r"int|float|str|bool|constrained-\w+|(dict|tuple|literal)\[.*\]|\[key\]")


class Key(NamedTuple):
    """One key: its name with dots, type, and what its docstring says ("" if it has none)."""

    name: str
    type: Any
    metadata: Sequence[Any]
    meaning: str


@cache
def _said(of: type) -> dict[str, str]:
    """The docstrings of a class's own keys. (Pydantic would read them at the start of each job.)"""
    (made,) = ast.parse(textwrap.dedent(inspect.getsource(of))).body
    return {
        ast.unparse(key.target): ast.literal_eval(text.value)
        for key, text in pairwise(made.body)
        if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr)
    }


def fields_of(of: Any) -> dict[str, Key]:
    """The keys of a class of settings by the names that the user writes."""
    return {key.name: key for key in attributes_of(of).values()}


def attributes_of(of: Any) -> dict[str, Key]:
    """The keys of a class of settings by the names of its attributes."""
    found = {}
    for name, info in of.__pydantic_fields__.items():
        key = info.alias or name
        classes = (c for c in of.__mro__ if "__pydantic_fields__" in vars(c))
        said = next((_said(c)[name] for c in classes if name in _said(c)), "")
        found[name] = Key(key, info.annotation, info.metadata, " ".join(said.split()))
    return found


def _unwrapped(kind: Any, metadata: Sequence[Any] = ()) -> tuple[list[Any], list[Any]]:
    """The alternatives of a type, without None, and all that is said of them."""
    if get_origin(kind) is Annotated:
        inner, *more = get_args(kind)
        return _unwrapped(inner, [*metadata, *more])
    if get_origin(kind) in (Union, types.UnionType):
        kinds, said = [], list(metadata)
        for one in get_args(kind):
            if one is not type(None):
                some, more = _unwrapped(one)
                kinds += some
                said += more
        return kinds, said
    return [kind], list(metadata)


def nested(kind: Any) -> tuple[Any, bool]:
    """The class of settings that a key's value is made of, or None; whether it is one by name."""
    for one in _unwrapped(kind)[0]:
        if get_origin(one) is dict:
            inner = nested(get_args(one)[1])[0]
            if inner is not None:
                return inner, True
        if hasattr(one, "__pydantic_fields__"):
            return one, False
    return None, False


def values_of(key: Key) -> str:
    """Unit, limits and values of a key in a few words, such as ``px, odd, 3 … 31``."""
    kinds, said = _unwrapped(key.type, key.metadata)
    words = [of.text for of in said if isinstance(of, Unit)][:1]
    limits = {}
    for of in said:
        for one in getattr(of, "metadata", [of]):
            for name in ("ge", "gt", "le", "lt", "multiple_of"):
                if getattr(one, name, None) is not None:
                    limits[name] = getattr(one, name)
    if any(getattr(of, "func", None) is is_odd for of in said):
        words.append("odd")
    low, high = (limits.get(a, limits.get(b)) for a, b in (("ge", "gt"), ("le", "lt")))
    if high is not None:
        words.append(f"{low:g} … {high:g}".replace("-", "−"))
    elif "multiple_of" in limits:
        words.append(f"multiple of {limits['multiple_of']}")
    elif "gt" in limits:
        words.append(f"above {low:g}")
    elif low is not None and low > 1:
        words.append(f"{low:g} or more")
    for one in kinds:
        if get_origin(one) is Literal:
            words += [str(value) for value in get_args(one) if value is not None]
        elif one is bool:
            words += ["true", "false"]
    if any(of is type(None) for of in get_args(key.type)) or _allows_none(key.type):
        words.append("null")
    return ", ".join(words)


def _allows_none(kind: Any) -> bool:
    if get_origin(kind) is Annotated:
        return _allows_none(get_args(kind)[0])
    if get_origin(kind) in (Union, types.UnionType):
        return any(_allows_none(one) for one in get_args(kind))
    return kind is type(None) or (get_origin(kind) is Literal and None in get_args(kind))


class _Place(NamedTuple):
    """Where an error lies: names of the keys that lead there, the class, the last known key."""

    names: tuple[str, ...]
    inside: Any
    key: Key | None
    known: str  # the key's full name


def _located(of: Any, parts: Sequence[Any]) -> _Place:
    """What the parts of an error's place mean, of which some only name alternatives of a type."""
    found, by_name = _Place((), of, None, ""), False
    for part in parts:
        if isinstance(part, str) and ALTERNATIVE.fullmatch(part):
            continue
        names = (*found.names, str(part))
        keys = {} if found.inside is None or isinstance(part, int) else fields_of(found.inside)
        if by_name or part not in keys:
            found, by_name = found._replace(names=names), False
            continue
        key = keys[part]
        inner, _ = nested(key.type)
        by_name = any(get_origin(one) is dict for one in _unwrapped(key.type)[0])
        found = _Place(names, inner or (None if by_name else found.inside), key, ".".join(names))
    return found


def complaint(error: ValidationError, of: Any) -> tuple[str, str]:
    """What is wrong with the values of a class, and the remedy, in the user's words."""
    every = error.errors(include_url=False)
    unknown = [e for e in every if e["type"] == "unexpected_keyword_argument"]
    if unknown:
        first = min(unknown, key=lambda e: len(e["loc"]))["loc"][:-1]
        surplus = sorted(str(e["loc"][-1]) for e in unknown if e["loc"][:-1] == first)
        place = _located(of, first)
        known = sorted(fields_of(place.inside))
        close = difflib.get_close_matches(surplus[0], known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known keys: {', '.join(known)}"
        under = f" under {'.'.join(place.names)!r}" if place.names else ""
        return f"unknown key {', '.join(map(repr, surplus))}{under}", hint
    of_first = [e for e in every if e["loc"][:1] == every[0]["loc"][:1]]
    one = max(reversed(of_first), key=lambda e: len(e["loc"]))  # of alternatives the last
    place = _located(of, one["loc"])
    name = ".".join(place.names)
    cause = one.get("ctx", {}).get("error")
    if isinstance(cause, InputError):
        problem, remedy = in_words(cause)
        return (f"{name}: " if name else "") + problem, remedy
    if one["type"] == "dataclass_type":
        keys = ", ".join(fields_of(place.inside))
        return f"{name}: {one['input']!r} has no keys", f"its keys are {keys}"
    if one["type"] == "missing":
        return f"{name}: is required", f"add it: {meaning(place.key)}"
    said = AT_FIRST.sub("", one["msg"])
    given = repr(one["input"])
    given = given if len(given) <= LONGEST_VALUE else f"{given[:LONGEST_VALUE]} …"
    problem = f"{name or 'value'}: {given} {said}"
    if place.key is None:
        return problem, "see config/README.md"
    return problem, f"{place.known} is: {meaning(place.key)}"


def in_words(error: InputError) -> tuple[str, str]:
    """Problem and remedy of an error, in the user's words."""
    if isinstance(error, WrongValues):
        return complaint(error.error, error.of)
    return error.problem, error.remedy


def meaning(key: Key) -> str:
    """What a key is, in a line: its unit and values, and what it does."""
    return ": ".join(filter(None, (values_of(key), _first(key.meaning))))


def _first(meaning: str) -> str:
    """What stands before the first full stop of a meaning, without links."""
    return re.sub(r"\[([^]]+)\]\([^)]*\)", r"\1", meaning.split(". ")[0])


def check(values: Mapping[str, Any], of: Callable[..., Any], file: Any) -> Any:
    """The settings of a class that the user's values make. InputError names ``file`` and key."""
    try:
        return of(**values)
    except InputError as error:
        problem, remedy = in_words(error)
        raise InputError(problem, file=file, remedy=remedy) from None
