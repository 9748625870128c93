"""What a folder is worked with: configuration, sheets, LiDAR, and the epoch of each city."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from stereocities.cities import FOLDER as SYNTHETIC_FOLDER
from stereocities.cities import city_of, lidar_files, synthetic_city

from ..core import sheets
from ..core.config.configuration import Configuration
from ..core.config.section import merged, read_mapping
from ..core.errors import InputError, in_words
from ..core.products.remote_files import (
    FOLDER,
    bring_files,
    bring_image,
    bring_table,
    is_remote,
    place_of,
    stand_in,
)
from ..core.tables import decimal_year, epoch_year
from ..lidar.catalogue_list import (
    EPT,
    days_of_list,
    files_of_list,
    is_catalogue,
    is_list,
    read_list,
    remarks_on,
    unlisted_m2,
)
from ..lidar.frames import DEFAULT_EPOCH, Epoch
from ..sensor.deliveries import read_acquisition

log = logging.getLogger("stereotruth")
_PACKAGE = Path(__file__).parents[1]
# Snakefile, workflow/, config/ and profiles/: of the clone, or what setup.py put into the wheel.
FILES = _PACKAGE / "shipped" if (_PACKAGE / "shipped").is_dir() else _PACKAGE.parents[1]
CONFIG = "config.yaml"  # of a user's own project
SHARED = Path("config") / CONFIG  # of a clone: the Snakefile reads it

LOOKED_AT = 10  # scenes of a city whose deliveries are looked into
ANYWHERE = (0.0, 0.0)  # degrees: a day does not depend on the place


def configured(files: Sequence[str | Path] | None = None) -> tuple[Configuration, str]:
    """The configuration of this folder as a run reads it, and the names of the files it is from.

    ``files`` stand in the place of the folder's ``config.yaml``. Raises InputError.
    """
    require_project(files)
    own = [Path(CONFIG)] if Path(CONFIG).is_file() else []
    read = [*([SHARED] if SHARED.is_file() else []), *(map(Path, files) if files else own)]
    values: dict[str, Any] = {}
    for file in read:
        values = merged(values, read_mapping(file))
    names = ", ".join(map(str, read)) or "the defaults"
    return Configuration.of(values, names), names


def require_project(files: Sequence[str | Path] | None = None) -> None:
    """Raise InputError if this folder has no configuration, and no ``files`` of one are given.

    A clone has that of the six synthetic cities.
    """
    if files or Path(CONFIG).is_file() or SHARED.is_file():
        return
    above = next((folder for folder in Path.cwd().parents if (folder / CONFIG).is_file()), None)
    remedies = ["begin a project: stereotruth init FOLDER", "the built-in cities: --example"]
    if above is not None:
        remedies.insert(0, f"did you mean: cd {os.path.relpath(above)}")
    raise InputError(f"no {CONFIG} here", file=Path.cwd(), remedy="; or ".join(remedies))


def names_scenes(files: Sequence[str | Path] | None = None) -> bool:
    """Whether the configuration of this folder, or of ``files``, names a sheet of scenes.

    A clone always has one: that of the built-in cities.
    """
    read = [Path(file) for file in files or [CONFIG]]
    return SHARED.is_file() or any("scenes" in read_mapping(file) for file in read)


def require_scenes(files: Sequence[str | Path] | None = None) -> None:
    """Raise InputError if the configuration names no sheet of scenes."""
    require_project(files)
    if not names_scenes(files):
        raise InputError(
            "names no sheet of scenes",
            file=", ".join(map(str, files or [CONFIG])),
            remedy="write scenes: scenes.tsv and cities: cities.tsv into it; or the built-in "
            "cities: --example",
        )


def is_synthetic(scene: sheets.Scene) -> bool:
    """Whether the scene's input is made by the rules of simulate.smk."""
    made_here = SYNTHETIC_FOLDER / scene.city / scene.scene / "left.tif"
    return scene.left_image == str(made_here) and synthetic_city(scene.city) is not None


def here_or_shipped(path: str) -> str:
    """A path of the defaults: in this folder, or else where the package has it."""
    return path if Path(path).exists() or not (FILES / path).exists() else str(FILES / path)


