"""The workflow with its numerics, whose jobs fail when they are asked to.

As in :mod:`.hollow_workflow`, at the same moments and in the same ways; besides, jobs are killed,
alone or with their node, at any time of their work. Each script begins with :func:`arm`.
"""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stereotruth.products import atomic_outputs, files

from .disturbed_stages import _edit_gcps, _edit_laz
from .hollow_workflow import FAULT, fault_of
from .project import MADE, Project, hashes

TARGETS = ("tiles/Tiny", "dataset")
BEGIN = 'if __name__ == "__main__":\n'
ARM = "    from tests.synthetic.faulty_workflow import arm\n\n    arm(snakemake)\n"
INPUTS: dict[str, Callable[[bytes], bytes]] = {
    "in/gcps.csv": _edit_gcps,
    "in/lidar/Tiny-1_0_1.laz": _edit_laz,
    "tiny.yaml": lambda data: data.replace(b"size: 128", b"size: 96"),
}


class FaultyProject:
    """A project of the small city, each of whose INPUTS has one of two versions."""

    def __init__(self, made: Project, folder: Path) -> None:
        for name in ("faulty", "reference"):
            shutil.rmtree(folder / name, ignore_errors=True)
        self.project = made.copy(folder / "faulty")
        for script in (self.project.folder / "workflow/scripts").glob("*.py"):
            script.write_text(script.read_text().replace(BEGIN, BEGIN + ARM, 1))
        self.reference = made.copy(folder / "reference")
        first = {name: (made.folder / name).read_bytes() for name in INPUTS}
        self.versions = {name: (data, INPUTS[name](data)) for name, data in first.items()}
        self.state = dict.fromkeys(INPUTS, 0)
        self._known: dict[tuple[int, ...], dict[str, str]] = {}

    def edit(self, name: str) -> None:
        """Give an input its other version."""
        self.state[name] = 1 - self.state[name]
        (self.project.folder / name).write_bytes(self.versions[name][self.state[name]])

    def expected(self) -> dict[str, str]:
        """Checksums of all that a run makes of the inputs that are there, from scratch."""
        key = tuple(self.state.values())
        if key not in self._known:
            folder = self.reference.folder
            for top in MADE:
                shutil.rmtree(folder / top, ignore_errors=True)
            for name, which in self.state.items():
                (folder / name).write_bytes(self.versions[name][which])
            run = self.reference.snakemake(*TARGETS, "--configfile", "tiny.yaml")
            assert run.status == 0, run.text[-4000:]
            self._known[key] = products(folder)
        return self._known[key]

    def stale(self) -> list[str]:
        """Products that an undisturbed run of what is there makes otherwise, or that are absent.

        Products in the middle may be absent.
        """
        found, wanted = products(self.project.folder), self.expected()
        wrong = [name for name, value in found.items() if wanted.get(name) != value]
        needed = (name for name in wanted if name.startswith(("tiles/", "dataset/")))
        return sorted(wrong) + sorted(f"{name} is absent" for name in needed if name not in found)


def products(folder: Path) -> dict[str, str]:
    """Checksums of what runs have made, without what they keep for themselves."""
    found = {
        f"{top}/{name}": value
        for top in ("results", "tiles", "dataset")
        for name, value in hashes(folder / top).items()
    }
    return {name: value for name, value in found.items() if "/." not in name}


def arm(snakemake: Any) -> None:
    """In a job's process: have it fail, if ``fault.json`` asks for it."""
    fail_at = fault_of(snakemake.rule)
    job = atomic_outputs._Job
    begin, write, take_place = job.__init__, atomic_outputs.write_record, files.atomically

    def begun(self: Any, *arguments: Any) -> None:
        begin(self, *arguments)
        fail_at("begun")

    def recorded(record: Any) -> None:
        fail_at("written")
        write(record)
        fail_at("recorded")

    @contextmanager
    def half(path: Any) -> Iterator[None]:
        with take_place(path):
            yield
        if str(path) in snakemake.output:
            fail_at("half")

    job.__init__, atomic_outputs.write_record, files.atomically = begun, recorded, half
    fault = json.loads(FAULT.read_text()).get(snakemake.rule, {}) if FAULT.exists() else {}
    if fault.get("moment") == "at work":
        threading.Timer(fault["seconds"], fail_at, ["at work"]).start()
    fail_at("start")
