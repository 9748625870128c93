"""Snakemake forked from a process that has it imported.

A plan takes 3 s of processor time, of which the imports, those of other packages that this package
takes in a plan, and the search for plug-ins are 2.5.
"""

from __future__ import annotations

import ast
import importlib
import os
import runpy
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from . import forks

RUN = "SNAKEMAKE_OF_JOB"  # variable of the environment: number of the process that runs a job
OF_JOBS = ("xarray", "rasterio", "matplotlib.figure", "rioxarray", "cv2", "scipy.optimize")


def planner() -> forks.Forker:
    """Forks Snakemake, with nothing of this package imported: a project may have its own."""
    return _start(os.environ.get("PYTHONUTF8"))


def runner() -> forks.Forker:
    """Forks Snakemake, whose jobs are forked, too, from a process that has all stages imported."""
    return _start(os.environ.get("PYTHONUTF8"), "jobs")


@cache
def _start(utf8: str | None, *of_jobs: str) -> forks.Forker:
    """One for each ``PYTHONUTF8``, since a process reads that as it starts, and forks keep it."""
    return forks.start(__name__, *of_jobs)


def start_snakemake(
    forker: forks.Forker,
    folder: Path,
    arguments: Sequence[str],
    log: str,
    environment: dict[str, str] | None = None,
) -> forks.Fork:
    """A Snakemake in ``folder``, with a session of its own; it speaks to ``log`` in there."""
    call = {"folder": str(folder), "arguments": [*arguments], "log": log}
    return forker.ask(call | {"environment": environment or dict(os.environ)})


def _begin(call: dict[str, Any]) -> None:
    """Be in the place that a call says."""
    os.setsid()
    out = os.open(Path(call["folder"], call["log"]), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(out, stream)
    os.close(out)
    os.chdir(call["folder"])
    os.environ.clear()
    os.environ.update(call["environment"] | {RUN: str(os.getpid())})
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    sys.path[:] = ["", *paths, *(path for path in sys.path if path not in paths)]
    sys.argv = ["snakemake", *call["arguments"]]


def _run(call: dict[str, Any]) -> None:
    from snakemake.cli import main

    _begin(call)
    main()


def _run_and_fork_jobs(call: dict[str, Any]) -> None:
    from snakemake.cli import main

    _begin(call)
    _fork_jobs(forks.fork(_do_job))
    main()


def _do_job(script: str) -> None:
    runpy.run_path(script, run_name="__main__")


def _fork_jobs(forker: forks.Forker) -> None:
    """Have this Snakemake's scripts run by forks of another process."""
    import snakemake.script

    def execute(self: Any, fname: str, edit: bool = False) -> None:
        begin = time.monotonic()
        status = forker.ask(fname).wait()
        self.bench_record.running_time = time.monotonic() - begin
        if status:
            raise subprocess.CalledProcessError(1, fname)

    snakemake.script.PythonScript.execute_script = execute


def _import_stages() -> None:
    """Import what the scripts do, and what that imports later."""
    for script in (forks.ROOT / "workflow" / "scripts").glob("*.py"):
        for node in ast.walk(ast.parse(script.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stereo"):
                with suppress(ModuleNotFoundError):  # without PyTorch
                    importlib.import_module(node.module)
    for name in OF_JOBS:
        importlib.import_module(name)


def _serve() -> None:
    import cv2  # noqa: F401
    import nbformat  # noqa: F401
    import numba  # noqa: F401
    import pydantic  # noqa: F401
    import rasterio  # noqa: F401
    import smart_open  # noqa: F401
    import snakemake.cli
    import snakemake.storage

    snakemake.cli.get_argument_parser()  # which finds the plug-ins
    if "jobs" in sys.argv:
        _import_stages()
        forks.serve(forks.given(), _run_and_fork_jobs)
    else:
        forks.serve(forks.given(), _run)


if __name__ == "__main__":
    _serve()
