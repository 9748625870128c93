"""The house: in which order its packages import each other, and how its files are kept."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[2]
HOUSE = ROOT / "src"
TESTS = ROOT / "tests"
MOST_LINES = 500  # of a file
MOST_FILES = 239
MOST_FUNCTION_LINES, MOST_PARAMETERS = 100, 10  # ``self`` and ``cls`` apart
# Functions beyond, to be emptied: (lines, parameters).
LONG_FUNCTIONS = {
    "stereotruth.project.main.pairs": (44, 12),  # the options of a command are its parameters
}
# The rooms that are held to the glossary of CONTRIBUTING.md, and words that no variable, argument
# or function has as a part of its name there.
GLOSSARY_ROOMS = ("surface", "labels")
BANNED_WORDS = re.compile(
    r"(^|_)(behind|firm|found|handed|marks|outlines|placed?|porous|pull|said|sheets?|shown|smooth|"
    r"standing|told|trust)(_|$)"
)
BANNED_NAMES = {"of", "way", "look", "outline", "STEP_PX", "CELL_PX"}  # as a whole name
# Rooms by floor: each may import what stands in the lines above its own; what shares a line does
# not know each other.
FLOORS = (
    {"stereotruth.core"},
    {"stereotruth.sensor", "stereotruth.lidar", "stereotruth.pages", "stereocities"},
    {"stereotruth.epipolar"},
    {"stereotruth.surface", "stereotruth.align", "stereotruth.tiles", "stereobench.methods"},
    {"stereotruth.labels", "stereotruth.evaluate"}
    | {"stereobench.scores", "stereobench.networks", "stereobench.audit"},
    {"stereotruth.project"},  # asks all stages what they think of the input; nothing asks it
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}


@cache
def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"))


def names_imported(file: Path, root: Path) -> set[str]:
    """Full names that a file imports of what lies in ``root``, inside functions too."""
    parts = file.relative_to(root).parent.parts
    names = set()
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = parts[: len(parts) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            names |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return names


@cache
def imports(root: Path) -> dict[str, set[str]]:
    """The modules that each module of the packages in ``root`` imports of these."""
    files = {}
    for file in sorted(root.rglob("*.py")):
        parts = file.relative_to(root).with_suffix("").parts
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return {
        module: {name for name in names_imported(file, root) if name in files and name != module}
        for module, file in files.items()
    }


def package(module: str) -> str:
    """The room of a module; empty for a package itself."""
    parts = module.split(".")
    return parts[0] if parts[0] == "stereocities" else ".".join(parts[:2]) if parts[1:] else ""


def circle(arrows: dict[str, set[str]]) -> list[str]:
    """Names along a circle of arrows; empty if there is none."""
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_each_package_imports_only_what_stands_before_it():
    wrong = [
        f"{module} -> {other}"
        for module, others in imports(HOUSE).items()
        for other in others
        if package(other) and package(other) != package(module)
        if FLOOR[package(other)] >= FLOOR.get(package(module), len(FLOORS))  # the logger is above
    ]
    assert wrong == []


def test_every_package_has_its_place_in_the_order():
    assert {package(module) for module in imports(HOUSE)} - {""} == set(FLOOR)
    assert len(FLOOR) <= 16 and len(FLOORS) <= 7


def test_modules_import_each_other_in_no_circle():
    assert circle(imports(HOUSE)) == []


def test_circles_would_be_found():
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})) == {"a", "b", "c"}


def test_packages_hand_no_names_on():
    """A module's parents count for its digest: an import there would tie all rules to it."""
    for file in HOUSE.rglob("*/*/__init__.py"):
        assert len(tree(file).body) == 1 and ast.get_docstring(tree(file)), file


def test_files_are_few_and_short():
    lengths = {
        str(file.relative_to(HOUSE)): len(file.read_text(encoding="utf-8").splitlines())
        for file in HOUSE.rglob("*.py")
    }
    assert {file: n for file, n in lengths.items() if n > MOST_LINES} == {}
    assert len(lengths) <= MOST_FILES


