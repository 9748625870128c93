"""Every command of docs/tutorial.md runs, and says what the page shows."""

from __future__ import annotations

import json

import pytest

from ..synthetic.tutorial import PAGE, agrees, commands


def test_what_does_not_agree_would_be_found():
    assert agrees(["a 1.5 px", "b"], ["a 2 px", "..."])
    assert agrees(["x", "y", "z"], ["...", "z"])
    assert not agrees(["a 1.5 m"], ["a 1.5 px"])
    assert not agrees(["x", "y"], ["x"])
    assert not agrees(["x"], ["...", "y"])
    assert not agrees(["x"], [])


def test_the_page_has_the_commands_that_a_scene_needs():
    words = [" ".join(command.split()[:3]) for command, _ in commands(PAGE.read_text("utf-8"))]
    for needed in ("init quarry", "gcps import", "scene add", "check", "run tiles/Quarry"):
        assert any(f"stereotruth {needed}" in word for word in words), needed


@pytest.mark.slow
def test_every_command_says_what_the_page_shows(toured):
    found = json.loads((toured / "said.json").read_text())
    for (command, shown), (status, said) in zip(commands(PAGE.read_text("utf-8")), found):
        assert status == 0, "\n".join([command, *said[-40:]])
        assert agrees(said, shown), "\n".join([command, *said])
