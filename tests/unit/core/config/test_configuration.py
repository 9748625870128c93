"""What users may write, and what is refused: by key, with unit, limits and the nearest name."""

from __future__ import annotations

import ast
import time
from pathlib import Path

import pytest

from stereobench.methods import kinds
from stereotruth.core.config import configuration, methods
from stereotruth.core.config.configuration import Configuration
from stereotruth.core.config.section import read_mapping
from stereotruth.core.errors import InputError


def test_entries_by_name_lie_over_those_that_are_not_written():
    mine = {"kind": "sgm", "mode": "hh", "training": {"epochs": 3}}
    methods = {"mine": mine, "psmnet": None}
    datasets = {"synthetic": {"methods": ["mine"]}}
    found = Configuration.of({"benchmark": {"methods": methods, "datasets": datasets}}).benchmark
    assert list(found.methods) == ["sgm", "stereonet", "psmnet", "hmsmnet", "mine"]
    assert found.methods["psmnet"] is None
    assert found.methods["mine"].model_dump(exclude_defaults=True) == mine
    assert found.methods["sgm"].model_dump(exclude_defaults=True) == {"kind": "sgm"}
    assert found.datasets["synthetic"].root == "dataset"
    assert found.datasets["synthetic"].methods == ("mine",)


def with_key(path: str, value: object) -> dict:
    config = inside = {}
    *sections, key = path.split(".")
    for section in sections:
        inside = inside.setdefault(section, {})
    inside[key] = value
    return config


MINE = {"root": "mine", "layout": "whu", "disparity_range": [-64, 64]}


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("tiles.sise", 512, ["unknown key 'sise' under 'tiles'", "did you mean 'size'?"]),
        ("tile", 3, ["unknown key 'tile'.", "did you mean 'tiles'?"]),
        ("tiles", None, ["tiles: None has no keys", "size, stride"]),
        ("seed", "x", ["seed: 'x' should be a valid integer", "whole number"]),
        ("strict", "yes", ["strict: 'yes'", "true, false"]),
        ("tiles.stride", "z", ["tiles.stride: 'z'", "px, null"]),
        ("tiles.min_labelled", 1.5, ["tiles.min_labelled: 1.5", "share, 0 … 1"]),
        ("project.window", 8, ["project.window: 8 should be odd", "odd, 3 … 31"]),
        ("project.recipe", "papr", ["'papr'", "surface, paper"]),
        ("ingest.drop_classes", [7, 7], ["ingest.drop_classes", "a value twice"]),
        ("alignment.fixed", {"S-1": 3}, ["alignment.fixed.S-1: 3", "scene or image: path"]),
        ("strips", 0, ["strips: 0", "1 … 1000"]),
        ("predict.offset", "best", ["predict.offset: 'best'", "px, auto"]),
        ("predict.block_px", 1000, ["1000 should be a multiple of 256"]),
        ("predict.overlap_px", 600, ["predict: blocks of 1024 px with an overlap of 600 px"]),
        ("predict.dsm.resolution", 1, ["'resolution' under 'predict.dsm'", "'resolution_m'?"]),
        ("benchmark.thresholds_px", [], ["benchmark.thresholds_px: [] should have"]),
        ("benchmark.datasets.x", {"root": "r"}, ["benchmark.datasets.x.", "is required"]),
        ("benchmark.datasets.x y", MINE, ["benchmark.datasets.x y: 'x y' should match"]),
        ("benchmark.methods.x", {"kind": "raft"}, ["'raft'", "hmsmnet"]),
        ("benchmark.methods.x", {"kind": "sgm", "training": {"epoch": 1}}, ["'epochs'?"]),
        ("training.crop_px", [64], ["training.crop_px.1: is required"]),
    ],
)
def test_a_wrong_value_is_refused_by_its_key_with_what_it_may_be(path, value, words):
    with pytest.raises(InputError) as refusal:
        Configuration.of(with_key(path, value))
    for word in ["config: ", "Remedy", *words]:
        assert word in str(refusal.value)


def test_what_a_key_may_be_is_taken():
    for path, value in (
        ("benchmark.datasets.x", MINE | {"methods": None}),
        ("benchmark.datasets.synthetic", None),
        ("benchmark.methods.sgm", {"kind": "sgm", "block_size": 5, "label": "mine"}),
        ("strips", {"Wuhan-1": 8}),
        ("predict.offset", -40),
    ):
        assert Configuration.of(with_key(path, value))


def test_kinds_of_methods_are_those_that_there_are():
    assert tuple(kinds.KINDS) == methods.KINDS


def test_sections_declare_and_compute_nothing():
    """No code digest holds them: what a section computed could change without a rule made again."""
    for module in (configuration, methods):
        for section in ast.parse(Path(module.__file__).read_text(encoding="utf-8")).body:
            for node in section.body if isinstance(section, ast.ClassDef) else ():
                if isinstance(node, ast.FunctionDef) and node.name != "of":
                    assert "validator" in ast.unparse(node.decorator_list[0]), node.name


NINES = [", ".join([f"*a{n}"] * 9) for n in range(12)]
NO_MAPPINGS = {
    "half": b"a: [",
    "a list": b"- a\n- b\n",
    "UTF-16": "seed: 1\n".encode("utf-16"),
    "aliases": "a0: &a0 [x]\n" + "".join(f"a{n + 1}: &a{n + 1} [{NINES[n]}]\n" for n in range(11)),
    "merged": "a0: &a0 {x: 1}\n"
    + "".join(f"a{n + 1}: &a{n + 1} {{<<: [{NINES[n]}]}}\n" for n in range(11)),
    "a circle": "a: &a [1, *a]\n",
    "deep": "a: " + "[" * 5000 + "]" * 5000,
    "large": "a: x" + "x" * 1_000_000,
    "twice": "tiles: {size: 256}\nseed: 1\ntiles: {stride: 3}\n",
    "twice inside": "tiles: {size: 256, size: 512}\n",
}


@pytest.mark.parametrize("kind", NO_MAPPINGS)
def test_what_is_no_mapping_is_refused_at_once(tmp_path, kind):
    text = NO_MAPPINGS[kind]
    (tmp_path / "c.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    begun = time.process_time()
    with pytest.raises(InputError, match=r"c\.yaml") as refused:
        read_mapping(tmp_path / "c.yaml")
    assert refused.value.remedy and time.process_time() - begun < 5


def test_aliases_that_do_not_multiply_are_taken(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("a: &a {b: 1}\nc: *a\nd:\n  <<: *a\n  e: 2\n")
    assert read_mapping(file) == {"a": {"b": 1}, "c": {"b": 1}, "d": {"b": 1, "e": 2}}
