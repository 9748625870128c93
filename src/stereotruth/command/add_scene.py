"""A scene's row from a delivery: images, RPCs and views found, LiDAR looked at, sheets written."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from .. import sheets
from ..epipolar.fit import fit_epipolar
from ..epipolar.model import EpipolarModel
from ..errors import InputError
from ..project import configured, sheet
from .check_lidar import check_lidar
from .check_tiles import Nodes, check_frame
from .deliveries import Image, find_pair
from .findings import Findings, Level

SPLITS = {"training": 6, "validation": 1, "testing": 3}  # weights of a new city


def add_scene(
    delivery: Sequence[Path],
    *,
    lidar: str,
    gcps: str = "",
    city: str = "",
    name: str = "",
    lidar_crs: str = "",
    geoid: str = "",
    configfiles: Sequence[Path] | None = None,
) -> list[str]:
    """Append the scene's row to the scenes sheet, and its city's if it is new.

    Returns what was found, line by line. Raises InputError if there is no usable pair, LiDAR or
    file, before anything is written.
    """
    settings, _ = configured(configfiles)
    rows, towns = (Path(sheet(settings, kind)) for kind in ("scenes", "cities"))
    cities = sheets.read_cities(towns)
    scenes = sheets.read_scenes(rows, cities)
    pair, lines = find_pair(delivery)
    city = city or _word(_folder_name(delivery))
    name = name or _unused(city, scenes)
    if name in scenes:
        raise InputError(
            f"scene {name!r} is there already", file=rows, remedy="take another --name"
        )
    cells = {
        "scene": name,
        "city": city,
        "left_image": str(pair[0].path),
        "right_image": str(pair[1].path),
        "lidar": lidar,
        "lidar_crs": lidar_crs,
        "geoid": geoid,
        "gcps": gcps,
    }
    scene = sheets.check(cells, sheets.Scene, f"scene {name}")
    sheets.require_files(scene, rows, sheets.FILES)
    found = Findings(name)
    surveyed = check_lidar(sheets.find_lidar(scene, rows), scene, found)
    for finding in found:
        if finding.level is Level.ERROR:
            raise InputError(finding.text, remedy=_as_options(finding.remedy))
    heights = [height for file in surveyed for height in file.heights or ()]
    pair, model, words = in_order(pair, float(np.mean(heights)) if heights else None)
    cells |= {"left_image": str(pair[0].path), "right_image": str(pair[1].path)}
    check_frame(Nodes.of(model), settings, found)
    lines += words
    for finding in found:
        remedy = f". Remedy: {finding.remedy}" if finding.remedy else ""
        lines.append(f"{finding.about}: {finding.text}{remedy}")
    if city not in cities:
        made = sheets.check(
            {"city": city, "prefix": _prefix(city, cities), **SPLITS}, sheets.City, f"city {city}"
        )
        _append(towns, sheets.City, asdict(made))
        lines.append(f"{towns}: city {city}, tiles named {made.prefix}_…, split 6 : 1 : 3")
    _append(rows, sheets.Scene, cells)
    lines.append(f"{rows}: scene {name} of {city}. Next: stereotruth check {name}")
    return lines


def in_order(
    pair: tuple[Image, Image], height: float | None
) -> tuple[tuple[Image, Image], EpipolarModel, list[str]]:
    """Left first: as it is said, or else the backward view by the RPCs; and how it is known.

    ``height`` of the ground, m; None: the middle of the RPCs' own. The model is that of the RPCs as
    they are, of the images as given.
    """
    one, other = pair
    if height is None:
        height = float(one.sensor.rpc.height_off + other.sensor.rpc.height_off) / 2
    model = fit_epipolar(
        one.sensor,
        other.sensor,
        one.size,
        other.size,
        height,
        names=(str(one.path), str(other.path)),
    )
    order, angle = model.report["view_order"], model.report["convergence_angle_deg"]
    forward = order == "left looks forward"
    if forward and not (one.view and other.view):
        one, other = other, one
        order = "left looks backward"
    words = f"convergence {angle:.1f} degrees; by the RPCs, {order}"
    if order == "left looks forward":
        words += " (the backward view is left in the paper's data)"
    return (one, other), model, [f"left: {one.path}", f"right: {other.path}", words]


def _folder_name(delivery: Sequence[Path]) -> str:
    first = delivery[0].absolute()
    return (first if first.is_dir() else first.parent).name


def _word(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9-]+", "-", text).strip("-") or "City"


def _unused(city: str, scenes: dict[str, sheets.Scene]) -> str:
    """The first of City-1, City-2 … that no scene has."""
    base = re.sub(r"[^A-Za-z0-9-]", "-", city)
    return next(name for k in range(1, 10_000) if (name := f"{base}-{k}") not in scenes)


def _prefix(city: str, cities: dict[str, sheets.City]) -> str:
    """Two letters or more of the city that no other has."""
    letters = re.sub(r"[^A-Za-z0-9]", "", city).upper() or "C"
    taken = {other.prefix for other in cities.values()}
    options = [letters[0] + other for other in letters[1:]]
    options += [f"{letters[:2]}{k}" for k in range(2, 1000)]
    return next(option for option in options if option not in taken)


def _as_options(remedy: str) -> str:
    """A remedy of the sheets in the words of this command."""
    for column in ("lidar_crs", "geoid"):
        remedy = re.sub(rf"\b{column}\b", f"--{column.replace('_', '-')}", remedy)
    return remedy


def _append(file: Path, kind: type, cells: dict[str, object]) -> None:
    """One more line of a sheet, in the order of its own header."""
    text = file.read_text(encoding="utf-8-sig")
    header = next(
        (line.split("\t") for line in text.splitlines() if line and not line.startswith("#")),
        [field.name for field in fields(kind)],
    )
    row = {column.strip(): cells.get(column.strip(), "") for column in header}
    with file.open("a", newline="", encoding="utf-8") as stream:
        if text and not text.endswith("\n"):
            stream.write("\n")
        csv.writer(stream, delimiter="\t", lineterminator="\n").writerow(row.values())
