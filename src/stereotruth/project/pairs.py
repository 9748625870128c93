"""All pairs of a site with what is known of them before matching, and rows for the chosen ones."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.markup import escape

from ..core import sheets
from ..core.config.configuration import Configuration
from ..core.errors import InputError
from ..lidar.point_statistics import roughness_m
from ..lidar.point_store import PointStore
from ..sensor.site_pairs import (
    USUAL_ROUGHNESS_M,
    Links,
    Names,
    RatedPair,
    SitePair,
    new_links,
    rate,
)
from .findings import plain_table, wide
from .new_project import append_row, check_and_run
from .project import configured, names_in_pair, read_rows, sheet
from .site import images_of, scene_pairs

CONVERGENCE_DEG = (5.0, 45.0)  # of chosen pairs, where nothing else is said
ALIKE_BASES = 1.5  # greatest ratio of the bases over height of pairs that tell much the same
LEAST_SHARED = 0.05  # of the smaller image's ground
INGESTED = Path("results/ingest")
# What a pair takes from its city's other rows.
OF_CITY = ("lidar", "lidar_crs", "lidar_epoch", "geoid", "gcps")

COLUMNS = (
    "", "left", "right", "bits/px", "matched", "m/px", "convergence", "bisector", "asymmetry",
    "sun", "days", "shared", "pixels", "reason",
)  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """Which pairs are written: ``most`` of those within limits.

    ``convergence`` (degrees) and ``days``: least and greatest, None: any; pairs without dates have
    any number of days if no ``days`` are given. ``diachronic``: pairs that days or suns tell to be.
    ``each``: pairs that one image may be in.
    """

    most: int | None = None
    convergence: tuple[float, float] | None = CONVERGENCE_DEG
    days: tuple[float, float] | None = None
    diachronic: bool = False
    each: int | None = None

    def allows(self, pair: SitePair) -> bool:
        """Whether a pair is within the limits."""
        low, high = self.convergence or (0.0, 180.0)
        if not low <= pair.convergence <= high or pair.shared < LEAST_SHARED:
            return False
        if self.diachronic and not pair.is_diachronic:
            return False
        if self.days is None:
            return True
        first, last = self.days
        return pair.days is not None and first <= pair.days <= last

    def of(self, pairs: Sequence[RatedPair]) -> list[RatedPair]:
        """The chosen of pairs that are listed best first, in that order.

        First those that link all images, since images that no pair links are not adjusted together;
        then the best. Where ``most`` are too few to link all, they link as many as they can. A pair
        counts for less, the more pairs of like convergence are chosen before it.
        """
        allowed = [rated for rated in pairs if self.allows(rated.pair)]
        most = len(allowed) if self.most is None else self.most
        selection = _Selection(allowed, self.each)
        while selection.choose(lambda names: new_links([names], selection.chosen)):
            pass
        if len(selection.chosen) > most:
            selection = _growing(allowed, self.each, most)
        while len(selection.chosen) < most and selection.choose():
            pass
        return [rated for rated in allowed if rated.names in selection.chosen]


class _Selection:
    """Pairs that are chosen one by one, each time the one that adds most to those before it.

    ``each``: pairs that one image may be in; None: any number.
    """

    def __init__(self, pairs: Sequence[RatedPair], each: int | None) -> None:
        self.remaining = {one.names: one for one in pairs}
        self.alike = dict.fromkeys(self.remaining, 0)  # chosen pairs of like convergence
        self.each = each
        self.used: Counter[str] = Counter()
        self.chosen: list[Names] = []

    def choose(self, wanted: Callable[[Names], object] = lambda _: True) -> bool:
        """Choose the best of those ``wanted``, by names; false if there is none."""
        most = math.inf if self.each is None else self.each
        free = [
            names
            for names in self.remaining
            if max(self.used[name] for name in names) < most and wanted(names)
        ]
        if not free:
            return False
        best = max(
            free, key=lambda names: self.remaining[names].quality.bits / (1 + self.alike[names])
        )
        pair = self.remaining.pop(best).pair
        for names, other in self.remaining.items():
            bases = sorted((pair.base, other.pair.base))
            self.alike[names] += bases[1] <= ALIKE_BASES * bases[0]
        self.used.update(best)
        self.chosen.append(best)
        return True


def _growing(pairs: Sequence[RatedPair], each: int | None, most: int) -> _Selection:
    """The best pair, and ``most`` − 1 more, each the best of those that link one image more to
    the images before (Prim 1957); where none does, the best of two others."""
    selection = _Selection(pairs, each)

    def links(names: Names) -> bool:
        return sum(name in selection.used for name in names) == 1

    def apart(names: Names) -> bool:
        return not any(name in selection.used for name in names)

    while len(selection.chosen) < most and (selection.choose(links) or selection.choose(apart)):
        pass
    return selection


def rated_pairs(
    city: str, settings: Configuration, roughness: float | None = None
) -> list[RatedPair]:
    """All pairs of a site, best first; the order of the sheet's rows plays no part.

    ``roughness`` of the site, m; None: not known.
    """
    opened = images_of(city, read_rows(settings)[2], settings)
    rated = rate([one.image for one in opened], roughness)
    if not rated:
        raise InputError(
            f"no two images of city {city!r} share ground",
            file=settings.images,
            remedy="correct the cities and files of the images",
        )
    return rated


def write_pairs(
    city: str,
    choice: Choice,
    rated: Sequence[RatedPair],
    settings: Configuration,
    given: dict[str, str],
) -> str:
    """Append a row for each chosen pair that no scene is made of yet; returns what was done.

    ``given``: cells of OF_CITY; those that are empty are taken from the city's first row. Raises
    InputError if there is no LiDAR to be named.
    """
    rows = Path(sheet(settings, "scenes"))
    _, scenes, images = read_rows(settings)
    of_city = [scene for scene in scenes.values() if scene.city == city]
    here = {
        column: given.get(column) or (getattr(of_city[0], column) if of_city else "")
        for column in OF_CITY
    }
    if not here["lidar"]:
        raise InputError(
            f"no LiDAR is known of city {city!r}",
            file=rows,
            remedy="name it: --lidar FOLDER (and --gcps, --geoid, --lidar-crs)",
        )
    made = {frozenset(names_in_pair(scene, images)) for scene in scenes.values()}
    written = 0
    for pair in (one.pair for one in choice.of(rated)):
        if frozenset((pair.left, pair.right)) in made:
            continue
        name = _free_name(pair, scenes)
        cells = {"scene": name, "city": city, "left_image": pair.left, "right_image": pair.right}
        sheets.check(cells | here, sheets.Scene, f"scene {name}")
        append_row(rows, cells | here)
        written += 1
    how = ", to link the images and to differ in convergence" if choice.most else ""
    said = f"{rows}: {written} of {len(rated)} pairs written{how}"
    return f"{said}. Next: {check_and_run(city)}"


def _free_name(pair: SitePair, scenes: dict[str, sheets.Scene]) -> str:
    """LEFT-RIGHT, which no scene has; short enough for a name."""
    name = re.sub(r"[^A-Za-z0-9-]", "-", f"{pair.left}-{pair.right}")[: sheets.LONGEST_NAME - 4]
    names = (name, *(f"{name}-{k}" for k in range(2, 1000)))
    return next(one for one in names if one not in scenes)


def table(
    rated: Sequence[RatedPair], chosen: Collection[tuple[str, str]] = ()
) -> list[tuple[str, ...]]:
    """The listed pairs as text: COLUMNS, one row a pair; degrees, days, shares.

    ``chosen``: names of the images of pairs that are scenes, in either order.
    """
    marked = {frozenset(names) for names in chosen}
    return [
        (
            "*" if frozenset(one.names) in marked else "",
            *one.names,
            f"{one.quality.bits:.1f}",
            f"{100 * one.quality.matched:.0f} %",
            f"{one.pair.metres_per_px:.1f}",
            f"{one.pair.convergence:.1f}°",
            f"{one.pair.bisector:.0f}°",
            f"{one.pair.asymmetry:.0f}°",
            "?" if one.pair.sun is None else f"{one.pair.sun:.0f}°",
            "?" if one.pair.days is None else _days(one.pair.days),
            f"{100 * one.pair.shared:.0f} %, {one.pair.shared_km2:.3g} km²",
            f"{one.pair.pixel_ratio:.2f}",
            one.quality.reason,
        )
        for one in rated
    ]


def _days(days: float) -> str:
    return f"{days:.0f}" if days >= 1 else "same pass" if days < 0.02 else "same day"


@dataclass(frozen=True)
class Listing:
    """All pairs of a site, best first; names of the images of those that are scenes; and in words
    how rough the site is, what was written, and which images are unused or without a link."""

    rated: list[RatedPair]
    chosen: list[tuple[str, str]]
    lines: list[str]


def list_pairs(
    city: str,
    choice: Choice | None,
    given: dict[str, str],
    configfiles: Sequence[Path] | None = None,
) -> Listing:
    """All pairs of a site. ``choice`` is written to the scenes sheet; None: nothing is."""
    settings, _ = configured(configfiles)
    of_city = (name for name, scene in read_rows(settings)[1].items() if scene.city == city)
    files = [file for name in of_city for file in sorted((INGESTED / city / name).glob("*.points"))]
    roughness = roughness_m([PointStore(file) for file in files]) if files else None
    rated = rated_pairs(city, settings, roughness)
    lines = [_in_words(city, roughness)]
    if choice is not None:
        lines.append(write_pairs(city, choice, rated, settings, given))
    _, scenes, images = read_rows(settings)
    chosen = scene_pairs(city, scenes, images)
    if chosen:
        lines.append(f"* {len(chosen)} of them are scenes of {sheet(settings, 'scenes')}")
        of_city = [name for name, image in images.items() if image.city == city]
        lines += _unlinked(of_city, rated, chosen)
    return Listing(rated, chosen, lines)


def _unlinked(
    images: Sequence[str], rated: Sequence[RatedPair], chosen: Sequence[tuple[str, str]]
) -> list[str]:
    """What the scenes of a site leave unused or without a link, and the best pairs that would link
    it."""
    lines = Links.of(images, chosen).sentences
    if not lines:
        return []
    pairs = {one.names: one for one in rated}
    missing = [pairs[names] for names in new_links(pairs, chosen)]
    told = "; ".join(
        f"{one.pair.left} and {one.pair.right} ({one.quality.bits:.1f} bits/px, "
        f"{one.pair.convergence:.0f}°)"
        for one in missing
    )
    if missing:
        lines.append(f"best pairs that would link them: {told}")
    return lines


def _in_words(city: str, roughness: float | None) -> str:
    if roughness is None:
        return f"matched is that of a usual site: no LiDAR of {city} has been ingested"
    return (
        f"matched follows from the ingested LiDAR, too: steps of {roughness:.1f} m between squares "
        f"of 2 m on the average, of a usual site {USUAL_ROUGHNESS_M} m"
    )


def show_pairs(
    rated: Sequence[RatedPair],
    chosen: Collection[tuple[str, str]] = (),
    console: Console | None = None,
) -> None:
    """Print a line for each pair, in the order given, and what the prediction is.

    ``chosen``: names of the images of pairs that are scenes.
    """
    console, shown = wide(console), plain_table(COLUMNS, whole=COLUMNS[:-1])
    for cells in table(rated, chosen):
        shown.add_row(*map(escape, cells))
    console.print(shown)
    console.print(
        f"{len(rated)} pairs, best first. bits/px: information about the height that a pixel "
        "gives, by matched (predicted share of the pixels seen in both that semi-global matching "
        "finds within 1 px) and m/px (height that 1 px is)",
        style="dim",
    )
