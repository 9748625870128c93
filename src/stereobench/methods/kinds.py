"""The kinds of stereo methods as plain values, so that a workflow can plan with them.

A new kind is an entry of :data:`KINDS` and the module that the entry names. That module has a
function ``make(name, kind, settings, workers)`` that returns a :class:`matcher.Matcher`:
``settings`` are those of the method's entry in the configuration, ``workers`` the threads that it
may use.

Which files of a user's code are imported by others is found without running any of them.
"""

from __future__ import annotations

import ast
import os
import os.path
import re
import shlex
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.machinery import PathFinder
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from stereotruth.core.config.section import PATTERN
from stereotruth.core.errors import InputError, did_you_mean, install_extra

# What gives a file names that it does not say.
MAKES_NAMES = r"\bimport\s*\*|\b(?:globals|vars|exec|setattr|__getattr__)\b"
IMPORTERS = ("import_module", "__import__", "spec_from_file_location", "run_path", "run_module")

FOLDER = "folder"
# keys of an entry that change no result
TOLD = ("label", "fine_tuned_of", "licence", "version", "trained_on", "seed", "by")
MOVED = ("polarity", "outside")  # of any kind
PATHS = ("weights", "folder", "pipeline", "function")  # settings that name a file
ENTRY_POINTS = "stereotruth.methods"
MCCNN = "mccnn"  # the pipeline of Pandora that has this name in the place of a file
MCCNN_MODULES = ("mc_cnn", "pandora_plugin_mc_cnn", "torch")
Files = Callable[[Mapping[str, Any]], list[Path]]


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
    # where a user's modules lie besides; what is installed is none of them
    named = [Path(p) for p in os.environ.get("PYTHONPATH", "").split(os.pathsep) if p]
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
            own = [*file.parents, Path()][max(level - 1, 0)]
            places = [own] if level else [own, Path(), *named]
            todo += _files_of(name, places)
    return sorted(found.values())


def _none(settings: Mapping[str, Any]) -> list[Path]:
    return []


def _weights(settings: Mapping[str, Any]) -> list[Path]:
    return [Path(settings["weights"])] if settings.get("weights") else []


def mccnn_weights() -> list[Path]:
    """MC-CNN's weights of the Data Fusion Contest in its installed package; none without it."""
    spec = find_spec(MCCNN_MODULES[0])
    folders = (spec and spec.submodule_search_locations) or ()
    return [Path(at) / "weights" / "mc_cnn_fast_data_fusion_contest.pt" for at in folders][:1]


def _pipeline(settings: Mapping[str, Any]) -> list[Path]:
    if settings.get("pipeline") == MCCNN:
        return mccnn_weights()
    return [Path(settings["pipeline"])] if settings.get("pipeline") else []


def _results(settings: Mapping[str, Any]) -> list[Path]:
    return sorted(file for file in Path(settings.get("folder", "")).glob("*") if file.is_file())


def _code(settings: Mapping[str, Any]) -> list[Path]:
    """The user's file, or all of the module's package, and what they import of the user's."""
    place, attribute = place_of(settings.get("function", ""))
    if place.endswith(".py"):
        _require(attribute, Path(place))
        return imported_files([Path(place)])
    top = place.partition(".")[0]
    try:
        spec = find_spec(top) if top else None  # imports nothing, since it has no parent
    except ValueError:
        spec = None
    spec = spec or PathFinder.find_spec(top, [str(Path.cwd())])
    if spec is None:
        raise InputError(
            f"cannot import {place}: No module named {top!r}",
            remedy="install it, or call the workflow from the folder that it lies in",
        )
    if folders := spec.submodule_search_locations:
        found = [file for folder in folders for file in Path(folder).rglob("*.py")]
    else:
        found = [Path(spec.origin)] if spec.has_location else []
    if not found:
        raise InputError(
            f"no file holds the code of {place}, so that its edits cannot be seen",
            remedy="name a function of a module or package that has .py files",
        )
    here = Path.cwd()
    return imported_files(f.relative_to(here) if f.is_relative_to(here) else f for f in found)


def _require(attribute: str, file: Path) -> None:
    """Raise InputError if a file that is read, and not run, does not even say this name.

    A file that is not there, that takes names of another, or makes some as it runs, may have it.
    """
    if not file.is_file():
        return
    text = file.read_text(encoding="utf-8", errors="replace")
    if re.search(rf"\b{re.escape(attribute.partition('.')[0])}\b|{MAKES_NAMES}", text):
        return
    names = re.findall(r"^(?:async )?(?:def|class) (\w+)", text, re.MULTILINE)
    remedy = did_you_mean(attribute, names, "name a function of the file")
    raise InputError(f"it has no {attribute!r}", file=file, remedy=remedy)


