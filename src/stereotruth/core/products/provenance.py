"""What a product was made from: checksums of inputs, parameters, and a digest of the code."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from ... import __version__

SOURCES = Path(__file__).parents[3]  # where the packages lie
PACKAGES = ("stereotruth", "stereobench", "stereocities")
# Declares keys: what a rule takes of them stands in its parameters.
CONFIG = "stereotruth.core.config."
# Their versions may decide bytes of products.
LIBRARIES = (
    *("numpy", "scipy", "numba", "opencv-python-headless", "zarr", "numcodecs"),
    *("rasterio", "pyproj", "laspy", "lazrs"),
)

# Pythons differ in their trees.
CACHE = Path(__file__).parent / "__pycache__" / f"sources-{sys.implementation.cache_tag}.json"


def file_sha256(path: str | Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def checksums(
    files: Iterable[str | Path],
    left_mask: str | Path | None = None,
    right_mask: str | Path | None = None,
) -> dict[str, str]:
    """Checksums of a scene's files by their names, and of the masks of its images."""
    found = {Path(file).name: file_sha256(file) for file in files}
    for view, mask in (("left", left_mask), ("right", right_mask)):
        if mask:
            found[f"{view}_mask/{Path(mask).name}"] = file_sha256(mask)
    return found


def _module_file(module: str) -> Path | None:
    """File of a module of :data:`PACKAGES`, or None if there is none."""
    path = SOURCES.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


def _without_docstrings(tree: ast.Module) -> ast.Module:
    """The tree without its docstrings, those of attributes included."""

    def is_text(statement: ast.stmt) -> bool:
        match statement:
            case ast.Expr(value=ast.Constant(value=str())):
                return True
        return False

    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not is_text(part)] or [ast.Pass()]
    return tree


def _imported_modules(tree: ast.Module, package: str) -> set[str]:
    """Modules of :data:`PACKAGES` that a parsed module imports."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                parts = package.split(".")
                parts = parts[: len(parts) - (node.level - 1)]
                base = ".".join([*parts, *([node.module] if node.module else [])])
            else:
                base = node.module or ""
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            if name.partition(".")[0] in PACKAGES and not name.startswith(CONFIG):
                found.add(name)
    return {name for name in found if _module_file(name) is not None}


@dataclass
class _Sources:
    """What is known of the package's modules: digest of the code, and modules imported.

    Parsing all takes two seconds, and each job of the workflow asks. As Python does with its
    byte code, results are kept in ``__pycache__``, for files of the same size and time.
    """

    file: Path
    known: dict[str, list[Any]] = field(default_factory=dict)
    fresh: bool = False

    def load(self) -> _Sources:
        try:
            self.known = json.loads(self.file.read_text())
        except (OSError, ValueError):
            self.known = {}
        return self

    def save(self) -> None:
        """Write what is new, if the folder can be written to."""
        if not self.fresh:
            return
        scratch = self.file.with_suffix(f".{os.getpid()}")
        try:
            self.file.parent.mkdir(exist_ok=True)
            scratch.write_text(json.dumps(self.known))
            scratch.replace(self.file)
        except OSError:
            with suppress(OSError):
                scratch.unlink()
        self.fresh = False

    def of(self, module: str) -> tuple[str, list[str]]:
        file = _module_file(module)
        if file is None:
            raise ModuleNotFoundError(module)
        states = [part.stat() for part in _with_table(file)]
        stamp = [[state.st_mtime_ns, state.st_size] for state in states]
        found = self.known.get(module)
        if found is None or found[0] != stamp:
            found = self.known[module] = [stamp, *_parsed(module, file)]
            self.fresh = True
        return found[1], found[2]


def _with_table(file: Path) -> list[Path]:
    """The source of a module, and the table of the same name beside it that it reads, if any."""
    table = file.with_suffix(".tsv")
    return [file, table] if table.is_file() else [file]


def _parsed(module: str, file: Path) -> tuple[str, list[str]]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    imports = _imported_modules(tree, package)
    parts = module.split(".")
    imports |= {".".join(parts[:n]) for n in range(1, len(parts))}  # parents run on import
    code = hashlib.sha256(ast.dump(_without_docstrings(tree)).encode())
    for table in _with_table(file)[1:]:
        code.update(table.read_bytes())
    return code.hexdigest(), sorted(imports)


@cache
def _sources() -> _Sources:
    return _Sources(CACHE).load()


def source_modules(*modules: str) -> list[str]:
    """The named modules and all of :data:`PACKAGES` that they import, sorted."""
    seen: set[str] = set()
    todo = list(modules)
    while todo:
        module = todo.pop()
        if module not in seen:
            seen.add(module)
            todo.extend(_sources().of(module)[1])
    return sorted(seen)


def source_digest(*modules: str) -> str:
    """Digest of the parsed source of the modules and of all of :data:`PACKAGES` that they import.

    Comments, docstrings and layout do not enter, so that only a change of what runs changes it. A
    table of a module's name beside it (``.tsv``) does.
    """
    digest = hashlib.sha256()
    for module in source_modules(*modules):
        digest.update(f"{module}\0{_sources().of(module)[0]}\0".encode())
    _sources().save()
    return digest.hexdigest()[:16]


def script_digest(file: str | Path) -> str:
    """Digest of the parsed source of one file, without what it imports; see source_digest."""
    tree = _without_docstrings(ast.parse(Path(file).read_text(encoding="utf-8")))
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()[:16]


@cache
def libraries() -> dict[str, str]:
    """Versions of :data:`LIBRARIES`, of those that are installed."""
    found = {}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def describe(
    inputs: Iterable[str | Path] | Mapping[str, str],
    parameters: Mapping[str, Any],
    code: str,
) -> dict[str, Any]:
    """Provenance record of one product.

    ``inputs`` are files, whose checksums are taken, or ready {name: checksum} pairs (for stores,
    the digest of their own provenance, see :func:`digest`). ``code`` comes from
    :func:`source_digest`. Holds no time, host or absolute path: equal work gives equal records.
    """
    if not isinstance(inputs, Mapping):
        inputs = {Path(path).name: file_sha256(path) for path in inputs}
    return {
        "software": f"stereotruth {__version__}",
        "libraries": libraries(),
        "code": code,
        "inputs": dict(sorted(inputs.items())),
        "parameters": dict(parameters),
    }


def digest(record: Mapping[str, Any]) -> str:
    """Short digest of a provenance record: stands for the product in later stages' records."""
    text = json.dumps(record, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def own_digest(record: Mapping[str, Any]) -> str:
    """Digest of all that a record in JSON holds, but for its key ``digest``, which keeps it."""
    rest = {key: value for key, value in record.items() if key != "digest"}
    return digest(json.loads(json.dumps(rest, default=str)))
