"""What a new project holds, and copies of profiles."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.errors import InputError
from stereotruth.project.main import app
from stereotruth.project.new_project import (
    KEYS,
    SHIPPED,
    begin,
    configuration_text,
    copy_profile,
    list_profiles,
)
from stereotruth.project.project import FILES, configured, read_rows


def test_a_new_project_is_read_and_empty(tmp_path, monkeypatch):
    """In the folder where one is, too; nothing is written over."""
    monkeypatch.chdir(tmp_path)
    run = CliRunner().invoke(app, ["init", "."])
    assert run.exit_code == 0 and "Next: stereotruth scene add" in run.output
    settings, files = configured()
    assert files == "config.yaml" and settings.scenes == "scenes.tsv"
    assert read_rows(settings) == ({}, {}, {}) and Path("gcps").is_dir()
    for folder in (tmp_path, ""):
        with pytest.raises(InputError):
            begin(folder)


def test_what_is_commented_are_the_defaults():
    """Whoever removes the signs in front of all keys changes nothing."""
    lines = configuration_text().splitlines()
    text = "\n".join(line.removeprefix("# ") for line in lines[2:])
    values = yaml.safe_load(text)
    assert set(values) == set(KEYS) | {"scenes", "cities", "images"}
    assert all(set(values[section]) == set(keys) for section, keys in KEYS.items() if keys)
    sheets = {name: f"{name}.tsv" for name in ("scenes", "cities", "images")}
    assert Configuration.of(values) == Configuration.of(sheets)


def test_profiles_are_listed_and_copied_once(tmp_path, monkeypatch):
    folders = {folder.name for folder in (FILES / "profiles").iterdir() if folder.is_dir()}
    assert set(SHIPPED) == folders
    assert [line.split()[0] for line in list_profiles()[: len(SHIPPED)]] == list(SHIPPED)
    monkeypatch.chdir(tmp_path)
    said = copy_profile("slurm", Path("my-site"))
    assert said.endswith("stereotruth run --profile my-site -n")
    shipped = FILES / "profiles" / "slurm" / "config.yaml"
    assert Path("my-site/config.yaml").read_bytes() == shipped.read_bytes()
    for name in ("slurm", "slrum"):
        with pytest.raises(InputError):
            copy_profile(name, Path("my-site"))
