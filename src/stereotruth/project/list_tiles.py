"""Lists of the tiles of a catalogue that lie on the ground of scenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import compress
from pathlib import Path

from pyproj import CRS
from pyproj.exceptions import CRSError

from ..align.images import footprint_of
from ..core.config.configuration import Configuration, Ingest
from ..core.errors import InputError, in_number, without_secrets
from ..core.products.remote_files import bring_image, is_remote, state_of
from ..lidar.catalogue import Cover, Tile, cover_of, read_catalogue, resolved
from ..lidar.catalogue_list import SUFFIX, ListedTile, TileList, write_list
from ..lidar.declared_crs import LidarCRS, interpret
from ..lidar.lattice import CELL_DEG
from .check import chosen
from .project import configured, read_rows, sheet

ASKED_AT_ONCE = 8
NAMED = 5  # of many tiles


def list_of_scenes(
    catalogue: str,
    to: str,
    names: Sequence[str],
    *,
    hosts: Sequence[str] = (),
    column: str = "",
    dates: tuple[str, str] | None = None,
    configfiles: Sequence[Path] | None = None,
) -> list[str]:
    """Write the list of the tiles that touch the ground of scenes; returns what was found.

    ``names`` of scenes or cities; all without. ``column``, ``dates``: see
    :func:`..lidar.catalogue.read_catalogue`. Raises InputError; then nothing is written.
    """
    settings, _ = configured(configfiles)
    cities, scenes, _ = read_rows(settings)
    rows = sheet(settings, "scenes")
    found = chosen(names, scenes, cities, rows)
    if not to.lower().endswith(SUFFIX):
        raise InputError(
            "is no name of a list of tiles", file=to or "--to", remedy="end it with .tsv"
        )
    pairs = [(_here(scene.left_image), _here(scene.right_image)) for scene in found.values()]
    margin_m = margin_of(settings)
    listed, lines = list_tiles(catalogue, pairs, margin_m, frozenset(hosts), column, dates)
    write_list(listed, to)
    naming = [name for name, scene in scenes.items() if to in scene.lidar]
    rest = f"; scenes {', '.join(naming)} name it" if naming else ""
    remedy = "" if naming else f". Next: name it in the column lidar of {rows}"
    return [*lines, f"{to}: {in_number(len(listed.tiles), 'tile')}{rest}{remedy}"]


def margin_of(settings: Configuration) -> float:
    """Metres around the ground of scenes; where a run takes all points, those of the default."""
    margin_m = settings.ingest.margin_m
    return float(Ingest().margin_m) if margin_m is None else float(margin_m)


def _here(image: str) -> str:
    return str(bring_image(image)) if is_remote(image) else image


def list_tiles(
    catalogue: str,
    pairs: Iterable[tuple[str, str]],
    margin_m: float,
    hosts: frozenset[str],
    column: str = "",
    dates: tuple[str, str] | None = None,
) -> tuple[TileList, list[str]]:
    """The tiles that touch the ground of pairs (left and right image), and what was found.

    ``margin_m`` around what the pairs show. Raises InputError: no catalogue, no tile on that
    ground, tiles that are not there or lead to where they may not, or of different heights.
    """
    footprint = footprint_of(pairs, margin_m)
    if footprint is None:
        raise InputError(
            "the ground of the images is not told by their RPCs",
            file=catalogue,
            remedy="correct the images (stereotruth check), or name the tiles' files by hand",
        )
    read = read_catalogue(catalogue, column=column, dates=dates, hosts=hosts)
    cover = cover_of(read.tiles, footprint)
    taken = [read.tiles[k] for k in cover.taken]
    if not taken:
        row, first, _ = footprint.runs[0]
        raise InputError(
            f"none of its {in_number(len(read.tiles), 'tile')} lies on the ground of the images, "
            f"about {first * CELL_DEG:.4f}, {row * CELL_DEG:.4f} (longitude, latitude)",
            file=catalogue,
            remedy="take the catalogue of that region, and check its coordinate system",
        )
    places = [resolved(tile.href, catalogue, hosts) for tile in taken]
    crs = _system_of(taken, catalogue)
    listed = TileList(
        without_secrets(catalogue),
        read.sha256,
        read.bytes,
        tuple(sorted(hosts)),
        tuple((row, first, last) for row, first, last in footprint.runs),
        cover.area_m2,
        cover.hole_m2,
        crs,
        _asked(taken, places, hosts, catalogue),
    )
    return listed, _lines(listed, len(read.tiles), places, cover)


def _asked(
    taken: Sequence[Tile], places: Sequence[str], hosts: frozenset[str], catalogue: str
) -> tuple[ListedTile, ...]:
    """The tiles, each once, as they are now. Raises InputError that names those not there."""
    first = [place not in places[:k] for k, place in enumerate(places)]
    tiles, files = list(compress(taken, first)), list(compress(places, first))
    with ThreadPoolExecutor(ASKED_AT_ONCE) as pool:
        states = list(pool.map(lambda file: _state(file, hosts), files))
    if missing := [without_secrets(file) for file, state in zip(files, states) if state is None]:
        more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
        raise InputError(
            f"{len(missing)} of {in_number(len(files), 'tile')} on the ground of the images "
            f"{'is' if len(missing) == 1 else 'are'} not there: {', '.join(missing[:NAMED])}{more}",
            file=catalogue,
            remedy="put them there, or take them out of the catalogue; their ground then counts "
            "as covered by no tile",
        )
    return tuple(
        ListedTile(file, *state, -1 if tile.points is None else tile.points, tile.start, tile.end)
        for tile, file, state in zip(tiles, files, states)
        if state is not None
    )


def _state(file: str, hosts: frozenset[str]) -> tuple[int, str] | None:
    """Bytes and content (of a server) of a tile; None if it is not there."""
    if is_remote(file):
        state = state_of(file, hosts)
        return None if state is None else (state.size, state.content)
    return (Path(file).stat().st_size, "") if Path(file).is_file() else None


def _system_of(tiles: Sequence[Tile], catalogue: str) -> str:
    """The system of all tiles by the catalogue, or empty; as ``lidar_crs`` has it.

    Raises InputError where their heights count from different surfaces, or have different units.
    """
    systems: dict[str, LidarCRS | None] = {"": None}
    for text in {tile.crs for tile in tiles} - {""}:
        try:
            systems[text] = interpret(CRS.from_user_input(text))
        except (CRSError, ValueError):
            systems[text] = None
    kinds = Counter(_heights(systems[tile.crs]) for tile in tiles)
    if len(kinds) > 1:
        counted = "; ".join(f"{count}: {kind}" for kind, count in kinds.most_common())
        raise InputError(
            f"heights of its tiles count from different surfaces ({counted})",
            file=catalogue,
            remedy="part the catalogue by them, and list each part for rows with its own geoid",
        )
    every = {tile.crs for tile in tiles}
    if len(every) > 1 or every == {""} or systems[min(every)] is None:
        return ""
    crs = CRS.from_user_input(min(every))
    code = crs.to_epsg()
    if code is None and crs.is_compound:
        codes = [part.to_epsg() for part in crs.sub_crs_list]
        code = "+".join(map(str, codes)) if all(codes) else None
    return crs.to_wkt() if code is None else f"EPSG:{code}"


def _heights(system: LidarCRS | None) -> str:
    """What heights count from, and their unit."""
    if system is None or not system.has_vertical:
        return "not declared"
    kind = "ellipsoid" if system.ellipsoidal else str(system.vertical_datum)
    return f"{kind}, {system.vertical_unit or 'metre'}"


def _lines(listed: TileList, every: int, places: Sequence[str], cover: Cover) -> list[str]:
    """What users are to know of a new list."""
    tiles = listed.tiles
    counts = [tile.points for tile in tiles]
    points = f", {sum(counts) / 1e6:.1f} M points" if min(counts) >= 0 else ""
    days = sorted(filter(None, [day for tile in tiles for day in (tile.start, tile.end)]))
    dated = f", of {days[0]} to {days[-1]}" if days else ", without dates"
    lines = [
        f"{listed.catalogue}: {len(tiles)} of {in_number(every, 'tile')} lie on the "
        f"{cover.area_m2 / 1e6:.4g} km² that the images see at most, with the margin",
        f"tiles: {listed.tile_bytes / 1e6:.1f} MB{points}{dated}; of COPC and EPT a run reads what "
        "lies on that ground",
    ]
    if listed.crs:
        crs = listed.crs
        named = crs if crs.startswith("EPSG:") else CRS.from_user_input(crs).name
        lines.append(f"coordinates by the catalogue, where files and lidar_crs say none: {named}")
    if listed.hole_m2 and cover.hole_at:
        at = ", ".join(f"{value:.4f}" for value in cover.hole_at)
        lines.append(f"{listed.hole_text}; most of it about {at}")
    for one, other in cover.doubled[:NAMED]:
        a, b = (without_secrets(places[cover.taken.index(k)]) for k in (one, other))
        lines.append(
            f"listed twice: {a}" if a == b else f"two tiles cover the same ground: {a}, {b}"
        )
    if len(cover.doubled) > NAMED:
        lines.append(f"{len(cover.doubled) - NAMED} more tiles cover the same ground as others")
    return lines
