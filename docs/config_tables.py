"""The files that follow from the sections: ``config/config.yaml`` and the tables of the guide.

python docs/config_tables.py
"""

from __future__ import annotations

import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.config.methods import DATASETS, METHODS, Training
from stereotruth.core.config.section import (
    Key,
    attributes_of,
    fields_of,
    meaning,
    nested,
    values_of,
)
from stereotruth.core.sheets import City, Image, Scene

BY_NAME = {"datasets": DATASETS, "methods": METHODS}
BELOW = ("training", "benchmark.methods")  # have tables of their own
TABLE = re.compile(r"(<!-- keys: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rows(of: Any, before: str = "") -> Iterator[str]:
    """The rows of the reference table: key; unit, values; effect."""
    for name, key in fields_of(of).items():
        full = f"{before}{name}"
        inner, by_name = nested(key.type)
        if inner is None or key.meaning:
            yield row(full, key)
        if inner is not None and full not in BELOW:
            yield from rows(inner, f"{full}.<name>." if by_name else f"{full}.")


def row(name: str, key: Key) -> str:
    """One row."""
    return f"| `{name}` | {values_of(key)} | {key.meaning} |".replace("|  |", "| |")


def columns(of: Any) -> Iterator[str]:
    """The table of a sheet's columns."""
    yield from ("| column | meaning |", "|---|---|")
    yield from (f"| `{name}` | {key.meaning} |" for name, key in fields_of(of).items())


def with_tables(guide: str) -> str:
    """The text of ``config/README.md`` with its tables as they follow from the classes."""
    head = ("| key | unit, values | effect |", "|---|---|---|")
    tables = {
        "configuration": [*head, *rows(Configuration)],
        "training": [*head, *rows(Training, "training.")],
        "scenes": columns(Scene),
        "cities": columns(City),
        "images": columns(Image),
    }

    def table(found: re.Match[str]) -> str:
        return found[1] + "".join(f"{line}\n" for line in tables[found[2]]) + found[3]

    return TABLE.sub(table, guide)


HEAD = """\
# Every key with its default; units and effects are in config/README.md. Written by
# python docs/config_tables.py. Your own scenes: write a file that overrides what
# differs, and pass it with --configfile.
"""
LONGEST_LINE = 130  # characters
SHORTEST_REMARK = 20


def defaults_text() -> str:
    """The text of ``config/config.yaml``: every key with its default and what it is."""
    lines = list(_default_lines(Configuration, Configuration(), ""))
    return HEAD + "\n".join(lines) + "\n"


def _default_lines(of: Any, values: Any, indent: str) -> Iterator[str]:
    """Lines of a section; a blank one before each section of the whole."""
    for name, key in attributes_of(of).items():
        value, (inner, by_name) = getattr(values, name), nested(key.type)
        if not indent and inner is not None:
            yield ""
        if inner is not None and not by_name and key.name != "strips":
            yield f"{indent}{key.name}:"
            yield from _default_lines(inner, value, indent + "  ")
        elif inner is not None:
            yield f"{indent}{key.name}: # by name; null takes one of these away"
            entries = BY_NAME[key.name].items()
            yield from (f"{indent}  {entry}: {_yaml(given)}" for entry, given in entries)
        else:
            yield _with_remark(f"{indent}{key.name}: {_yaml(value)}", key)


def _yaml(value: Any) -> str:
    """A value on one line."""
    plain = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...")


def _with_remark(line: str, key: Key) -> str:
    """A line with what the key is behind it, cut at a word where it is long."""
    remark = meaning(key).replace("`", "")
    room = LONGEST_LINE - len(line) - len(" # ")
    if not remark or room < SHORTEST_REMARK:
        return line
    return f"{line} # {textwrap.shorten(remark, room, placeholder=' …')}"


USAGE = """\
Usage: python docs/config_tables.py [FOLDER]
Writes config.yaml with all defaults, and the tables of keys in README.md, in FOLDER (config).
For developers, in a checkout: the reference is made of the classes that check a configuration.
"""

if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv[1:]):
        sys.stdout.write(USAGE)
        sys.exit()
    config = Path(*sys.argv[1:] or ["config"])
    guide = config / "README.md"
    if not guide.is_file():
        sys.exit(f"no {guide}. {USAGE.splitlines()[0]}")
    guide.write_text(with_tables(guide.read_text(encoding="utf-8")), encoding="utf-8")
    (config / "config.yaml").write_text(defaults_text(), encoding="utf-8")
