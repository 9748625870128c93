"""The profiles that come with the package, and copies of them to write a site's settings into."""

from __future__ import annotations

import shutil
from pathlib import Path

from ..core.errors import InputError
from .project import FILES

SHIPPED = {
    "default": "how every run treats what is made and what is due; taken without being named",
    "slurm": "each step as a job of a SLURM cluster",
    "s3": "products in a bucket",
}


def list_profiles() -> list[str]:
    """A line for each profile, and what to do with them."""
    width = max(map(len, SHIPPED))
    return [
        *(f"{name:{width}}  {meaning}" for name, meaning in SHIPPED.items()),
        "stereotruth run --profile NAME takes one; stereotruth profile NAME copies it here to edit",
    ]


def copy_profile(name: str, folder: Path | None = None) -> str:
    """Write a copy of a profile to ``folder`` (its name); returns what to do next.

    Raises InputError for a profile that the package has not, and if the folder is there.
    """
    if name not in SHIPPED:
        raise InputError(f"no profile {name!r}", remedy=f"take one of {', '.join(SHIPPED)}")
    folder = folder or Path(name)
    if folder.exists():
        raise InputError("is there already", file=folder, remedy="name a folder that is not there")
    shutil.copytree(FILES / "profiles" / name, folder)
    (file,) = folder.glob("config*.yaml")
    return f"{file}: set what differs at your site. Next: stereotruth run --profile {folder} -n"
