"""What a product was made from: checksums of inputs, parameters, and a digest of the code."""

from __future__ import annotations

import ast
import hashlib
import json
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from . import __version__

PACKAGE = Path(__file__).parent


def file_sha256(path: str | Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    with Path(path).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _module_file(module: str) -> Path | None:
    """File of the package's module ``a.b`` (relative to the package), or None if there is none."""
    path = PACKAGE.joinpath(*module.split(".")) if module else PACKAGE
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None


def _without_docstrings(tree: ast.Module) -> ast.Module:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            match node.body:
                case [ast.Expr(value=ast.Constant(value=str())), *rest]:
                    node.body = rest or [ast.Pass()]
    return tree


def _imported_modules(tree: ast.Module, package: str) -> set[str]:
    """Modules of this package that a parsed module imports, relative to the package's root."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                parts = package.split(".") if package else []
                parts = parts[: len(parts) - (node.level - 1)]
                base = ".".join(["stereotruth", *parts, *([node.module] if node.module else [])])
            else:
                base = node.module or ""
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)]
        else:
            continue
        for name in names:
            if name.startswith("stereotruth."):
                found.add(name.removeprefix("stereotruth."))
    return {name for name in found if _module_file(name) is not None}


@cache
def _parsed(module: str) -> tuple[str, frozenset[str]]:
    file = _module_file(module)
    if file is None:
        raise ModuleNotFoundError(f"stereotruth.{module}")
    tree = ast.parse(file.read_text(encoding="utf-8"))
    package = module if file.name == "__init__.py" else module.rpartition(".")[0]
    imports = _imported_modules(tree, package)
    parts = module.split(".")
    imports |= {".".join(parts[:n]) for n in range(1, len(parts))}  # parents run on import
    return ast.dump(_without_docstrings(tree)), frozenset(imports)


def source_modules(*modules: str) -> list[str]:
    """The named modules of this package and all that they import from it, sorted."""
    seen: set[str] = set()
    todo = list(modules)
    while todo:
        module = todo.pop()
        if module not in seen:
            seen.add(module)
            todo.extend(_parsed(module)[1])
    return sorted(seen)


def source_digest(*modules: str) -> str:
    """Digest of the parsed source of the modules and of all that they import from this package.

    Comments, docstrings and layout do not enter, so that only a change of what runs changes it.
    """
    digest = hashlib.sha256()
    for module in source_modules(*modules):
        digest.update(f"{module}\0{_parsed(module)[0]}\0".encode())
    return digest.hexdigest()[:16]


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
        "code": code,
        "inputs": dict(sorted(inputs.items())),
        "parameters": dict(parameters),
    }


def digest(record: Mapping[str, Any]) -> str:
    """Short digest of a provenance record: stands for the product in later stages' records."""
    text = json.dumps(record, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
