"""What sections of the configuration and rows of sheets are made of: types with units and limits.

The docstring of an attribute says what a key does; the words of an error name the key, its unit,
its limits, and the nearest name of an unknown key.
"""

from __future__ import annotations

import math
import re
import types
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
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

from ..errors import InputError, did_you_mean, told_by_system
from ..products.files import LONGEST_NAME

Values = TypeVar("Values", bound=tuple)
LONGEST_VALUE = 300  # characters of a value in messages
MOST_BYTES, MOST_VALUES = 1_000_000, 200_000  # of a file of settings
PATTERN = re.compile(r"\{[^{}]*\w[^{}]*\}")
REPEATED = re.compile(r"(.+)\1{18}$")  # once more, and Snakemake takes it for an endless recursion
AT_FIRST = re.compile("^(Input|String|Tuple|Dictionary|Value error,) ")  # of pydantic's messages
ALTERNATIVE = re.compile(r"int|float|str|bool|constrained-\w+|(dict|tuple|literal)\[.*\]|\[key\]")
CHECKED = ConfigDict(extra="forbid", populate_by_name=True, use_attribute_docstrings=True)


class Section(BaseModel):
    """A section of the configuration; unknown keys are refused."""

    model_config = CHECKED | ConfigDict(frozen=True)


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


def name_of(characters: str) -> Any:
    """The type of names that paths are made of: so many of the ``characters`` (of a pattern)."""
    limits = StringConstraints(pattern=f"^[{characters}]+$", max_length=LONGEST_NAME)
    return Annotated[Text, limits, AfterValidator(not_repeated)]


def read_mapping(file: Path) -> dict[str, Any]:
    """The keys and values of a YAML file. Raises InputError, naming it, if it has none.

    Refused are also keys that stand twice, and what grows beyond all measure when its aliases are
    put in.
    """
    try:
        if file.stat().st_size > MOST_BYTES:
            raise InputError(
                f"{file.stat().st_size / 1e6:.1f} MB are no configuration",
                file=file,
                remedy="name the file of the configuration",
            )
        loader = yaml.SafeLoader(file.read_text(encoding="utf-8-sig"))
        node = loader.get_single_node()
        _refuse_repeated_and_multiplied(node, file)
        found = None if node is None else loader.construct_document(node)
    except FileNotFoundError:
        raise InputError("no such file", file=file, remedy="correct its path") from None
    except (UnicodeDecodeError, RecursionError, yaml.YAMLError) as error:
        kinds = {UnicodeDecodeError: "is no UTF-8", RecursionError: "is nested too deeply"}
        raise InputError(
            f"{kinds.get(type(error), 'cannot be read as YAML')} ({' '.join(str(error).split())})",
            file=file,
            remedy="correct what it names, and save it as UTF-8",
        ) from None
    except OSError as error:
        raise told_by_system(error) or InputError(
            f"cannot be read: {error.strerror}", file=file, remedy="see what lies there"
        ) from None
    if found is not None and not isinstance(found, dict):
        raise InputError(
            "is no mapping of keys to values", file=file, remedy="write it as key: value"
        )
    return found or {}


def _refuse_repeated_and_multiplied(top: yaml.Node | None, file: Path) -> None:
    """Raise InputError if a key stands twice in one mapping, of which YAML would take the last, or
    if a document has more than MOST_VALUES with all aliases put in."""
    counts: dict[int, float] = {}

    def count(node: yaml.Node) -> float:
        if id(node) in counts:
            return counts[id(node)]
        counts[id(node)] = math.inf  # of an alias to what it stands in
        parts = node.value if isinstance(node, yaml.CollectionNode) else ()
        if isinstance(node, yaml.MappingNode):
            lines: dict[str, int] = {}
            for key, _ in parts:
                name = key.value if isinstance(key, yaml.ScalarNode) else "<<"
                line = key.start_mark.line + 1
                if name in lines and name != "<<":
                    raise InputError(
                        f"{name!r} stands twice, in lines {lines[name]} and {line}",
                        file=file,
                        remedy="put what both have under one of them",
                    )
                lines[name] = line
            parts = [part for pair in parts for part in pair]
        counts[id(node)] = 1 + sum(map(count, parts))
        return counts[id(node)]

    if top is not None and count(top) > MOST_VALUES:
        raise InputError(
            f"more than {MOST_VALUES} values, with its aliases (*) put in",
            file=file,
            remedy="write out what the aliases stand for",
        )


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of both; where both have one, ``above``'s, unless both are mappings themselves."""
    found = dict(below)
    for key, value in above.items():
        under = found.get(key)
        both = isinstance(under, Mapping) and isinstance(value, Mapping)
        found[key] = merged(under, value) if both else value
    return found


