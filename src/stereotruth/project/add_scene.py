"""A delivery's rows in the sheets: a scene (images, views, LiDAR), or the images of a site."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from rasterio.errors import RasterioError

from ..align.control_points import ControlPoints, read_gcps
from ..align.gcp_checks import fit_exchanged, misfits_of_sides
from ..align.images import open_view
from ..core import sheets
from ..core.config.configuration import Configuration
from ..core.errors import InputError
from ..core.products.files import files_below
from ..core.products.rasters import open_raster
from ..epipolar.fit import fit_epipolar
from ..epipolar.model import EpipolarModel
from ..lidar.catalogue_list import is_catalogue, write_list
from ..lidar.lattice import apart, refuse_apart
from ..sensor.deliveries import OTHERS, VIEWS
from ..sensor.rpc import SensorModel
from ..sensor.rpc_files import rpc_file
from .check_lidar import check_lidar
from .check_scene import boxes_of, ground_of
from .expected import Nodes, check_frame
from .findings import Findings, Level
from .list_tiles import list_tiles, margin_of
from .new_project import append_row, check_and_run, city_row
from .project import configured, read_rows, sheet, with_stand_ins

SUFFIXES = {".tif", ".tiff", ".jp2", ".ntf", ".nitf", ".img"}


@dataclass(frozen=True)
class Image:
    """An image with a usable RPC; ``view`` is what is said of it: left, right, or nothing."""

    path: Path
    view: str
    sensor: SensorModel
    size: tuple[int, int]


def _view(file: Path) -> str:
    return next((view for view, words in VIEWS if words.search(file.name)), "")


def find_images(given: Sequence[Path]) -> tuple[list[Image], list[str]]:
    """The images of a delivery's folder, or those that are named, two at least; and remarks.

    Of two, left first where the names of the files say it, or who names them one by one. Raises
    InputError if there are fewer than two, or one has no RPC that can be read.
    """
    given = [Path(path) for path in given]
    for path in given:
        if not path.exists():
            raise InputError("no such file or folder", file=path, remedy="correct the path")
    if len(given) > 1 and all(path.is_file() for path in given):
        files, lines = given, []
    elif all(path.is_dir() for path in given):
        files, lines = _in_folders(given)
    else:
        raise InputError(
            "is one image, or images beside a folder",
            file=given[0],
            remedy="name the delivery's folders, or left and right image, or all images of a site",
        )
    images = [Image(f, _view(f), *open_view(_view(f) or "first", f, "")) for f in files]
    if {image.view for image in images} == {"left", "right"}:
        images.sort(key=lambda image: image.view)
    elif files == given and len(given) == 2:  # left, right
        images = [replace(image, view=view) for image, view in zip(images, ("left", "right"))]
    for image in images:
        source = rpc_file(image.path)
        told = "its own metadata" if source == image.path else source.name
        lines.append(f"{image.path.name}: {image.size[0]} x {image.size[1]} px, RPC from {told}")
    return images, lines


def _in_folders(folders: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """The files of the images below folders, and remarks on those that were passed over."""
    every = sorted(file for folder in folders for file in files_below(folder) if file.is_file())
    files = [file for file in every if file.suffix.lower() in SUFFIXES]
    mosaics = [file for file in every if file.suffix.lower() == ".til"]
    for mosaic in mosaics:
        _refuse_mosaic(mosaic)
    wanted = [file for file in files if not OTHERS.search(file.stem)]
    single = [file for file in wanted if _bands(file) == 1]
    if len(single) >= 2:
        wanted = single
    named = {view: [file for file in wanted if _view(file) == view] for view, _ in VIEWS}
    if all(len(found) == 1 for found in named.values()):
        wanted = [named["left"][0], named["right"][0]]
    lines = []
    if passed := [file.name for file in files if file not in wanted]:
        lines.append(f"passed over: {', '.join(passed[:6])}" + " …" * (len(passed) > 6))
    if len(wanted) < 2:
        there = ", ".join(map(str, wanted)) or "none"
        raise InputError(
            f"{len(wanted)} images that may be of the pair: {there}",
            file=folders[0],
            remedy="name the two: stereotruth scene add LEFT RIGHT --lidar …",
        )
    return wanted, lines


def _bands(file: Path) -> int:
    """Number of bands; 0 of a file that is no image of a readable format."""
    try:
        with open_raster(file) as dataset:
            return dataset.count
    except RasterioError:
        return 0


def _refuse_mosaic(mosaic: Path) -> None:
    """Refuse a WorldView TIL of several files: formats that point at others are not read."""
    text = mosaic.read_text(encoding="utf-8", errors="replace")
    parts = re.findall(r'filename\s*=\s*"([^"]+)"', text, flags=re.IGNORECASE)
    if len(parts) > 1:
        raise InputError(
            f"an image in {len(parts)} files ({parts[0]} …); a pair has one file a view",
            file=mosaic,
            remedy=f"put them together, gdal_translate {mosaic.name} {mosaic.stem}.TIF, keep "
            f"{mosaic.stem}.RPB beside it, and move the parts and the TIL away",
        )
    part = mosaic.with_name(parts[0]) if parts else mosaic
    rpb = mosaic.with_suffix(".RPB")
    if part.stem != mosaic.stem and rpb.is_file() and rpc_file(part) == part:
        raise InputError(
            f"its RPC file {rpb.name} has another name than its image {part.name}",
            file=mosaic,
            remedy=f"copy it: cp {rpb.name} {part.stem}.RPB",
        )


def add_scene(
    delivery: Sequence[Path],
    *,
    lidar: str,
    gcps: str = "",
    city: str = "",
    name: str = "",
    lidar_crs: str = "",
    geoid: str = "",
    hosts: Sequence[str] = (),
    column: str = "",
    configfiles: Sequence[Path] | None = None,
) -> list[str]:
    """Append the scene's row to the scenes sheet, and its city's if it is new.

    More than two images are those of a site: they are listed, and no scene is written. ``lidar``
    may be a catalogue: its tiles are listed (:mod:`.list_tiles`), ``hosts`` may be led to,
    ``column`` has their locations. Returns what was found, line by line. Raises InputError if there
    is no usable pair, LiDAR or file, before anything is written.
    """
    settings, _ = configured(configfiles)
    rows, towns = (Path(sheet(settings, kind)) for kind in ("scenes", "cities"))
    cities, scenes, _ = read_rows(settings)
    images, lines = find_images(delivery)
    first = delivery[0].absolute()
    folder = first if first.is_dir() else first.parent
    city = city or re.sub(r"[^A-Za-z0-9-]+", "-", folder.name).strip("-") or "City"
    if len(images) > 2:
        given = {"lidar": lidar, "lidar-crs": lidar_crs, "geoid": geoid, "gcps": gcps}
        then = ""
        if is_catalogue(lidar):  # whose tiles are listed for the pairs that are chosen
            given["lidar"] = to = f"lidar/{city}.tsv"
            words = _options([("to", to), ("column", column), *(("allow-host", h) for h in hosts)])
            then = f" && stereotruth lidar {shlex.quote(lidar)} {city}{words}"
        return [*lines, *_add_site(images, city, settings, _options(given.items()) + then)]
    pair = images[0], images[1]
    _refuse_repeated(pair, scenes, rows)
    numbered = (f"{re.sub(r'[^A-Za-z0-9-]', '-', city)}-{k}" for k in range(1, 10_000))
    name = name or next(name for name in numbered if name not in scenes)
    if name in scenes:
        raise InputError(
            f"scene {name!r} is there already", file=rows, remedy="take another --name"
        )
    if is_catalogue(lidar):
        files = [(str(pair[0].path), str(pair[1].path))]
        listed, more = list_tiles(lidar, files, margin_of(settings), frozenset(hosts), column)
        lidar, lidar_crs = f"lidar/{name}.tsv", lidar_crs or listed.crs
        write_list(listed, lidar)
        lines += more
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
    placed = with_stand_ins(scene, ask=True)
    footprint = ground_of(placed, settings)
    surveyed = check_lidar(sheets.find_lidar(placed, rows), scene, found, footprint)
    for finding in found:
        if finding.level is Level.ERROR:
            raise InputError(finding.text, remedy=_as_options(finding.remedy))
    heights = [height for file in surveyed for height in file.heights or ()]
    points = read_gcps(gcps, name) if gcps else None
    height = float(np.mean(heights)) if heights else None
    pair, model, words = in_order(pair, height, points)
    placed = [file for file in surveyed if file.box and file.heights]
    if placed:
        lidar_box, images_box, range_m = boxes_of(placed, Nodes.of(model))
        if apart(lidar_box, images_box):
            refuse_apart(lidar_box, images_box, range_m, placed[0].path.parent)
    cells |= {"left_image": str(pair[0].path), "right_image": str(pair[1].path)}
    nodes = Nodes.of(model)
    check_frame(nodes, settings, found)
    lines += words
    for finding in found:
        remedy = f". Remedy: {finding.remedy}" if finding.remedy else ""
        lines.append(f"{finding.about}: {finding.text}{remedy}")
    lines += _add_city(city, cities, towns)
    append_row(rows, cells)
    smaller = _smaller_tiles(nodes.largest, settings)
    lines.append(f"{rows}: scene {name} of {city}. Next: {smaller}{check_and_run(city)}")
    return lines


def _add_site(images: Sequence[Image], city: str, settings: Configuration, rest: str) -> list[str]:
    """List those images of a site that are new; ``rest``: how the command that is next ends."""
    if not settings.images:
        remedy = "add images: images.tsv, a file with the columns image, city, file"
        raise InputError("the configuration names no images sheet", remedy=remedy)
    cities, _, known = read_rows(settings)
    listed = {sheets.file_key(image.file) for image in known.values()}
    paths = [one.path for one in images if sheets.file_key(str(one.path)) not in listed]
    lines = _add_city(city, cities, Path(sheet(settings, "cities")))
    taken = set(known)
    for name, path in sheets.store_names(paths).items():
        name = re.sub(r"[^A-Za-z0-9_-]", "-", name)
        names = (name, *(f"{name[: sheets.LONGEST_NAME - 5]}-{k}" for k in range(2, 1000)))
        taken.add(name := next(one for one in names if one not in taken))
        append_row(Path(settings.images), {"image": name, "city": city, "file": path})
    smaller = _smaller_tiles(min(min(image.size) for image in images), settings)
    lines.append(
        f"{settings.images}: {len(paths)} images of {city}. "
        f"Next: {smaller}stereotruth pairs {city} --most 1{rest}"
    )
    return lines


def _options(given: Iterable[tuple[str, str]]) -> str:
    """Options of a command, as a shell reads them; those without a value are left out."""
    return "".join(f" --{key} {shlex.quote(text)}" for key, text in given if text)


def _smaller_tiles(side: int, settings: Configuration) -> str:
    """What to do first where no tile of the default size fits into a square of ``side`` px."""
    if side >= settings.tiles.size or "tiles" in settings.model_fields_set:
        return ""
    size = 2 ** int(math.log2(max(side, 32) / 2))
    return f"echo 'tiles: {{size: {size}}}' >> config.yaml && "


def _add_city(city: str, cities: Mapping[str, sheets.City], towns: Path) -> list[str]:
    """The row of a city that is new, and what it is."""
    if city in cities:
        return []
    made = sheets.check(city_row(city, _prefix(city, cities)), sheets.City, f"city {city}")
    append_row(towns, asdict(made))
    return [f"{towns}: city {city}, tiles named {made.prefix}_…, split 6 : 1 : 3"]


def _refuse_repeated(
    pair: tuple[Image, Image], scenes: Mapping[str, sheets.Scene], rows: Path
) -> None:
    """Raise InputError if a scene of the sheet has the same two images."""
    images = {sheets.file_key(str(image.path)) for image in pair}
    for name, scene in scenes.items():
        if images == {sheets.file_key(scene.left_image), sheets.file_key(scene.right_image)}:
            raise InputError(
                f"scene {name!r} has these two images already",
                file=rows,
                remedy=f"stereotruth check {name}; or take its line out, then add it",
            )


def in_order(
    pair: tuple[Image, Image], height: float | None, points: ControlPoints | None = None
) -> tuple[tuple[Image, Image], EpipolarModel, list[str]]:
    """Left first, and how that is known.

    By what the files' names or the user say; else by the control ``points``, whose columns belong
    to one image each; else left is the backward view by the RPCs. ``height`` of the ground, m;
    None: the middle of the RPCs' own. The model is that of the RPCs as they are, of the images as
    given. Raises InputError if control points contradict the names.
    """
    one, other = pair
    is_named = bool(one.view and other.view)
    known_by = "by the names" if is_named else "by the RPCs"
    if points is not None:
        given, exchanged = misfits_of_sides(points, (one.sensor, other.sensor))
        by_points = fit_exchanged(given, exchanged) or fit_exchanged(exchanged, given)
        if fit_exchanged(given, exchanged):
            if is_named:
                raise InputError(
                    f"control points miss by {given:.0f} px with {one.path.name} as left image, by "
                    f"{exchanged:.1f} px with {other.path.name}",
                    file=points.file,
                    remedy=f"stereotruth scene add {other.path} {one.path} …; or exchange the left "
                    "and right columns of the control points",
                )
            one, other = other, one
        if by_points:
            is_named, known_by = True, "by the control points"
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
    if forward and not is_named:
        one, other = other, one
        order = "left looks backward"
    words = f"convergence {angle:.1f} degrees; sides {known_by}; by the RPCs, {order}"
    if order == "left looks forward":
        words += " (the backward view is left in the paper's data)"
    return (one, other), model, [f"left: {one.path}", f"right: {other.path}", words]


def _prefix(city: str, cities: Mapping[str, sheets.City]) -> str:
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
