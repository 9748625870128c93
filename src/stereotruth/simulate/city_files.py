"""Cities that a project has beside the six: each in a file of its own, which can be edited.

``data/synthetic/<City>/city.json`` holds what differs from the defaults of
:class:`.cities.CitySpec`, by the names of its fields.
"""

from __future__ import annotations

import json
from dataclasses import MISSING, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..products.files import atomic_file
from .cities import CITIES, CitySpec

FOLDER = Path("data/synthetic")  # of the working directory


def file_of(name: str) -> Path:
    """The file of a city that is none of the six."""
    return FOLDER / name / "city.json"


def synthetic_city(name: str) -> CitySpec | None:
    """The city of a name, one of the six or of the project's own; None if there is none.

    Raises InputError for a file that holds no city.
    """
    if name in CITIES:
        return CITIES[name]
    file = file_of(name).absolute()
    if not file.is_file():
        return None
    return _read(file, file.stat().st_mtime_ns)


def city_of(name: str) -> CitySpec:
    """As :func:`synthetic_city`; raises InputError if there is none."""
    city = synthetic_city(name)
    if city is None:
        raise InputError(
            f"{name!r} is no synthetic city", file=file_of(name), remedy="write its file again"
        )
    return city


def read_city(file: str | Path) -> CitySpec:
    """The city of a file. Raises InputError that names the field that is wrong."""
    from pydantic import TypeAdapter, ValidationError  # slow to import, and few cities have a file

    try:
        given = json.loads(Path(file).read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(
            f"cannot be read as JSON: {error}", file=file, remedy="correct it, or make it again"
        ) from None
    try:
        return TypeAdapter(CitySpec).validate_python(given)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(
            f"{where}: {first['msg']}", file=file, remedy="correct it, or make it again"
        ) from None


@lru_cache(maxsize=8)
def _read(file: Path, changed_ns: int) -> CitySpec:
    del changed_ns  # another time of the file is another city
    return read_city(file)


def write_city(city: CitySpec, file: str | Path) -> None:
    """Write what a city has other than the defaults."""
    with atomic_file(file) as scratch:
        scratch.write_text(json.dumps(_plain(city), indent=2) + "\n", encoding="utf-8")


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {
            f.name: _plain(given)
            for f in fields(value)
            if (given := getattr(value, f.name)) != f.default or f.default is MISSING
        }
    return [_plain(one) for one in value] if isinstance(value, tuple) else value
