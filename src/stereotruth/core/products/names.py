"""Names and paths that a file of somebody else states, before they become files of the user.

Manifests, results and submissions of others, and the names of their files, say what products are
called. Such a name must be a plain one: part of one file name, and nothing that leads elsewhere.
"""

from __future__ import annotations

from pathlib import Path

from ..config.section import LONGEST_NAME
from ..errors import InputError

LONGEST_PATH = 1000  # bytes of a path below a folder


def defect_of(name: object, longest: int = LONGEST_NAME) -> str:
    """Why a text is no plain name; empty if it is one."""
    if not isinstance(name, str) or not name:
        return "is empty"
    if len(name.encode("utf-8", "surrogateescape")) > longest:
        return f"is longer than {longest} bytes"
    if "/" in name or "\\" in name or name.startswith("."):
        return "leads to another folder, or to a hidden file"
    if not name.isprintable():
        return "has characters that cannot be printed"
    return ""


def plain_name(name: object, what: str, file: str | Path) -> str:
    """A name that ``file`` states. Raises InputError if it is no plain name.

    Plain: at most LONGEST_NAME bytes, printable, no ``/`` and no ``\\``, no dot at its beginning.
    """
    if defect := defect_of(name):
        raise InputError(
            f"{what} {shown(name)} {defect}",
            file=file,
            remedy=f"names have at most {LONGEST_NAME} characters, no / and no \\, and do not "
            "begin with a dot; who made the file may mean harm",
        )
    return str(name)


def path_below(path: object, what: str, file: str | Path) -> str:
    """A path that ``file`` states. Raises InputError if it leads out of the file's folder."""
    text = path if isinstance(path, str) else ""
    defects = [defect_of(part, longest=255) for part in text.split("/")]
    if len(text) > LONGEST_PATH:
        defects.append(f"is longer than {LONGEST_PATH} characters")
    if defect := next(filter(None, defects), ""):
        raise InputError(
            f"{what} {shown(path)} is no path below its folder: a part of it {defect}",
            file=file,
            remedy="paths are relative and name files below the folder; who made the file may mean "
            "harm",
        )
    return text


def shown(name: object) -> str:
    """A text in quotation marks, cut short, fit for one line of any terminal."""
    text = ascii(name)
    return text if len(text) <= 80 else f"{text[:70]}…{text[-1]}"
