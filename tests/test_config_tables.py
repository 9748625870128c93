"""The files that follow from the sections of the configuration."""

from __future__ import annotations

from pathlib import Path

import yaml
from config_tables import defaults_text, with_tables

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.config.section import attributes_of, nested

CONFIG = Path(__file__).parents[1] / "config"
REMEDY = "run: python docs/config_tables.py"


def test_the_file_of_defaults_follows_from_the_sections():
    text = (CONFIG / "config.yaml").read_text()
    assert defaults_text() == text, REMEDY
    assert Configuration.of(yaml.safe_load(text)) == Configuration()


def test_the_reference_follows_from_the_sections():
    guide = (CONFIG / "README.md").read_text()
    assert with_tables(guide) == guide, REMEDY
    assert guide.count("<!-- keys: ") == guide.count("<!-- end -->") == 5


def keys(of, before=""):
    """All keys of a section, by their full names."""
    for name, key in attributes_of(of).items():
        inner = nested(key.type)[0]
        yield (f"{before}{name}", key, inner)
        if inner is not None:
            yield from keys(inner, f"{before}{name}.")


def test_every_key_says_what_it_is():
    silent = {name for name, key, inner in keys(Configuration) if inner is None and not key.meaning}
    assert silent <= {"benchmark.methods.kind"}