def sheet(settings: Configuration, name: str) -> str:
    """Path of the sheet ``name`` (scenes, cities); the package's own serves where none is named."""
    path = getattr(settings, name)
    return here_or_shipped(path) if path == Configuration.model_fields[name].default else path


@in_words()
def read_scenes(
    settings: Configuration, *, ask: bool = True
) -> tuple[dict[str, sheets.City], dict[str, sheets.Scene]]:
    """Cities and scenes by name. Raises InputError that names the sheet and the row.

    Where a scene names files by URLs it gets their stand-ins (:mod:`.products.remote_files`).
    ``ask``: ask their servers what they are now; else take what a call before has found.
    """
    cities, rows, _ = read_rows(settings)
    scenes = dict(rows)
    for name, scene in rows.items():
        if is_synthetic(scene):
            scenes[name] = replace(scene, gcps=here_or_shipped(scene.gcps))
        else:
            scenes[name] = with_stand_ins(scene, ask=ask)
    if ask:
        for remark in dict.fromkeys(_remarks_on_lists(rows, scenes, settings)):
            log.warning("%s", remark)
    return cities, scenes


def read_rows(
    settings: Configuration,
) -> tuple[dict[str, sheets.City], dict[str, sheets.Scene], dict[str, sheets.Image]]:
    """Cities, scenes and images by name, as the sheets have them. Raises InputError."""
    towns = sheet(settings, "cities")
    cities = sheets.read_cities(towns)
    images = read_images(settings, cities)
    scenes = sheets.read_scenes(sheet(settings, "scenes"), cities, images, cities_sheet=towns)
    return cities, scenes, images


def read_images(
    settings: Configuration, cities: Mapping[str, sheets.City]
) -> dict[str, sheets.Image]:
    """The images of sites by name; none if the project has no such sheet."""
    return sheets.read_images(settings.images, cities) if settings.images else {}


def file_of_image(image: sheets.Image) -> str:
    """Path of an image of the sheet; of one named by a URL, that of its stand-in."""
    return str(_place(image.file, "left_image", ask=False)) if is_remote(image.file) else image.file


def names_in_pair(scene: sheets.Scene, images: Mapping[str, sheets.Image]) -> tuple[str, str]:
    """Names of a scene's left and right image in the images sheet; empty if it has them not."""

    def key(file: str) -> str:
        return sheets.file_key(str(place_of(file)) if is_remote(file) else file)

    by_file = {key(image.file): name for name, image in images.items()}
    return by_file.get(key(scene.left_image), ""), by_file.get(key(scene.right_image), "")


def days_of_pair(names: tuple[str, str], images: Mapping[str, sheets.Image]) -> tuple[str, str]:
    """Days (ISO) on which a pair's left and right image were taken by the images sheet, empty where
    it does not say it; ``names``: see :func:`names_in_pair`."""
    left, right = (sheets.day_of(images[name].acquired) if name else None for name in names)
    return left.isoformat() if left else "", right.isoformat() if right else ""


def _remarks_on_lists(
    rows: Mapping[str, sheets.Scene], scenes: Mapping[str, sheets.Scene], settings: Configuration
) -> Iterator[str]:
    """What users are to know of the lists of tiles that rows name; ``scenes`` have the files."""
    for name, row in rows.items():
        files = [part for part in _lidar_parts(row) if is_list(part)]
        for file in files:
            yield from remarks_on(file)
        if not files or len(files) < len(_lidar_parts(row)):
            continue
        from ..align.images import footprint_of  # for few projects

        images = scenes[name].left_image, scenes[name].right_image
        ground = footprint_of([images], settings.ingest.margin_m or 0.0)
        if ground is not None and (unlisted := unlisted_m2(files, ground)):
            yield (
                f"{', '.join(files)}: written for other scenes or a smaller ingest.margin_m, has "
                f"nothing of {unlisted / 1e6:.4g} km² of the ground of scene {name}: write it again"
            )


def _lidar_parts(scene: sheets.Scene) -> list[str]:
    return [part.strip() for part in scene.lidar.split(sheets.LIDAR_SEPARATOR)]


