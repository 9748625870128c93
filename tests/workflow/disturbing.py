"""Jobs whose inputs change while they run, that are stopped, or outlive their killed run.

    python -m tests.workflow.disturbing --rounds 5 scratch/folder [stage …]

makes small cities in the folder, once, and then disturbs each stage: all cities make a product of
it at the same time, and of each city the job is disturbed by a KIND at a random moment, while the
run ends well or loses Snakemake alone, or all its processes (KILLS). Then runs follow until
Snakemake has nothing to do, stopped jobs go on, and runs follow again. A round has left something
stale if the product is not that of the input that is there, byte by byte, as an undisturbed run
makes it. A line per round goes to rounds.jsonl in the folder, and at the end the table of all that
stand there.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import shutil
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ..synthetic.disturbed_stages import STAGES, Stage, city_names, make_cities
from ..synthetic.forked_snakemake import planner, runner, start_snakemake
from ..synthetic.forks import Fork, Forker
from ..synthetic.project import Project
from .killing import family, kill

NOT_CONTENT = ".snakemake_timestamp"  # of Snakemake, in folders whose job has ended
KINDS = ("edit", "replace", "revert", "stop")
KILLS = ("none", "snakemake", "tree")
LONGEST = 60.0  # s, that a run may wait for a stopped job before that goes on


@dataclass
class Cities:
    """Cities of a folder, of which each has one of two versions of a stage's input."""

    folder: Path
    stage: Stage
    names: Sequence[str]

    def __post_init__(self) -> None:
        self.aside = self.folder / "aside" / self.stage.rule
        self.version = dict.fromkeys(self.names, "A")

    def input(self, city: str) -> Path:
        return self.folder / self.stage.input.format(c=city)

    def products(self, city: str) -> list[Path]:
        return [self.folder / p.format(c=city) for p in self.stage.products]

    def keep(self, city: str, version: str) -> None:
        """Lay a copy of the input aside."""
        place = self.aside / version / city
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        source = self.input(city)
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, place / "input")

    def put(self, city: str, version: str, way: str) -> None:
        """Give a city a version of the input, written in place or put in the place of the old."""
        source, target = self.aside / version / city / "input", self.input(city)
        scratch = target.with_name(f".{target.name}.new")
        if source.is_dir():
            shutil.copytree(source, scratch)
            (scratch / NOT_CONTENT).touch()  # as new as a product that a job has just made
            if target.exists():
                target.rename(target.with_name(f".{target.name}.away"))
            scratch.rename(target)
            shutil.rmtree(target.with_name(f".{target.name}.away"), ignore_errors=True)
        elif way == "replace":
            shutil.copyfile(source, scratch)
            scratch.replace(target)
        else:
            with target.open("r+b") as stream:
                stream.write(source.read_bytes())
                stream.truncate()
        self.version[city] = version

    def remove_products(self, city: str) -> None:
        for path in self.products(city):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def hashes(self, city: str) -> dict[str, str]:
        """Content of the city's products by name."""
        found = {}
        for path in self.products(city):
            for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
                if file.is_file() and file.name != NOT_CONTENT:
                    name = str(file.relative_to(self.folder))
                    found[name] = _content(file)
        return found


def _damage(path: Path) -> None:
    """Flip a bit in the last byte of a file, or of the first file in a folder."""
    file = next(f for f in sorted(path.rglob("*")) if f.is_file()) if path.is_dir() else path
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)


def _content(file: Path) -> str:
    if file.suffix == ".pt":
        import torch

        weights = torch.load(file, weights_only=False)["weights"]
        data = b"".join(t.numpy().tobytes() for t in weights.values())
    else:
        data = file.read_bytes()
    return hashlib.sha256(data).hexdigest()


