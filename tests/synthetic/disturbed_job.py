"""A small job in a process of its own, disturbed at random moments; a run is what starts it.

    python -m tests.synthetic.disturbed_job --rounds 3000 scratch/folder

Hundreds of rounds a minute, so that moments between two products are met, too. A plan is that of
the workflow: a job runs if its records say so, or a product is absent.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import random
import signal
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from stereotruth.errors import InputError
from stereotruth.products import records
from stereotruth.products.atomic_outputs import atomic_outputs
from stereotruth.products.files import atomic_file, atomic_folder
from stereotruth.products.records import mark_begun, why_due
from stereotruth.products.runs import begin_run

SOURCE, FILE, FOLDER = Path("in.csv"), Path("out/a.json"), Path("out/b")
KINDS = ("edit", "replace", "revert", "touch back", "setting", "late")
ENDS = ("none", "orphan", "stop", "kill")


def _work(setting: str, slow: float) -> None:
    """Both products say what was read, and a setting of the run."""
    with atomic_outputs([str(SOURCE)], [str(FILE), str(FOLDER)], {"setting": setting}):
        first = SOURCE.read_text()
        time.sleep(slow)
        with atomic_file(FILE) as scratch:
            scratch.write_text(first + setting)
            time.sleep(slow / 4)
        with atomic_folder(FOLDER) as scratch:
            (scratch / "1").write_text(SOURCE.read_text() + setting)
            time.sleep(slow / 4)


def _start(setting: str, slow: float) -> int:
    mark_begun(FILE)
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        with suppress(InputError):
            _work(setting, slow)
            status = 0
    finally:
        os._exit(status)


def _wake(pid: int) -> None:
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


def _ended(pid: int) -> bool:
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


def _is_due(setting: str) -> bool:
    for function in (records._checksum, records._checksums):
        function.cache_clear()
    why = why_due([FILE, FOLDER], [SOURCE], {"setting": setting})
    return bool(why) or not (FILE.exists() and FOLDER.exists())


def _write(text: str, way: str) -> None:
    if way == "replace":
        new = SOURCE.with_name("new")
        new.write_text(text)
        new.replace(SOURCE)
    else:
        then = SOURCE.stat()
        SOURCE.write_text(text)
        if way == "touch back":
            os.utime(SOURCE, ns=(then.st_atime_ns, then.st_mtime_ns))


class Rounds:
    """Rounds in the working directory, one after the other."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.number, self.setting = 0, ""
        _write_new()

    def run(self) -> bool:
        """A run to its end; whether there was something to do."""
        begin_run()
        if not _is_due(self.setting):
            return False
        _ended(_start(self.setting, 0.0))
        return True

    def round(self) -> tuple[str, str, bool]:
        """Kind, end, and whether something stale is left."""
        rng, self.number = self.rng, self.number + 1
        kind, end = rng.choice(KINDS), rng.choice(ENDS)
        slow = rng.choice((0.0, 0.01))
        old, new = SOURCE.read_text(), f"{self.number:06d}"
        begin_run()
        job = _start(self.setting, slow)
        time.sleep(rng.uniform(0.0, 0.012 + 1.6 * slow))
        if end == "stop":
            os.kill(job, signal.SIGSTOP)
        if end == "kill":
            os.kill(job, signal.SIGKILL)
        if kind == "setting":  # edited when its run is over; else that run's job is right
            self.setting = new
        elif kind != "late":
            _write(new, kind)
        if kind == "revert":
            time.sleep(rng.uniform(0.0, slow))
            _write(old, kind)
        if end == "none":
            _ended(job)
        else:
            if end == "stop":  # it holds its locks until later
                threading.Timer(rng.uniform(0.0, 0.1), _wake, (job,)).start()
            self.run()
            _wake(job)
            _ended(job)
        if kind == "late":  # after the products are there, before anybody looks
            _write(new, rng.choice(("edit", "replace", "touch back")))
        for _ in range(5):
            if not self.run():
                break
        else:
            raise AssertionError("does not come to rest")
        wanted = SOURCE.read_text() + self.setting
        stale = FILE.read_text() != wanted or (FOLDER / "1").read_text() != wanted
        return kind, end, stale


def _write_new() -> None:
    SOURCE.write_text("000000")
    FILE.parent.mkdir(exist_ok=True)


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("folder", type=Path)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    os.chdir(given.folder)
    logging.disable()
    rounds, count, stale = Rounds(given.seed), Counter(), Counter()
    for _ in range(given.rounds):
        kind, end, wrong = rounds.round()
        count[kind, end] += 1
        stale[kind, end] += wrong
    print(json.dumps({" + ".join(k): [n, stale[k]] for k, n in sorted(count.items())}, indent=1))
    print(f"{count.total()} rounds, {stale.total()} stale")


if __name__ == "__main__":
    main()