def with_stand_ins(scene: sheets.Scene, *, ask: bool) -> sheets.Scene:
    """A row with paths in the place of URLs and of lists of tiles; see :func:`read_scenes`."""
    cells = {column: getattr(scene, column) for column in (*sheets.FILES, "lidar")}
    found = {}
    for column, cell in cells.items():
        if column == "lidar":
            parts = _lidar_parts(scene)
            files = [file for part in parts for file in _lidar_part(part, ask=ask)]
            if files != parts:
                found[column] = sheets.LIDAR_SEPARATOR.join(files)
        elif is_remote(cell):
            found[column] = str(_place(cell, column, ask=ask))
    if not scene.lidar_crs and (system := _system_of_lists(scene)):
        found["lidar_crs"] = system
    return replace(scene, **found)


def _system_of_lists(scene: sheets.Scene) -> str:
    """What catalogues say of the coordinates of all LiDAR that a row names; empty if they do not.

    Raises InputError where they say different things.
    """
    parts = _lidar_parts(scene)
    if not all(map(is_list, parts)):
        return ""
    systems = {read_list(part).crs for part in parts}
    if len(systems) > 1:
        named = ", ".join(sorted(system or "none" for system in systems))
        raise InputError(
            f"lists of tiles in different systems by their catalogues ({named})",
            file=scene.lidar,
            remedy="set lidar_crs of the row to what holds for all of them, or make rows of each",
        )
    return systems.pop()


def _lidar_part(part: str, *, ask: bool) -> list[str]:
    """Paths that a part of a scene's cell ``lidar`` names: itself, or what stands for it."""
    if is_list(part):
        return files_of_list(part)
    if is_catalogue(part):
        raise InputError(
            "a catalogue, which a run does not look into",
            file=part,
            remedy="have its tiles listed (stereotruth lidar CATALOGUE --to lidar/NAME.tsv), and "
            "name the list",
        )
    return [str(_place(part, "lidar", ask=ask))] if is_remote(part) else [part]


def _place(url: str, column: str, *, ask: bool) -> Path:
    """Where the stand-in or the copy of a URL lies; its server is asked, or has been before."""
    place = place_of(url)
    if not ask and (place.exists() or any(FOLDER.glob(str(place.relative_to(FOLDER))))):
        return place
    if column == "lidar":
        return bring_files(url, (*sheets.LIDAR_SUFFIXES, *sheets.RASTER_SUFFIXES, EPT))
    if column == "gcps":
        return bring_table(url)
    return bring_image(url) if column.endswith("image") else stand_in(url)


def lidar_days(settings: Configuration) -> dict[str, list[str]]:
    """First and last day (ISO) of LiDAR files by path, of those whose lists of tiles say them."""
    _, rows, _ = read_rows(settings)
    lists = {part for row in rows.values() for part in _lidar_parts(row) if is_list(part)}
    return {file: days for part in sorted(lists) for file, days in days_of_list(part).items()}


@in_words()
def lidar_of(scene: sheets.Scene, settings: Configuration) -> dict[str, Path]:
    """The LiDAR files of a scene by the names of their stores, after its files were found.

    Raises InputError: a file that is missing, or no control points and no refinement.
    """
    rows = sheet(settings, "scenes")
    alignment = settings.alignment
    if not scene.gcps and not (alignment.refine or scene.scene in alignment.fixed):
        raise InputError(
            f"scene {scene.scene!r} has no GCPs, and alignment.refine is false",
            file=rows,
            remedy="name its file of ground control points, or set alignment.refine to true",
        )
    if is_synthetic(scene):
        if not Path(scene.gcps).is_relative_to(SYNTHETIC_FOLDER):
            sheets.require_files(scene, rows, ["gcps"])
        made = lidar_files(city_of(scene.city), scene.scene)
        return sheets.store_names([Path(scene.lidar) / file for file in made])
    sheets.require_files(scene, rows, sheets.FILES)
    return sheets.store_names(sheets.find_lidar(scene, rows))


def stores_of(
    scenes: Mapping[str, sheets.Scene], lidar: Mapping[str, Mapping[str, Path]]
) -> dict[str, list[tuple[str, str]]]:
    """The point stores of each scene: (scene that they are made for, name of the LiDAR file).

    A file is read once by all scenes of a city that take it by the same system, epoch and geoid:
    its store is that of the first of them in the sheet. ``lidar``: files of each scene by the names
    of their stores.
    """
    made: dict[tuple[str, ...], tuple[str, str]] = {}
    found: dict[str, list[tuple[str, str]]] = {}
    for name, scene in scenes.items():
        geoid = sheets.file_key(scene.geoid) if scene.geoid else ""
        how = scene.city, scene.lidar_crs, scene.lidar_epoch, geoid
        found[name] = [
            made.setdefault((*how, sheets.file_key(str(file))), (name, store))
            for store, file in lidar[name].items()
        ]
    return found