class Harness:
    """Disturbs one stage after the other in the cities of a folder."""

    def __init__(
        self, project: Project, names: Sequence[str], seed: int, forker: Forker | None = None
    ) -> None:
        self.project, self.folder, self.names = project, project.folder, list(names)
        self.rng, self.forker = random.Random(seed), forker or planner()

    def begin(self, *targets: str) -> Fork:
        cores = str(2 * len(self.names))
        settings = ("--configfile", "my.yaml", "--keep-going", "--cores", cores)
        return start_snakemake(self.forker, self.folder, [*targets, *settings], "run.log")

    def settle(
        self, *targets: str, free: Callable[[], None] = lambda: None, rest: bool = True
    ) -> int:
        """Runs until one ends well, with ``rest`` until there is nothing to do; how many.

        ``free``: lets stopped jobs go on, called when a run has waited for long.
        """
        for number in range(1, 7):
            run = self.begin(*targets)
            end = time.monotonic() + LONGEST
            while run.poll() is None:
                if time.monotonic() > end:
                    free()
                time.sleep(0.1)
            if run.returncode == 0 and (not rest or "Nothing to be done" in self.said()):
                return number
        raise AssertionError(f"does not come to rest: {self.said()[-4000:]}")

    def said(self) -> str:
        return (self.folder / "run.log").read_text()

    def prepare(self, stage: Stage) -> tuple[Cities, dict[str, dict[str, dict[str, str]]]]:
        """All cities with version A; what the stage makes of A and B, by city, where it is sure.

        Version B of a product of the workflow is damaged: what is made of it is what A gives.
        """
        cities = Cities(self.folder, stage, self.names)
        targets = [str(cities.products(c)[0].relative_to(self.folder)) for c in self.names]
        self.settle(*targets, rest=False)
        for city in self.names:
            cities.keep(city, "A")
            cities.keep(city, "B")
            place = cities.aside / "B" / city / "input"
            if stage.other is not None:
                place.write_bytes(stage.other(place.read_bytes()))
            else:
                _damage(place)
        found = [{city: cities.hashes(city) for city in self.names}]
        begin, versions = time.monotonic(), "BA" if stage.other else "A"
        for version in versions:
            for city in self.names:
                cities.put(city, version, "replace")
                cities.remove_products(city)
            self.settle(*targets, rest=False)
            found.append({city: cities.hashes(city) for city in self.names})
        self.seconds = (time.monotonic() - begin) / 2 / len(versions)
        made = {}
        for city in self.names:
            first, other, again = found[0][city], found[-2][city], found[-1][city]
            sure = {name for name, of in first.items() if again.get(name) == of}
            made[city] = {
                version: {name: of for name, of in hashes.items() if name in sure}
                for version, hashes in (("A", first), ("B", other if stage.other else first))
            }
            same = made[city]["A"] == made[city]["B"]
            assert same == (stage.other is None), f"{stage.rule}: both versions give the same"
        return cities, made

    def batch(self, name: str, cities: Cities, made: dict, kinds: Sequence[str]) -> Iterator[dict]:
        """One round in each city."""
        stage, rng = cities.stage, self.rng
        targets = [str(cities.products(c)[0].relative_to(self.folder)) for c in self.names]
        plan = {
            c: {
                "stage": name,
                "kind": rng.choice(kinds),
                "at": rng.uniform(0, 1.2) * rng.random(),
                "city": c,
            }
            for c in self.names
        }
        victim, kill_at = rng.choice(KILLS), rng.uniform(0.2, 1.5)
        logs = {c: self.folder / stage.log.format(c=c) for c in self.names}
        for city in self.names:
            cities.remove_products(city)
            logs[city].unlink(missing_ok=True)
        run = self.begin(*targets)
        began: dict[str, float] = {}
        stopped: dict[str, int] = {}
        waiting: dict[str, list[tuple[float, Callable[[], None]]]] = {}
        killed, all_pids = False, set()
        limit = time.monotonic() + LONGEST
        long = self.seconds

        def act(city: str) -> None:
            kind, pid = plan[city]["kind"], _writer(logs[city], all_pids)
            way = "replace" if kind == "replace" else rng.choice(("edit", "replace"))
            plan[city]["alive"] = pid is not None
            old, new = cities.version[city], "AB".replace(cities.version[city], "")
            now = time.monotonic()
            if kind == "stop" and pid is not None:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGSTOP)
                stopped[city] = pid
                if victim == "none":
                    wait = rng.uniform(0.2, long)
                    waiting[city] = [(now + wait, lambda: go_on(city))]
            cities.put(city, new, way)
            if kind == "revert":
                again = now + rng.uniform(0.0, long / 2)
                waiting[city] = [(again, lambda: cities.put(city, old, way))]

        def go_on(city: str) -> None:
            with suppress(ProcessLookupError):
                os.kill(stopped.pop(city), signal.SIGCONT)

        def free() -> None:
            for city in list(stopped):
                plan[city]["waited"] = True
                go_on(city)

        todo = set(self.names)
        while True:
            now = time.monotonic()
            if run.poll() is None or (killed and victim == "snakemake"):
                all_pids |= set(family(run.pid)[0]) if run.poll() is None else set()
            for city in sorted(todo):
                if city not in began and logs[city].exists():
                    began[city] = now
                due = city in began and now > began[city] + plan[city]["at"] * long
                if due or run.poll() is not None:
                    todo.discard(city)
                    act(city)
            for city in list(waiting):
                if run.poll() is not None and not killed and city in stopped:
                    go_on(city)
                waiting[city] = [(at, do) for at, do in waiting[city] if at > now or do()]
                if not waiting[city]:
                    del waiting[city]
            first = min(began.values(), default=now)
            if victim != "none" and not killed and now > first + kill_at * long and began:
                killed = True
                if run.poll() is None:
                    kill(run, victim)
            if now > limit:
                free()
                limit = now + LONGEST
            if run.poll() is not None and not todo and not waiting:
                break
            time.sleep(0.1)
        runs = self.settle(*targets, free=free, rest=False)
        for city in list(stopped):
            go_on(city)
        end = time.monotonic() + 60
        while any(Path(f"/proc/{pid}").exists() for pid in all_pids) and time.monotonic() < end:
            time.sleep(0.1)
        runs += self.settle(*targets)
        for city in self.names:
            found = cities.hashes(city)
            wanted = made[city][cities.version[city]]
            stale = sorted(n for n, h in wanted.items() if found.get(n) != h)
            if stage.other is None:
                cities.version[city] = "A"  # the damaged one was made again
            yield plan[city] | {"kill": victim, "runs": runs, "stale": stale}

    def rounds(self, names: Sequence[str], count: int, kinds: Sequence[str] = KINDS):
        """Rounds of each of the stages, at least ``count``."""
        for name in names:
            cities, made = self.prepare(STAGES[name])
            done = 0
            while done < count:
                for one in self.batch(name, cities, made, kinds):
                    done += 1
                    yield one
                    if one["stale"]:  # begin anew from what is right
                        cities.remove_products(one["city"])
            for city in self.names:
                cities.put(city, "A", "replace")
                cities.remove_products(city)
            self.settle(*(str(cities.products(c)[0].relative_to(self.folder)) for c in self.names))


