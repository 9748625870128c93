"""Profiles of the package, copied into a project."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.project.new_project import SHIPPED, copy_profile, list_profiles
from stereotruth.project.project import FILES


def test_every_profile_of_the_package_is_listed():
    folders = {folder.name for folder in (FILES / "profiles").iterdir() if folder.is_dir()}
    assert set(SHIPPED) == folders
    assert [line.split()[0] for line in list_profiles()[: len(SHIPPED)]] == list(SHIPPED)


def test_a_copy_is_written_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = copy_profile("slurm", Path("my-site"))
    assert said.endswith("stereotruth run --profile my-site -n")
    shipped = FILES / "profiles" / "slurm" / "config.yaml"
    assert Path("my-site/config.yaml").read_bytes() == shipped.read_bytes()
    with pytest.raises(InputError, match="my-site: is there already"):
        copy_profile("slurm", Path("my-site"))
    with pytest.raises(InputError, match=r"no profile 'slrum'.*default, slurm, s3"):
        copy_profile("slrum")
