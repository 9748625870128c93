"""Single jobs that fail, alone and twice in a row, with edits before, between and after.

    python -m tests.workflow.failing --rounds 300 scratch/folder

goes over all rules of the workflow without its numerics (:mod:`..synthetic.hollow_workflow`). In a
round jobs of one to three rules fail in one of WAYS at one of MOMENTS, once or twice; edits of
users' files and settings, and damage to products and records, come between. The run after a failure
must have the failed job again. After a run that ends well, each product must be of the inputs and
settings that are there. A line per round goes to failures.jsonl in the folder, and at the end the
table of all that stand there.

    python -m tests.workflow.failing --numerics --rounds 20 scratch/folder

does so with the numerics (:mod:`..synthetic.faulty_workflow`): jobs are killed at any time of their
work, too, and each product must have the bytes that a run from scratch gives it.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from ..synthetic import faulty_workflow
from ..synthetic.faulty_workflow import FaultyProject
from ..synthetic.forked_snakemake import runner, start_snakemake
from ..synthetic.hollow_workflow import (
    FAULT,
    GIVEN,
    MOMENTS,
    STRUCK,
    TARGETS,
    WAYS,
    make_hollow,
    set_seed,
    stale,
)
from ..synthetic.project import Project, make_tiny

NO_RULES = ("all", "predict", "benchmark", "report", "evaluate")  # without a job of their own
EDITS = (*(f"in/{name}" for name in GIVEN), "mine.py", "helper.py", "geoid.tif")
AT_WORK, KILLS = "at work", ("kill", "node")
EDITS = (*EDITS, "config/gcps/Wuhan-1.csv", "seed")


class Failures:
    """Rounds in a project, one after the other."""

    call: Sequence[str] = (*TARGETS, "--configfile", "my.yaml", "--cores", "16")
    edits: Sequence[str] = EDITS
    moments: Sequence[str] = MOMENTS
    tops: Sequence[str] = ("results/.records/made", "results", "tiles", "benchmark", "data")

    def __init__(self, project: Project, seed: int) -> None:
        self.project, self.folder = project, project.folder
        self.rng = random.Random(seed)
        self.seed = self.version = 0
        self.reached: dict[str, list[str]] = {}  # rules by the edit that makes them due

    def run(self, *more: str) -> tuple[int, set[str]]:
        """A run's exit status, and the rules that it planned."""
        call = [*self.call, "--scheduler", "greedy", *more]
        status = start_snakemake(runner(), self.folder, call, "run.log").wait()
        return status, self.planned()

    def said(self) -> str:
        return (self.folder / "run.log").read_text()

    def planned(self) -> set[str]:
        tables = self.said().split("Job stats:")
        found = re.findall(r"^(\w+)\s+\d+$", tables[-1], flags=re.MULTILINE)
        return {*found} - {"total", *NO_RULES} if len(tables) > 1 else set()

    def prepare(self, edits: Sequence[str] | None = None) -> None:
        """Make all, and find out which rules edits reach."""
        status, rules = self.run()
        assert status == 0, self.said()[-4000:]
        self.rules = sorted(rules)
        for edit in self.edits if edits is None else edits:
            file = self.folder / (edit if edit != "seed" else "my.yaml")
            before, seed = file.read_bytes(), self.seed
            self.edit(edit)
            status, self.reached[edit] = self.run("--dry-run")
            assert status == 0 and self.reached[edit], (edit, self.said()[-4000:])
            file.write_bytes(before)
            self.seed = seed

    def edit(self, what: str) -> None:
        self.version += 1
        if what == "seed":
            self.seed = self.version
            set_seed(self.project, self.version)
            return
        file = self.folder / what
        if what.endswith(".py"):
            file.write_text(f"{file.read_text().partition('#')[0]}# {self.version}\n")
        else:
            file.write_text(f"{self.version}\n")
        then = time.time() + self.rng.uniform(-1e6, 1e6)  # as by clocks that are off
        os.utime(file, (then, then))

    def damage(self) -> str:
        """Damage or delete a product or a record; returns which."""
        tops = self.rng.choice(self.tops)
        files = [
            file
            for file in sorted((self.folder / tops).rglob("*"))
            if file.is_file() and not file.name.startswith(".") and ".snake" not in file.name
        ]
        if tops == "results":
            files = [file for file in files if ".records" not in file.parts]
        file = self.rng.choice(files)
        if self.rng.random() < 0.3:
            place = file.parent if file.parent.suffix in (".zarr", ".points") else file
            (shutil.rmtree if place.is_dir() else Path.unlink)(place)
        else:
            data = bytearray(file.read_bytes())
            data[self.rng.randrange(len(data))] ^= 1 << self.rng.randrange(8)
            file.write_bytes(data)
        return str(file.relative_to(self.folder))

    def disturb(self, rule: str, chance: float) -> str:
        """An edit, by preference one that makes a rule due, or damage; or nothing."""
        if self.rng.random() > chance:
            return ""
        if self.rng.random() < 0.2:
            return self.damage()
        known = [edit for edit in self.edits if rule in self.reached.get(edit, ())]
        edit = self.rng.choice(known or self.edits)
        self.edit(edit)
        return edit

    def fail(self, rules: Sequence[str]) -> dict[str, dict[str, str]]:
        """A run in which jobs of the rules fail; those that did."""
        faults = {rule: self.fault() for rule in rules}
        (self.folder / FAULT).write_text(json.dumps(faults))
        struck = self.folder / STRUCK
        struck.unlink(missing_ok=True)
        for more in ((), ("--forcerun", *rules)):
            status, _ = self.run("--keep-going", *more)
            hit = {*struck.read_text().split()} & {*faults} if struck.exists() else set()
            if hit:  # not by a job of an earlier run that has lost its node
                break
        (self.folder / FAULT).unlink()
        if not hit:  # a job may end before it fails at work
            assert AT_WORK in {fault["moment"] for fault in faults.values()}, self.said()[-4000:]
            return {}
        assert status != 0, self.said()[-4000:]
        return {rule: faults[rule] for rule in sorted(hit)}

    def fault(self) -> dict[str, Any]:
        """How and when a job fails; after so many ``seconds``, if that is at work."""
        moment = self.rng.choice(self.moments)
        if moment == AT_WORK:
            seconds = self.rng.uniform(0.01, 2.0)
            return {"way": self.rng.choice(KILLS), "moment": moment, "seconds": seconds}
        return {"way": self.rng.choice(WAYS), "moment": moment}

    def stale(self) -> list[str]:
        """Products that are not of what is there."""
        return stale(self.folder, self.seed)

    def round(self) -> dict:
        """One round: what was done, and what is wrong."""
        rng, begin = self.rng, time.monotonic()
        one: dict = {"failed": [], "edits": [], "wrong": []}
        rules = rng.sample(self.rules, rng.choice((1, 1, 2, 3)))
        for number in range(rng.choice((1, 2))):
            if number and rng.random() < 0.5:
                rules = rng.sample(self.rules, 1)
            one["edits"].append(self.disturb(rules[0], 0.5 if number else 0.8))
            failed = self.fail(rules)
            one["failed"].append(failed)
        one["edits"].append(self.disturb(rules[0], 0.3))
        for number in range(5):
            status, planned = self.run()
            for rule, fault in failed.items() if number == 0 and not one["edits"][-1] else ():
                if fault["moment"] not in ("recorded", AT_WORK) and rule not in planned:
                    one["wrong"].append(f"{rule} is not planned after it failed")
            if status == 0:
                break
        else:
            one["wrong"].append(f"does not end well: {self.said()[-2000:]}")
        one["wrong"] += self.stale()
        return one | {"seconds": round(time.monotonic() - begin, 1)}

    def rounds(self, count: int) -> Iterator[dict]:
        """So many rounds; the last one is followed by a run that has nothing to do."""
        for _ in range(count):
            yield self.round()
        status, planned = self.run()
        assert status == 0 and not planned, planned