def _writer(log: Path, pids: set[int]) -> int | None:
    """The process that writes a log file."""
    for pid in sorted(pids):
        with suppress(OSError):
            for handle in Path(f"/proc/{pid}/fd").iterdir():
                if re.sub(r" \(deleted\)$", "", str(handle.readlink())) == str(log):
                    return pid
    return None


def table(rounds: Sequence[dict]) -> str:
    """Rounds by stage, kind and kill, and how many left something stale."""
    lines = []
    stale = [one for one in rounds if one["stale"]]
    for key in ("stage", "kind", "kill"):
        wrong = Counter(one[key] for one in stale)
        for name, count in Counter(one[key] for one in rounds).items():
            lines.append(f"{key:6} {name:16} {count:4} rounds, {wrong[name]:3} stale")
    return "\n".join([*lines, f"{len(rounds)} rounds, {len(stale)} stale"])


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="of each stage, at least")
    parser.add_argument("--cities", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--data", type=Path, help="a scene of the small city, if it is made")
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--fork-jobs", action="store_true", help="cheaper by their imports")
    parser.add_argument("folder", type=Path)
    parser.add_argument("stages", nargs="*", metavar="stage")
    given = parser.parse_args()
    forker = runner() if given.fork_jobs else planner()
    project = make_cities(given.folder.absolute(), given.cities, given.data)
    harness, found = Harness(project, city_names(given.cities), given.seed, forker), []
    for one in harness.rounds(given.stages or list(STAGES), given.rounds, given.kinds):
        found.append(one)
        with (given.folder / "rounds.jsonl").open("a") as stream:
            stream.write(json.dumps(one) + "\n")
        print(json.dumps(one), flush=True)
    rounds = [json.loads(line) for line in (given.folder / "rounds.jsonl").open()]
    print(table(rounds))  # of earlier calls, too
    sys.exit(any(one["stale"] for one in found))


if __name__ == "__main__":
    main()