def words_of(command: str) -> list[str]:
    """The words of a command, as a shell has them.

    Raises InputError if it has none, or quotes that do not close.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"command {command!r}: {error}", remedy="close the quotes") from None
    if not words:
        raise InputError("no command", remedy="write the program and its arguments as command")
    return words


def _program(settings: Mapping[str, Any]) -> list[Path]:
    """The words of the command that are files, and what is named besides."""
    words = words_of(settings.get("command", ""))
    if "{" not in words[0] and shutil.which(words[0]) is None:
        raise InputError(
            f"no program {words[0]!r} that this machine can run",
            remedy="install it, or write its path as the first word of command; one that only the "
            "nodes of a cluster have is called from a script: command: sh mine.sh {left} …",
        )
    files = filter(Path.is_file, map(Path, words))
    return sorted({*files, *map(Path, settings.get("files") or ())})


def place_of(function: str) -> tuple[str, str]:
    """Module (``package.module`` or ``path.py``) and name of a user's function.

    ``function``: ``module:name``, or an entry point of the group :data:`ENTRY_POINTS`. Raises
    InputError if there is no such entry point.
    """
    place, colon, name = function.rpartition(":")
    if colon:
        return place, name
    (*found,) = entry_points(group=ENTRY_POINTS, name=function)
    if not found:
        raise InputError(
            f"no entry point {function!r} of group {ENTRY_POINTS}",
            remedy="install the package that has it, or write package.module:function",
        )
    return found[0].module, found[0].attr


@dataclass(frozen=True)
class Kind:
    """A kind of stereo methods.

    ``label``: how tables call its methods ("": by their names). ``module``: makes
    its methods (None: they cannot run). ``settings``: keys of its entries besides those of any
    kind. ``files``: those that a method is made of, from the settings of its entry. ``network``:
    ``module:class``; such methods are trained. ``tiles_at_once``: whether several
    tiles of a scene are worked on at once, a thread each; else the method itself has all threads.
    ``extra``: that this package is installed with for it.
    """

    label: str = ""
    module: str | None = None
    settings: tuple[str, ...] = ()
    files: Files = _none
    network: str | None = None
    tiles_at_once: bool = False
    extra: str = ""

    @property
    def is_network(self) -> bool:
        """Whether its methods are trained."""
        return self.network is not None

    @property
    def modules(self) -> list[str]:
        """Modules that hold its own code."""
        network = (self.network or "").partition(":")[0]
        return [module for module in (self.module, network) if module]


def _network(label: str, of: str) -> Kind:
    return Kind(
        label,
        "stereobench.networks.inference",
        settings=("weights", "training", "device", "precision", "uncertainty", "scaling"),
        files=_weights,
        network=f"stereobench.networks.{of}",
        extra="networks",
    )


KINDS = {
    "sgm": Kind(
        "SGM",
        "stereobench.methods.sgm",
        settings=(
            "mode", "block_size", "p1", "p2", "uniqueness_percent", "left_right_px", "speckle_px",
            "speckle_range_px", "prefilter_cap", "uncertainty",
        ),
        tiles_at_once=True,
    ),
    "pandora": Kind(
        "Pandora",
        "stereobench.methods.pandora_pipeline",
        settings=("pipeline",),
        files=_pipeline,
        extra="pandora",
    ),
    "stereonet": _network("StereoNet", "cost_volume_networks:StereoNet"),
    "psmnet": _network("PSM-Net", "cost_volume_networks:PSMNet"),
    "hmsmnet": _network("HMSM-Net", "cost_volume_networks:HMSMNet"),
    "densemapnet": _network("DenseMapNet", "densemapnet:DenseMapNet"),
    "function": Kind(
        module="stereobench.methods.user_methods",
        settings=("function", "options", "margin_px"),
        files=_code,
    ),
    "command": Kind(
        module="stereobench.methods.user_methods",
        settings=("command", "pairs", "suffix", "uncertainty", "files", "margin_px"),
        files=_program,
    ),
    FOLDER: Kind(settings=("folder",), files=_results),
}  # fmt: skip
NETWORKS = tuple(name for name, kind in KINDS.items() if kind.is_network)


def kind_of(name: str, settings: Mapping[str, Any]) -> Kind:
    """The kind of a method's entry. Raises InputError for an unknown one, or an unknown setting."""
    kind = settings.get("kind")
    if kind not in KINDS:
        raise InputError(
            f"method {name!r} is of unknown kind {kind!r}",
            remedy=f"take one of {', '.join(KINDS)}",
        )
    known = (*KINDS[kind].settings, *MOVED, *TOLD)
    for key in settings:
        if key != "kind" and key not in known:
            raise InputError(
                f"method {name!r} is of kind {kind!r}, which has no setting {key!r}",
                remedy=f"take it away, or one of {', '.join(known)} (config/README.md)",
            )
    listed = settings.get("files") or ()
    for value in (*(settings.get(key) for key in PATHS), *listed):
        if isinstance(value, str) and PATTERN.search(value):
            raise InputError(
                f"method {name!r}: {value} has a name in {{ }}, which stands for something else in "
                "the workflow",
                remedy="rename it",
            )
    return KINDS[kind]


def names_of(files: Sequence[Path]) -> dict[str, Path]:
    """The files by their paths below the folder that they share."""
    if not files:
        return {}
    shared = Path(os.path.commonpath([file.absolute().parent for file in files]))
    return {file.absolute().relative_to(shared).as_posix(): file for file in files}


def need_pytorch(name: str, kind: str) -> None:
    """Raise InputError unless ``kind`` is a network's and what trains it is installed."""
    if kind not in NETWORKS:
        raise InputError(
            f"method {name!r} is of kind {kind!r}, which is not trained",
            remedy=f"take one of kind {', '.join(NETWORKS)}, or give it weights",
        )
    if not find_spec("torch"):
        raise InputError(
            f"{kind} needs PyTorch, which is not installed",
            remedy=install_extra(KINDS[kind].extra),
        )
