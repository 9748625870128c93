"""The images of a site, opened: sensor models, dates and suns, and what is wrong with them."""

from __future__ import annotations

import filecmp
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from ..align.control_points import images_measured
from ..align.images import open_image
from ..core.config.configuration import Configuration
from ..core.errors import InputError
from ..core.products.remote_files import bring_image, is_remote
from ..core.sheets import Image, Scene
from ..sensor.deliveries import Acquisition, between_suns, near
from ..sensor.site_pairs import Links, Names, SiteImage, pair_of
from .findings import Findings
from .project import names_in_pair, sheet

SUNS_APART_DEG = 5.0


@dataclass(frozen=True)
class OpenedImage:
    """An image of the sheet with its sensor model, and what its delivery says of it."""

    row: Image
    file: Path
    image: SiteImage
    said: Acquisition


def open_row(row: Image) -> OpenedImage:
    """An image of the sheet. Raises InputError if it or its RPC cannot be used."""
    file = bring_image(row.file) if is_remote(row.file) else Path(row.file)
    cells = row.acquired, row.sun_azimuth, row.sun_elevation
    image, delivery = open_image(row.image, file, *cells)
    return OpenedImage(row, file, image, delivery)


def images_of(city: str, images: Mapping[str, Image], settings: Configuration) -> list[OpenedImage]:
    """The images of a site. Raises InputError if there are not two, or one cannot be used."""
    rows = [image for image in images.values() if image.city == city]
    if not settings.images:
        raise InputError(
            "the project has no images sheet",
            file=sheet(settings, "scenes"),
            remedy="name one by the key images of the configuration: "
            "image, city, file, one line per image",
        )
    if len(rows) < 2:
        known = ", ".join(sorted({image.city for image in images.values()})) or "none"
        raise InputError(
            f"{len(rows)} image{'s' * (len(rows) != 1)} of city {city!r}; a pair has two",
            file=settings.images,
            remedy=f"add the rows of its images (cities of the sheet: {known})",
        )
    return [open_row(row) for row in rows]


def check_images(
    settings: Configuration,
    images: Mapping[str, Image],
    scenes: Iterable[Scene],
    cities: Iterable[str],
) -> Findings:
    """What is wrong with the images of some cities, and with control points that name images."""
    found = Findings("images")
    opened: list[OpenedImage] = []
    for city in cities:
        of_city = []
        for row in images.values():
            if row.city == city:
                before = len(found)
                with found.of("images"):
                    _require(row, settings)
                    of_city.append(open_row(row))
                if len(found) == before:
                    _check_date(of_city[-1], settings, found)
        _check_ground(city, of_city, settings, found)
        opened += of_city
    with found.of("images"):
        _refuse_copies(opened, settings)
    for file in sorted({scene.gcps for scene in scenes if scene.gcps}):
        with found.of("GCPs"):
            _refuse_unknown(file, images, settings)
    if opened:
        dated = sum(one.image.time is not None for one in opened)
        text = f"{len(opened)} of {settings.images}, {dated} with a date"
        found.fact("images", text)
    return found


def _require(row: Image, settings: Configuration) -> None:
    """Raise InputError if a file that the row names does not exist."""
    for column in ("file", "mask"):
        cell = getattr(row, column)
        if cell and not is_remote(cell) and not Path(cell).is_file():
            raise InputError(
                f"image {row.image!r}: {column} {cell!r} does not exist",
                file=settings.images,
                remedy="correct the path (relative to the working directory, or absolute)",
            )


def _check_date(one: OpenedImage, settings: Configuration, found: Findings) -> None:
    """Doubt an image without a date, and one whose sheet and delivery contradict each other."""
    row, image, said = one.row, one.image, one.said
    where = f"{settings.images}: image {row.image!r}"
    if image.time is None:
        found.doubt(
            "images",
            f"{where}: nothing says when it was taken, so that its pairs have no days and no sun",
            "write it into column acquired, 2020-10-25T03:12:45Z",
        )
    elif row.acquired and said.time is not None and not near(said.time, image.time):
        found.doubt(
            "images",
            f"{where}: acquired is {row.acquired}, and {said.source} says "
            f"{said.time:%Y-%m-%dT%H:%M:%SZ}",
            "correct it, or leave the cell empty",
        )
    told = row.sun_azimuth is not None and said.sun is not None and image.sun is not None
    if told and between_suns(said.sun, image.sun) > SUNS_APART_DEG:
        found.doubt(
            "images",
            f"{where}: the sun is at {image.sun[0]:.0f}, {image.sun[1]:.0f} degrees (azimuth, "
            f"elevation), and {said.source} says {said.sun[0]:.0f}, {said.sun[1]:.0f}",
            "correct it, or leave both cells empty",
        )


def _check_ground(
    city: str, opened: list[OpenedImage], settings: Configuration, found: Findings
) -> None:
    """Name the images that share no ground with any other of their site."""
    if len(opened) < 2:
        return
    shares = {one.row.image: False for one in opened}
    for one, other in combinations(opened, 2):
        if shares[one.row.image] and shares[other.row.image]:
            continue
        heights = [float(of.image.sensor.rpc.height_off) for of in (one, other)]
        if pair_of(one.image, other.image, sum(heights) / 2) is not None:
            shares[one.row.image] = shares[other.row.image] = True
    for name, shared in shares.items():
        if not shared:
            found.fault(
                "images",
                f"{settings.images}: image {name!r} shares no ground with any other image of "
                f"{city}",
                "correct its city or its file, or remove the row",
            )


def scene_pairs(city: str, scenes: Mapping[str, Scene], images: Mapping[str, Image]) -> list[Names]:
    """The images of a city's scenes, of those that have both in the images sheet."""
    of_city = (scene for scene in scenes.values() if scene.city == city)
    return [names for scene in of_city if all(names := names_in_pair(scene, images))]


def check_links(
    city: str, images: Mapping[str, Image], pairs: Sequence[Names], found: Findings
) -> None:
    """Name the images of a site that its scenes leave unused, and groups that they do not link.

    ``pairs``: names of the images of its scenes.
    """
    if not pairs:
        return
    of_city = [name for name, image in images.items() if image.city == city]
    links = Links.of(of_city, pairs)
    if links.unused:  # by choice, as of pairs --most
        found.fact("pairs", f"{city}: {links.of_unused}")
    if len(links.groups) > 1:
        remedy = f"stereotruth pairs {city} names what links them"
        found.doubt("pairs", f"{city}: {links.of_groups}", remedy)


def _refuse_copies(opened: list[OpenedImage], settings: Configuration) -> None:
    """Raise InputError if two files of the sheet hold the same bytes."""
    by_size: dict[int, list[OpenedImage]] = {}
    for one in opened:
        by_size.setdefault(one.file.stat().st_size, []).append(one)
    for alike in by_size.values():
        for one, other in combinations(alike, 2):
            if filecmp.cmp(one.file, other.file, shallow=False):
                raise InputError(
                    f"images {one.row.image!r} and {other.row.image!r} are one image: "
                    f"{one.file} and {other.file} have the same bytes",
                    file=settings.images,
                    remedy="remove one of the two rows",
                )


def _refuse_unknown(file: str, images: Mapping[str, Image], settings: Configuration) -> None:
    """Raise InputError if control points name an image that the sheet does not have."""
    if is_remote(file) or not Path(file).is_file():
        return
    for name, line in images_measured(file).items():
        if name not in images:
            known = settings.images or "none: the project has no images sheet"
            raise InputError(
                f"line {line}: control points of image {name!r}, which is not in the images sheet "
                f"({known})",
                file=file,
                remedy="correct the name, or add the image's row",
            )
