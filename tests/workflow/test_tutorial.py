"""Every command of docs/tutorial.md runs, and says what the page shows."""

from __future__ import annotations

import re

import pytest

from ..synthetic.project import ROOT
from ..synthetic.tutorial import PAGE, Session, agrees, commands


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
def test_every_command_says_what_the_page_shows(tmp_path):
    """And its tiles are read by the lines of docs/how-to/pytorch.md."""
    session = Session(tmp_path)
    for command, shown in commands(PAGE.read_text(encoding="utf-8")):
        status, said = session.run(command)
        assert status == 0, "\n".join([command, *said[-40:]])
        assert agrees(said, shown), "\n".join([command, *said])
    made = session.run("stereotruth run dataset --cores 2")
    assert made[0] == 0, made[1][-40:]
    read = (ROOT / "docs/how-to/pytorch.md").read_text(encoding="utf-8")
    (session.place / "read.py").write_text(re.search(r"```python\n(.*?)```", read, re.DOTALL)[1])
    status, said = session.run("python read.py")
    assert status == 0 and len(said) == 2 and "(256, 256)" in said[0], said