def functions(file: Path) -> Iterator[ast.FunctionDef]:
    """Functions and methods of a file, inner ones too."""
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def size_of(function: ast.FunctionDef) -> tuple[int, int]:
    """Lines with the docstring, without decorators; parameters without self and cls."""
    given = function.args
    names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    lines = function.end_lineno - function.lineno + 1
    return lines, len(names) - (names[:1] in (["self"], ["cls"]))


def test_no_function_is_long_or_has_many_parameters():
    """But for those that are listed; one that has become short leaves the list."""
    beyond = {}
    for file in sorted(HOUSE.rglob("*.py")):
        module = ".".join(file.relative_to(HOUSE).with_suffix("").parts)
        for function in functions(file):
            lines, parameters = size_of(function)
            if lines > MOST_FUNCTION_LINES or parameters > MOST_PARAMETERS:
                beyond[f"{module}.{function.name}"] = lines, parameters
    assert set(beyond) == set(LONG_FUNCTIONS)
    longer = {
        name: (size, LONG_FUNCTIONS[name])
        for name, size in beyond.items()
        if any(now > before for now, before in zip(size, LONG_FUNCTIONS[name]))
    }
    assert longer == {}


def names_given(file: Path) -> set[str]:
    """Names that a file gives to variables, arguments and functions; methods ``of`` apart."""
    names = set()
    for node in ast.walk(tree(file)):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.FunctionDef) and node.name != "of":
            names.add(node.name)
    return names


def is_banned(name: str) -> bool:
    return name in BANNED_NAMES or BANNED_WORDS.search(name.lower()) is not None


def test_names_are_those_of_the_glossary():
    wrong = {
        f"{room}/{file.name}: {name}"
        for room in GLOSSARY_ROOMS
        for file in sorted((HOUSE / "stereotruth" / room).rglob("*.py"))
        for name in names_given(file)
        if is_banned(name)
    }
    assert wrong == set()
    assert is_banned("_sheet_h") and is_banned("of") and not is_banned("offset")


def test_one_constant_has_one_meaning():
    """In the rooms of the glossary no two modules give one name to a constant."""
    homes: dict[str, list[str]] = {}
    for room in GLOSSARY_ROOMS:
        for file in sorted((HOUSE / "stereotruth" / room).rglob("*.py")):
            for node in tree(file).body:
                for target in node.targets if isinstance(node, ast.Assign) else ():
                    for name in ast.walk(target):
                        if isinstance(name, ast.Name) and name.id.isupper():
                            homes.setdefault(name.id, []).append(f"{room}/{file.name}")
    assert {name: files for name, files in homes.items() if len(files) > 1} == {}


