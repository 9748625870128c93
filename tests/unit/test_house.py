"""The house: in which order its packages import each other, and how its files are kept."""

from __future__ import annotations

import ast
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HOUSE = ROOT / "src" / "stereotruth"
TESTS = ROOT / "tests"
MOST_LINES = 520
# Each may import what stands in the lines above its own; what shares a line does not know each
# other.
ORDER = (
    {"errors", "kernel_cache"},
    {"kernels"},
    {"error_statistics", "job", "settings"},
    {"settings_text"},
    {"sheets"},
    {"products"},
    {"lidar", "epipolar", "simulate"},
    {"alignment", "dataset"},
    {"disparity", "report"},
    {"evaluation", "matching"},
    {"configuration", "last_lines"},
    {"project"},
    {"command"},  # asks all stages what they think of the input, and nothing asks it
)
FLOOR = {package: floor for floor, packages in enumerate(ORDER) for package in packages}


def names_imported(file: Path, root: Path, name: str) -> set[str]:
    """Full names that a file imports of the package ``name`` in ``root``, inside functions too."""
    parts = [name, *file.relative_to(root).parent.parts]
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = parts[: len(parts) - node.level + 1] if node.level else []
            base = ".".join([*base, *([node.module] if node.module else [])])
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return {other for other in found if other.startswith(f"{name}.")}


@cache
def imports(root: Path) -> dict[str, set[str]]:
    """The modules that each module of the package in ``root`` imports; names without the root's."""
    files = {}
    for file in sorted(root.rglob("*.py")):
        parts = file.relative_to(root).with_suffix("").parts
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return {
        module: {
            other
            for name in names_imported(file, root, root.name)
            if (other := name.removeprefix(f"{root.name}.")) in files and other != module
        }
        for module, file in files.items()
    }


def package(module: str) -> str:
    """The package of a module, or the module itself where it stands in the hall."""
    return module.partition(".")[0]


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
        if module and package(other) != package(module)
        if FLOOR[package(other)] >= FLOOR[package(module)]
    ]
    assert wrong == []


def test_every_package_has_its_place_in_the_order():
    assert {package(module) for module in imports(HOUSE)} - {""} <= set(FLOOR)


def test_modules_import_each_other_in_no_circle():
    assert circle(imports(HOUSE)) == []


def test_packages_import_each_other_in_no_circle():
    """Packages within packages, as evaluation.audit, count as rooms of their own."""
    rooms = {
        ".".join(file.relative_to(HOUSE).parent.parts) for file in HOUSE.rglob("*/__init__.py")
    }

    def room(module: str) -> str:
        return module if module in rooms else module.rpartition(".")[0] or module

    arrows: dict[str, set[str]] = {}
    for module, others in imports(HOUSE).items():
        # what a parent's __init__ imports, its rooms do not have to
        arrows.setdefault(room(module), set()).update({room(other) for other in others})
    for name, others in arrows.items():
        others.discard(name)
    assert circle(arrows) == []


def test_circles_would_be_found():
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}})) == {"a", "b", "c"}


@pytest.mark.parametrize("file", HOUSE.rglob("*/__init__.py"), ids=lambda f: f.parent.name)
def test_packages_hand_no_names_on(file):
    """A module's parents count for its digest: an import there would tie all rules to it."""
    body = ast.parse(file.read_text(encoding="utf-8")).body
    assert len(body) <= 1
    assert all(isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) for node in body)
    assert ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))


def test_no_file_is_long():
    lengths = {
        str(file.relative_to(HOUSE)): len(file.read_text(encoding="utf-8").splitlines())
        for file in HOUSE.rglob("*.py")
    }
    assert {file: n for file, n in lengths.items() if n > MOST_LINES} == {}


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
        assert any(of == m or of.startswith(f"{m}_") for m in modules) or of in NOT_OF_A_FILE, (
            module
        )


NOT_OF_A_FILE = {"bench", "house", "simulate.simulated_scene"}
