"""The commands of a page and what it says of their output; a session of them in a folder.

``python -m tests.synthetic.tutorial`` prints what the commands of docs/tutorial.md say today.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .project import ROOT

PAGE = ROOT / "docs/tutorial.md"
BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ELLIPSIS = "..."


def commands(page: str) -> Iterator[tuple[str, list[str]]]:
    """Each command of the page's console blocks, and the lines of output that follow it."""
    for block in BLOCK.findall(page):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, *output = part.splitlines()
            yield command, output


def shape(line: str) -> str:
    """A line without its numbers, for they move a little, and with single blanks."""
    return " ".join(re.sub(r"[-+−]?\d+(?:\.\d+)?", "#", line).split())


def agrees(said: list[str], shown: list[str]) -> bool:
    """Whether a command's output has the lines that a page shows; ``...`` stands for any lines."""
    if not shown:
        return not said
    if shown[0] == ELLIPSIS:
        return any(agrees(said[n:], shown[1:]) for n in range(len(said) + 1))
    return bool(said) and shape(said[0]) == shape(shown[0]) and agrees(said[1:], shown[1:])


class Session:
    """Commands one after the other in a shell that finds ``stereotruth``; ``cd`` lasts."""

    def __init__(self, folder: Path) -> None:
        """Begin in a folder."""
        self.place = folder
        program = folder / ".bin/stereotruth"
        program.parent.mkdir(exist_ok=True)
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m stereotruth.project.main "$@"\n')
        program.chmod(0o755)
        paths = (program.parent, Path(sys.executable).parent, os.environ["PATH"])
        self.environment = {
            **os.environ,
            "PATH": os.pathsep.join(map(str, paths)),
            "COLUMNS": "200",
            "LC_ALL": "C.UTF-8",
        }

    def run(self, command: str) -> tuple[int, list[str]]:
        """Exit status and lines of both streams."""
        if command.startswith("cd "):
            self.place /= command.removeprefix("cd ")
            return 0, []
        done = subprocess.run(
            ["bash", "-c", command],
            cwd=self.place,
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=900,
        )
        return done.returncode, [line for line in done.stdout.splitlines() if line.strip()]


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        session = Session(Path(folder))
        for command, _ in commands(PAGE.read_text(encoding="utf-8")):
            print(f"$ {command}", *session.run(command)[1], sep="\n")