def test_the_glossary_says_what_is_said_no_more():
    """Each term's row of CONTRIBUTING.md; the terms themselves are not banned."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = text.partition("## Glossary")[2].partition("\n## ")[0].splitlines()
    terms = [row.split("|")[1].strip() for row in rows if row.startswith("| ")][1:]
    assert len(terms) > 20
    assert [term for term in terms if any(map(is_banned, re.split(r"\W+", term)))] == []


def test_no_test_imports_from_another_test():
    """What tests share stands in tests/synthetic and beside it."""
    found = imports(TESTS)
    assert "unit.test_house" in found
    wrong = [
        f"{module} -> {other}"
        for module, others in found.items()
        for other in others
        if other.rpartition(".")[2].startswith("test_")
    ]
    assert wrong == []


def test_tests_mirror_the_house():
    """tests/unit/<package>/test_<file>.py tests <package>/<file>.py; more may follow the name."""
    modules = set(imports(HOUSE))
    for module in imports(TESTS):
        if not module.startswith("unit.") or not module.rpartition(".")[2].startswith("test_"):
            continue
        of = module.removeprefix("unit.").replace("test_", "")
        names = {m.removeprefix("stereotruth.").removeprefix("stereobench.") for m in modules}
        assert any(of == m or of.startswith(f"{m}_") for m in names) or of in NOT_OF_A_FILE, module


NOT_OF_A_FILE = {"bench", "doors", "house"}


VARIABLES = "CACHE_DIR", "CACHE_LOCATOR_CLASSES", "CPU_NAME", "CPU_FEATURES"
DOCUMENTED = {f"config.{name} = …" for name in VARIABLES}  # Numba's, which may be set
PUBLIC_ALL_THE_SAME = {"_replace", "_asdict", "_fields", "_make"}  # of named tuples


@cache
def names_of_our_own() -> set[str]:
    """What functions, arguments, variables and attributes are called in the packages."""
    found = set(PUBLIC_ALL_THE_SAME)
    for file in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(tree(file)):
            match node:
                case ast.FunctionDef(name=name) | ast.arg(arg=name) | ast.Name(id=name):
                    found.add(name)
                case ast.Attribute(value=ast.Name(id="self"), attr=name, ctx=ast.Store()):
                    found.add(name)
    return found


def private_parts(text: str) -> set[str]:
    """Private names of dependencies in a module, and their attributes that it assigns to."""
    own = re.compile(rf"(stereo\w+|{'|'.join(sys.stdlib_module_names)})(\.|$)")
    foreign, found = set(), set()
    nodes = list(ast.walk(ast.parse(text)))
    for node in nodes:
        match node:
            case ast.Import(names=names):
                others = [name for name in names if not own.match(name.name)]
            case ast.ImportFrom(module=module, names=names, level=0) if not own.match(module):
                others = [*names, ast.alias(module)]
            case _:
                continue
        foreign |= {(name.asname or name.name).partition(".")[0] for name in others}
        found |= {n.name for n in others if re.search(r"(^|\.)_[A-Za-z]", n.name)}
    for node in nodes:
        match node:
            case ast.Attribute(value=of, attr=name, ctx=ctx):
                root = ast.unparse(of).partition(".")[0]
                is_ours = root not in foreign and name in names_of_our_own()
                is_private = re.match(r"_(?!_)", name) and root not in sys.stdlib_module_names
                if is_private and not is_ours and root != "self":
                    found.add(ast.unparse(node))
                if root in foreign and isinstance(ctx, ast.Store):
                    found.add(f"{ast.unparse(node)} = …")
            case ast.Call(func=ast.Name(id="setattr"), args=[of, *_]):
                if ast.unparse(of).partition(".")[0] in foreign:
                    found.add(ast.unparse(node))
    return found


def test_no_private_part_of_a_dependency_is_used():
    files = [*(ROOT / "src").rglob("*.py"), *(ROOT / "workflow/scripts").glob("*.py")]
    used = {str(file): private_parts(file.read_text(encoding="utf-8")) for file in files}
    assert {file: found - DOCUMENTED for file, found in used.items() if found - DOCUMENTED} == {}


def test_no_private_part_of_snakemake_is_used():
    for file in (ROOT / "Snakefile", *(ROOT / "workflow/rules").glob("*.smk")):
        text = file.read_text(encoding="utf-8")
        private = re.findall(r"\w\._[a-z]\w*|import .*\b_[a-z]\w*|setattr\(", text)
        assert private + re.findall(r"^(?:workflow|[A-Z]\w+)\.[\w.]+ = .*", text, re.M) == []


def test_private_parts_are_found():
    for text in (
        "from snakemake.io import _IOFile",
        "import numba._helpers",
        "import numba\nnumba.core._lock",
        "from snakemake.jobs import Job\nJob.cleanup = None",
        "from snakemake.jobs import Job\nsetattr(Job, name, None)",
        "def f(storage):\n    return storage._strip(1)",
    ):
        assert private_parts(text), text
