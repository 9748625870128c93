"""A project of the user's own: a folder with configuration, sheets and a place for GCPs."""

from __future__ import annotations

import re
from dataclasses import MISSING, fields
from pathlib import Path

from ..core.errors import InputError
from ..core.sheets import City, Scene
from .project import FILES

# Keys that people change, of each section of the configuration; () where the section is one key.
KEYS: dict[str, tuple[str, ...]] = {
    "images": (),
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
"""


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
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "is there already, and not empty", file=folder, remedy="name a folder that is not there"
        )
    (folder / "gcps").mkdir(parents=True)
    (folder / "config.yaml").write_text(configuration_text(), encoding="utf-8")
    for name, columns in (("scenes", Scene), ("cities", City)):
        header = "\t".join(f.name for f in fields(columns) if f.default is MISSING)
        (folder / f"{name}.tsv").write_text(f"{header}\n", encoding="utf-8")
    return "stereotruth scene add DELIVERY --lidar FOLDER"


def with_example(folder: str | Path, name: str) -> str:
    """A new project with a small synthetic city, ``demo`` or ``site``; returns the next step.

    Images, LiDAR and control points are made here. Raises InputError for another name.
    """
    from .example_city import EXAMPLES

    if name not in EXAMPLES:
        raise InputError(
            f"no example {name!r}", remedy=f"take one of {', '.join(EXAMPLES)} after --example"
        )
    begin(folder)
    return EXAMPLES[name](Path(folder))
