"""The one exception that users are meant to read, and what no message may show."""

from __future__ import annotations

import re
from pathlib import Path

URL = re.compile(r"\b([A-Za-z][A-Za-z0-9+.-]*:/+)([^\s'\"<>]+)")
PAIR = re.compile(
    r"\b((?:x-amz-|x-goog-)[\w-]+|\w*(?:signature|token|passw(?:or)?d|secret|credential|api_?key)|sig)"
    r"=[^\s&'\";]+",
    re.IGNORECASE,
)
HIDDEN = "…"


def without_secrets(text: str) -> str:
    """A text whose URLs have no name, password, query or fragment, so no signature and no token."""
    return PAIR.sub(rf"\1={HIDDEN}", URL.sub(lambda found: found[1] + _shown(found[2]), text))


def _shown(rest: str) -> str:
    """What stands behind ``scheme://``, without what only its owner is to know."""
    who, at, rest = rest.rpartition("@")
    place = re.split(r"[?#]", rest, maxsplit=1)
    return (HIDDEN + at if who else at) + place[0] + ("?" + HIDDEN if len(place) > 1 else "")


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
