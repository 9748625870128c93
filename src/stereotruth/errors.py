"""The one exception that users are meant to read."""

from __future__ import annotations

from pathlib import Path


class InputError(ValueError):
    """Input that cannot be used: names the file (and scene), what is wrong, and the remedy."""

    def __init__(self, problem: str, *, file: str | Path | None = None, remedy: str) -> None:
        self.problem = problem
        self.file = None if file is None else str(file)
        self.remedy = remedy
        where = "" if file is None else f"{file}: "
        super().__init__(f"{where}{problem}. Remedy: {remedy}")
