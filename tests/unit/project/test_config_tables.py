"""The files that follow from the sections of the configuration."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.config.section import attributes_of, nested
from stereotruth.project.config_tables import defaults_text, with_tables

ROOT = Path(__file__).parents[3]
REMEDY = "run: python -m stereotruth.project.config_tables"


def test_the_file_of_defaults_follows_from_the_sections():
    text = (ROOT / "config" / "config.yaml").read_text()
    assert defaults_text() == text, REMEDY
    assert Configuration.of(yaml.safe_load(text)) == Configuration()


def test_the_reference_follows_from_the_sections():
    guide = (ROOT / "config" / "README.md").read_text()
    assert with_tables(guide) == guide, REMEDY
    assert guide.count("<!-- keys: ") == guide.count("<!-- end -->") == 5


def keys(of, before=""):
    """All keys of a section, by their full names."""
    for name, key in attributes_of(of).items():
        inner = nested(key.type)[0]
        yield (f"{before}{name}", key, inner)
        if inner is not None:
            yield from keys(inner, f"{before}{name}.")


@pytest.mark.parametrize(("name", "key", "inner"), keys(Configuration), ids=lambda v: str(v)[:60])
def test_every_key_says_what_it_is(name, key, inner):
    assert key.meaning or inner is not None or name == "benchmark.methods.kind"
