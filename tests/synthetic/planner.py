"""Plans by a process that has Snakemake imported, and forks for each of them.

A plan takes 3 s of processor time, of which the imports and the search for plug-ins are 2.5. Runs
that make something are processes of their own, as a user starts them.
"""

from __future__ import annotations

import atexit
import json
import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


class Planner:
    """Answers calls of Snakemake, one at a time."""

    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        atexit.register(self.close)

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()

    def ask(self, folder: Path, arguments: list[str], environment: dict[str, str]) -> int:
        """Exit status of a call in ``folder``, whose output goes to ``folder``/plan.log."""
        call = {"folder": str(folder), "arguments": arguments, "environment": environment}
        self.process.stdin.write(json.dumps(call) + "\n")
        self.process.stdin.flush()
        return int(self.process.stdout.readline())


@cache
def planner() -> Planner:
    """The planner of this test process."""
    return Planner()


def _answer(call: dict[str, Any]) -> None:
    from snakemake.cli import main

    out = os.open(Path(call["folder"], "plan.log"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(out, stream)
    os.chdir(call["folder"])
    os.environ.clear()
    os.environ.update(call["environment"])
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:] = ["", *paths, *(path for path in sys.path[1:] if path not in paths)]
    sys.argv = ["snakemake", *call["arguments"]]
    main()


def _serve() -> None:
    """Import what any plan does, but nothing of this package: a project may have its own."""
    import nbformat  # noqa: F401
    import numpy  # noqa: F401
    import pydantic  # noqa: F401
    import smart_open  # noqa: F401
    import snakemake.cli
    import snakemake.storage

    snakemake.cli.get_argument_parser()  # which finds the plug-ins
    for line in sys.stdin:
        child = os.fork()
        if not child:
            status = 1
            try:
                _answer(json.loads(line))
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else int(end.code is not None)
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)


if __name__ == "__main__":
    _serve()
