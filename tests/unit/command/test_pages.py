"""The pages of a folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereotruth.command.pages import pages
from stereotruth.errors import InputError
from stereotruth.pages.page import INDEX


def test_pages_are_found_and_chosen(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="stereotruth run report"):
        pages()
    there = [Path("audit/us3d/index.html"), Path("results/report/A/index.html")]
    for page in there:
        page.parent.mkdir(parents=True)
        page.touch()
    assert pages() == [INDEX, *there]  # the index first, which is what opens
    assert "us3d" in INDEX.read_text(encoding="utf-8")
    assert pages(["A"]) == there[1:]
    with pytest.raises(InputError, match="no page of B"):
        pages(["B"])