class RealFailures(Failures):
    """Rounds with the numerics."""

    call = (*faulty_workflow.TARGETS, "--configfile", "tiny.yaml", "--cores", "2")
    edits = tuple(faulty_workflow.INPUTS)
    moments = (*MOMENTS, AT_WORK, AT_WORK, AT_WORK)
    tops = ("results/.records/made", "results", "tiles", "dataset")

    def __init__(self, folder: Path, seed: int) -> None:
        self.faulty = FaultyProject(make_tiny(folder), folder)
        super().__init__(self.faulty.project, seed)

    def prepare(self, edits: Sequence[str] | None = None) -> None:
        """Make all; every edit may come before every rule."""
        super().prepare(edits=())

    def edit(self, what: str) -> None:
        self.faulty.edit(what)

    def stale(self) -> list[str]:
        """Products that a run from scratch makes otherwise."""
        return self.faulty.stale()


def table(rounds: Sequence[dict]) -> str:
    """Failures by rule, way and moment, and how many rounds left something wrong."""
    lines = []
    failed = [(rule, f) for one in rounds for run in one["failed"] for rule, f in run.items()]
    for key, names in (
        ("rule", [rule for rule, _ in failed]),
        *((key, [fault[key] for _, fault in failed]) for key in ("way", "moment")),
    ):
        lines += [f"{key:7} {name:20} {n:4} failures" for name, n in sorted(Counter(names).items())]
    runs = sum(len(one["failed"]) for one in rounds)
    wrong = sum(bool(one["wrong"]) for one in rounds)
    said = f"{len(rounds)} rounds, {runs} runs with {len(failed)} failed jobs, {wrong} rounds wrong"
    return "\n".join([*lines, said])


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--numerics", action="store_true")
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    folder = given.folder.absolute()
    failures: Failures
    if given.numerics:
        failures = RealFailures(folder / "numerics", given.seed)
    else:
        shutil.rmtree(folder / "project", ignore_errors=True)
        failures = Failures(make_hollow(folder / "project"), given.seed)
    failures.prepare()
    wrong = False
    for one in failures.rounds(given.rounds):
        wrong = wrong or bool(one["wrong"])
        with (folder / "failures.jsonl").open("a") as stream:
            stream.write(json.dumps({"seed": given.seed} | one) + "\n")
        print(json.dumps(one), flush=True)
    print(table([json.loads(line) for line in (folder / "failures.jsonl").open()]))
    sys.exit(wrong)


if __name__ == "__main__":
    main()
