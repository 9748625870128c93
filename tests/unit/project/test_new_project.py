"""What a new project holds."""

from __future__ import annotations

import pytest
import yaml
from typer.testing import CliRunner

from stereotruth.core.config.configuration import Configuration
from stereotruth.core.errors import InputError
from stereotruth.core.sheets import read_cities, read_scenes
from stereotruth.project.main import app
from stereotruth.project.new_project import KEYS, begin, configuration_text
from stereotruth.project.project import configured


def test_a_new_project_is_read_and_empty(tmp_path, monkeypatch):
    begin(tmp_path / "new")
    monkeypatch.chdir(tmp_path / "new")
    settings, files = configured()
    assert files == "config.yaml"
    assert settings.scenes == "scenes.tsv"
    cities = read_cities(settings.cities)
    assert cities == {} and read_scenes(settings.scenes, cities) == {}
    assert (tmp_path / "new" / "gcps").is_dir()


def test_what_is_commented_are_the_defaults():
    """Whoever removes the signs in front of all keys changes nothing."""
    lines = configuration_text().splitlines()
    text = "\n".join(line.removeprefix("# ") for line in lines[2:])
    values = yaml.safe_load(text)
    assert set(values) == set(KEYS) | {"scenes", "cities"}
    assert all(set(values[section]) == set(keys) for section, keys in KEYS.items() if keys)
    sheets = {"scenes": "scenes.tsv", "cities": "cities.tsv"}
    assert Configuration.of(values) == Configuration.of(sheets)


def test_nothing_is_written_over(tmp_path):
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(InputError, match="not empty"):
        begin(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["mine.txt"]


def test_the_folder_where_one_is_may_be_the_project(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = CliRunner().invoke(app, ["init", "."])
    assert run.exit_code == 0 and "Next: stereotruth scene add" in run.output
    assert (tmp_path / "config.yaml").is_file()
    with pytest.raises(InputError, match="no folder is named"):
        begin("")