def surfaces_of(stores: Mapping[str, Sequence[tuple[str, str]]]) -> dict[str, str]:
    """The scene that the surface of each scene is named by: the first in the sheet that takes the
    same points. ``stores``: see :func:`stores_of`."""
    first: dict[tuple[tuple[str, str], ...], str] = {}
    return {
        scene: first.setdefault(tuple(sorted(points)), scene) for scene, points in stores.items()
    }


def adjusted_scenes(
    settings: Configuration,
    scenes: Mapping[str, sheets.Scene],
    names: Mapping[str, tuple[str, str]],
) -> dict[str, tuple[str, str]]:
    """Scenes whose images are adjusted together with those of other scenes of their city.

    Each with the names of both images; one that is not in the images sheet is named by the path in
    the scenes sheet. They are the scenes that share an image with another one, or have an image
    whose correction is fixed; none without refinement, and none whose own alignment is fixed.
    ``names``: see :func:`names_in_pair`, by scene.
    """
    fixed = settings.alignment.fixed
    if not settings.alignment.refine:
        return {}
    of_scenes: dict[str, tuple[str, str]] = {}
    taken: dict[tuple[str, str], set[str]] = {}
    paths: dict[str, str] = {}
    for name, scene in scenes.items():
        if name in fixed:
            continue
        files = scene.left_image, scene.right_image
        keys = [sheets.file_key(file) for file in files]
        for key, file in zip(keys, files):
            paths[key] = min(paths.get(key, file), file)
        images = [own or key for own, key in zip(names[name], keys)]
        of_scenes[name] = images[0], images[1]
        for image in images:
            taken.setdefault((scene.city, image), set()).add(name)
    return {
        name: (paths.get(images[0], images[0]), paths.get(images[1], images[1]))
        for name, images in of_scenes.items()
        if any(len(taken[scenes[name].city, image]) > 1 or image in fixed for image in images)
    }


@in_words()
def check_fixed(
    settings: Configuration,
    scenes: Mapping[str, sheets.Scene],
    images: Mapping[str, sheets.Image],
) -> None:
    """Raise InputError if alignment.fixed names no scene and no image, or no file."""
    for name, file in settings.alignment.fixed.items():
        known = name in scenes or name in images
        if not known or not Path(file).is_file():
            raise InputError(
                f"alignment.fixed: {name}: {file}: "
                + ("no such file" if known else "no such scene or image"),
                file=sheet(settings, "scenes"),
                remedy="take a scene of the sheet and the path of its alignment.json, or an image "
                "of the images sheet and a copy of results/adjust/<city>.json",
            )


def epoch_of_city(
    city: sheets.City, scenes: Mapping[str, sheets.Scene], images: Mapping[str, sheets.Image]
) -> Epoch:
    """The epoch of all places of a city, in ITRF2020: plates move by 1 to 8 cm a year.

    That of the cities sheet, or else the mean day of the first scene whose images tell theirs, so
    that scenes which are appended change nothing; the default where none does. ``scenes``,
    ``images``: rows of the sheets, of this and of other cities.
    """
    if (year := epoch_year(city.epoch)) is not None:
        return Epoch(year, "the cities sheet")
    looked = 0
    for scene in scenes.values():
        if scene.city != city.city or is_synthetic(scene):
            continue
        days = []
        names = names_in_pair(scene, images)
        for name, file in zip(names, (scene.left_image, scene.right_image)):
            day = sheets.day_of(images[name].acquired) if name else None
            if day is None and looked < LOOKED_AT:
                day = _delivered(file)
            if day is not None:
                days.append(day)
        looked += 1
        if days:
            year = sum(map(decimal_year, days)) / len(days)
            return Epoch(round(year, 3), f"the images of scene {scene.scene}")
    return DEFAULT_EPOCH


def _delivered(image: str) -> date | None:
    with suppress(OSError, ValueError):
        time = read_acquisition(image, ANYWHERE).time
        return None if time is None else time.date()
    return None
