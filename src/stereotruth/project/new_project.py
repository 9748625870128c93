"""A project of the user's own: a folder with configuration, sheets, and copies of profiles."""

from __future__ import annotations

import csv
import re
import shutil
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path

from ..core.errors import InputError
from ..core.products.files import refuse_others
from ..core.sheets import City, Image, Scene
from .project import FILES

# Keys that people change, of each section of the configuration; () where the section is one key.
KEYS: dict[str, tuple[str, ...]] = {
    "strict": (),
    "seed": (),
    "ingest": ("drop_classes",),
    "alignment": ("model", "refine"),
    "project": ("recipe", "min_points_per_px", "right_view"),
    "tiles": ("size", "stride", "min_labelled", "disparity_dtype"),
    "quality": ("max_gcp_rms_px", "max_y_parallax_px", "max_sift_error_px"),
}
HEAD = """\
# A project of stereotruth. What stands here overrides the defaults; remove the # to change one.
# Paths count from this folder. All keys: {keys}
scenes: scenes.tsv
cities: cities.tsv
images: images.tsv
"""

SHIPPED = {
    "default": "how every run treats what is made and what is due; taken without being named",
    "slurm": "each step as a job of a SLURM cluster",
    "s3": "products in a bucket",
}


def configuration_text() -> str:
    """The text of a new config.yaml: keys with their defaults and remarks, commented out."""
    lines = [HEAD.format(keys=(FILES / "config" / "README.md").as_uri()).rstrip()]
    section = None
    for line in (FILES / "config" / "config.yaml").read_text(encoding="utf-8").splitlines():
        if found := re.match(r"(\w+):", line):
            section = found[1]
            if section in KEYS:
                lines += ["", f"# {line}"]
        elif (found := re.match(r"  (\w+):", line)) and found[1] in KEYS.get(section, ()):
            lines.append(f"# {line}")
    return "\n".join(lines) + "\n"


def begin(folder: str | Path) -> str:
    """Write the files of a new project; returns the next step.

    Raises InputError if the folder has anything in it, or has no name.
    """
    if not str(folder):
        raise InputError(
            "no folder is named",
            remedy="stereotruth init FOLDER, or stereotruth init --example demo",
        )
    folder = Path(folder)
    refuse_others(folder)
    (folder / "gcps").mkdir(parents=True)
    (folder / "config.yaml").write_text(configuration_text(), encoding="utf-8")
    for name, columns in (("scenes", Scene), ("cities", City), ("images", Image)):
        wanted = (f for f in fields(columns) if columns is Image or f.default is MISSING)
        header = "\t".join(f.name for f in wanted)
        (folder / f"{name}.tsv").write_text(f"{header}\n", encoding="utf-8")
    return "stereotruth scene add DELIVERY --lidar FOLDER"


def append_row(file: Path, cells: Mapping[str, object]) -> None:
    """One more line of a sheet, in the order of its header."""
    text = file.read_text(encoding="utf-8-sig")
    header = next(line for line in text.splitlines() if line and not line.startswith("#"))
    row = [cells.get(column.strip(), "") for column in header.split("\t")]
    with file.open("a", newline="", encoding="utf-8") as stream:
        if not text.endswith("\n"):
            stream.write("\n")
        csv.writer(stream, delimiter="\t", lineterminator="\n").writerow(row)


def check_and_run(city: str) -> str:
    """The command that makes a city's tiles and page, once ``check`` finds no error."""
    return f"stereotruth check && stereotruth run tiles/{city} report"


def city_row(name: str, prefix: str) -> dict[str, object]:
    """The row of a new city, whose tiles are split 6 : 1 : 3."""
    return {"city": name, "prefix": prefix, "training": 6, "validation": 1, "testing": 3}


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
