"""Which files of a user's code are imported by others, found without running any of them."""

from __future__ import annotations

import ast
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

IMPORTERS = ("import_module", "__import__", "spec_from_file_location", "run_path", "run_module")


def _places(file: Path) -> list[Path]:
    """Where a user's modules lie; what is installed is none of them."""
    named = [Path(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
    return [file.parent, Path(), *named]


def _names(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Modules that are imported anywhere in a file: dots before the name, and the name."""
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=names):
                yield from ((0, alias.name) for alias in names)
            case ast.ImportFrom(module=module, names=names, level=level):
                base = f"{module}." if module else ""
                yield from ((level, f"{base}{alias.name}") for alias in names)
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in IMPORTERS:
                for of in (*node.args, *(word.value for word in node.keywords)):
                    if isinstance(of, ast.Constant) and isinstance(of.value, str):
                        yield 0, of.value


def _files_of(name: str, places: Iterable[Path]) -> Iterator[Path]:
    """Files that importing ``a.b.c`` runs, if they lie in one of the places; or ``path.py``."""
    for place in places:
        if name.endswith(".py") and (place / name).is_file():
            yield place / name
        folder = place
        for part in name.split("."):
            if not part.isidentifier():
                break
            yield from filter(Path.is_file, (folder / f"{part}.py", folder / part / "__init__.py"))
            folder = folder / part


def imported_files(files: Iterable[Path]) -> list[Path]:
    """The files, and all files of the user's that they import, one by way of the other.

    Seen are import statements wherever they stand, and calls that import a name or a path that is
    written out. A file that is no Python counts as importing nothing.
    """
    found: dict[Path, Path] = {}
    todo = list(files)
    while todo:
        file = todo.pop()
        if (key := file.absolute()) in found:
            continue
        found[key] = file
        try:
            tree = ast.parse(file.read_bytes())
        except (OSError, SyntaxError, ValueError, RecursionError):
            continue
        for level, name in _names(tree):
            places = [[*file.parents, Path()][level - 1]] if level else _places(file)
            todo += _files_of(name, places)
    return sorted(found.values())