def over(defaults: Mapping[str, Any]) -> BeforeValidator:
    """What lays a given mapping over ``defaults``: a key that is not given keeps its value."""

    def laid_over(given: Any) -> Any:
        return merged(defaults, given) if isinstance(given, Mapping) else given

    return BeforeValidator(laid_over)


Whole = StrictInt
Number = StrictInt | StrictFloat  # a whole one stays whole, in records too
Flag = StrictBool
Text = StrictStr
Count = Annotated[Whole, Field(ge=1)]
NotNegative = Annotated[Number, Field(ge=0)]
FilePath = Annotated[Text, AfterValidator(no_pattern)]
Odd = Annotated[Whole, AfterValidator(is_odd)]
Share = Annotated[Number, Field(ge=0, le=1), Unit("share")]
Range = Annotated[tuple[Whole, Whole], Unit("px, px")]  # the second is excluded


def check(values: Mapping[str, Any], of: type, file: Any) -> Any:
    """What a class makes of the user's values. InputError names ``file``, the first key, a remedy.

    ``of``: a section, or a dataclass of pydantic.
    """
    try:
        return of(**values)
    except ValidationError as error:
        problem, remedy = complaint(error, of)
        raise InputError(problem, file=file, remedy=remedy) from None


class Key(NamedTuple):
    """One key: its name as users write it, type, and what its docstring says."""

    name: str
    type: Any
    metadata: Sequence[Any]
    meaning: str


def attributes_of(of: Any) -> dict[str, Key]:
    """The keys of a section by the names of its attributes."""
    return {
        name: Key(
            info.alias or name,
            info.annotation,
            info.metadata,
            " ".join((info.description or "").split()),
        )
        for name, info in of.__pydantic_fields__.items()
    }


def fields_of(of: Any) -> dict[str, Key]:
    """The keys of a section by the names that the user writes."""
    return {key.name: key for key in attributes_of(of).values()}


def _unwrapped(kind: Any, metadata: Sequence[Any] = ()) -> tuple[list[Any], list[Any]]:
    """The alternatives of a type, None as its type, and all that is said of them."""
    if get_origin(kind) is Annotated:
        inner, *more = get_args(kind)
        return _unwrapped(inner, [*metadata, *more])
    if get_origin(kind) in (Union, types.UnionType):
        kinds, said = [], list(metadata)
        for one in get_args(kind):
            some, more = _unwrapped(one)
            kinds += some
            said += more
        return kinds, said
    return [kind], list(metadata)


def nested(kind: Any) -> tuple[Any, bool]:
    """The section that a key's value is, or None; whether it is one by name."""
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
    values = [value for one in kinds if get_origin(one) is Literal for value in get_args(one)]
    words += [str(value) for value in values if value is not None]
    words += ["true", "false"] if bool in kinds else []
    words += ["null"] if type(None) in kinds or None in values else []
    return ", ".join(words)


def meaning(key: Key) -> str:
    """What a key is, in a line: its unit and values, and the first sentence of what it does."""
    first = re.sub(r"\[([^]]+)\]\([^)]*\)", r"\1", key.meaning.split(". ")[0])  # without links
    return ": ".join(filter(None, (values_of(key), first)))


class _Place(NamedTuple):
    """Where an error lies: names of the keys that lead there, the section, the last known key."""

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
    """What is wrong with the values of a section, and the remedy, in the user's words."""
    every = error.errors(include_url=False)
    unknown = [e for e in every if e["type"] in ("extra_forbidden", "unexpected_keyword_argument")]
    if unknown:
        first = min(unknown, key=lambda e: len(e["loc"]))["loc"][:-1]
        surplus = sorted(str(e["loc"][-1]) for e in unknown if e["loc"][:-1] == first)
        place = _located(of, first)
        known = sorted(fields_of(place.inside))
        hint = did_you_mean(surplus[0], known, f"known keys: {', '.join(known)}")
        under = f" under {'.'.join(place.names)!r}" if place.names else ""
        return f"unknown key {', '.join(map(repr, surplus))}{under}", hint
    of_first = [e for e in every if e["loc"][:1] == every[0]["loc"][:1]]
    one = max(reversed(of_first), key=lambda e: len(e["loc"]))  # of alternatives the last
    place = _located(of, one["loc"])
    name = ".".join(place.names)
    cause = one.get("ctx", {}).get("error")
    if isinstance(cause, InputError):
        return (f"{name}: " if name else "") + cause.problem, cause.remedy
    if one["type"] in ("model_type", "dataclass_type"):
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
