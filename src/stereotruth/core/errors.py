"""The one exception that users are meant to read, and what no message may show."""

from __future__ import annotations

import difflib
import errno
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

URL = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]*:/+)([^\s'\"<>]+)")
PAIR = re.compile(
    r"\b((?:x-amz-|x-goog-)[\w-]+|\w*(?:signature|token|passw(?:or)?d|secret|credential|api_?key)|sig)"
    r"=[^\s&'\";]+",
    re.IGNORECASE,
)
HIDDEN = "…"

FULL = (errno.ENOSPC, errno.EDQUOT)
REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS)
GONE = (errno.ENOENT, errno.ENOTDIR)
SYSTEM = {
    FULL: (
        "no space left on the disk",
        "make space there, and run again: what is done is kept (new files need inodes: df -i)",
    ),
    REFUSED: ("no permission", "get the right to it (ls -l), and run again"),
    GONE: (
        "no such file: it was there, and was taken away",
        "put it back, or run again: what is missing of the products is made again",
    ),
}


def without_secrets(text: str) -> str:
    """A text whose URLs have no name, password, query or fragment, so no signature and no token."""
    return PAIR.sub(rf"\1={HIDDEN}", URL.sub(lambda found: found[1] + _shown(found[2]), text))


def _shown(rest: str) -> str:
    """What stands behind ``scheme://``, without what only its owner is to know."""
    who, at, rest = rest.rpartition("@")
    place = re.split(r"[?#]", rest, maxsplit=1)
    return (HIDDEN + at if who else at) + place[0] + ("?" + HIDDEN if len(place) > 1 else "")


def in_number(count: int, noun: str) -> str:
    """``1 pair``, ``2 pairs``."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def did_you_mean(name: str, known: Iterable[str], otherwise: str) -> str:
    """A remedy: the nearest of the known names, or else what ``otherwise`` says."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {close[0]!r}?" if close else otherwise


def install_extra(extra: str) -> str:
    """How an extra of the package is installed, as a remedy: no index has the package itself."""
    return (
        f"install the extra {extra}: pip install '.[{extra}]' in a checkout, "
        f"pip install './stereotruth-VERSION-py3-none-any.whl[{extra}]' beside the wheel"
    )


def require_packages(asked: str, packages: Iterable[str], extra: str) -> None:
    """Raise InputError if a package that ``asked`` needs, of an extra, is not installed."""
    for package in packages:
        if find_spec(package) is None:
            raise InputError(
                f"{asked} needs {package}, which is not installed",
                remedy=f"{install_extra(extra)}; or leave it out",
            )


class InputError(ValueError):
    """Input that cannot be used: names the file (and scene), what is wrong, and the remedy.

    URLs are shown without secrets (:func:`without_secrets`), wherever they stand.
    """

    def __init__(self, problem: str, *, file: str | Path | None = None, remedy: str) -> None:
        self.problem = without_secrets(problem)
        self.file = None if file is None else _name(str(file))
        self.remedy = without_secrets(remedy)
        where = "" if file is None else f"{self.file}: "
        super().__init__(f"{where}{self.problem}. Remedy: {self.remedy}")


def _name(file: str) -> str:
    """A file or URL as messages call it; a URL may hold blanks."""
    scheme, slashes, rest = re.split(r"(:/+)", file, maxsplit=1) if ":/" in file else (file, "", "")
    return scheme + slashes + _shown(rest) if slashes else file


def told_by_system(error: BaseException | None) -> InputError | None:
    """What the operating system refuses, in words, if that is behind an exception.

    A full disk, no permission, a file that is gone; also where a library tells it by its text only.
    """
    while error is not None:
        if isinstance(error, BaseExceptionGroup):
            return next(filter(None, map(told_by_system, error.exceptions)), None)
        if isinstance(error, OSError) and (numbers := _refusal(error)):
            place = error.filename or (Path.cwd() if numbers is FULL else error)
            problem, remedy = SYSTEM[numbers]
            return InputError(problem, file=place, remedy=remedy)
        error = error.__cause__ or error.__context__
    return None


def _refusal(error: OSError) -> tuple[int, ...]:
    """Which key of SYSTEM an error belongs to; empty for none."""
    if error.errno is None:  # of a library
        kinds = {FileNotFoundError: GONE, PermissionError: REFUSED}
        for kind, numbers in kinds.items():
            if isinstance(error, kind):
                return numbers
        said = {n: numbers for numbers in SYSTEM for n in numbers if os.strerror(n) in str(error)}
        return next(iter(said.values()), ())
    found = next((numbers for numbers in SYSTEM if error.errno in numbers), ())
    return found if error.filename or found is FULL else ()


@contextmanager
def in_words() -> Iterator[None]:
    """In the block, or the function that it decorates, such an error becomes an InputError."""
    try:
        yield
    except OSError as error:
        if (told := told_by_system(error)) is None:
            raise
        raise told from None
