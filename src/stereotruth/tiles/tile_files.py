"""One tile: its pixels, its layers, its files, its row of the manifest."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import Export
from ..core.errors import InputError
from ..core.numerics.geometry import turn
from ..core.products.files import link
from ..core.products.provenance import digest, file_sha256
from ..core.products.rasters import write_tiff
from ..core.products.resumable_grids import Ledger
from ..epipolar.intersection import intersect
from ..epipolar.warping import agreement, warp_rows
from .label_surfaces import Buildings, heights_above_ground, label_surfaces
from .manifest import KINDS, NONE, column, disparity_cells
from .orientation import orientation, save
from .scene_stores import SceneStores, Window
from .sift_matches import match_tile
from .tile_checks import TileChecks, check_cells, count_sigma

FILES = ("left", "right", "disp", "status", "orientation")
RIGHT_FILES = ("disp_right", "status_right")  # labels of the right view, where a scene has them
STEPS = 1024  # in a px, of disparities in 32 bits: they compress to little more than half
MARGIN_PX = 128  # around a tile, from which the ground below its roofs is known
Slices = tuple[slice, slice]  # rows and columns of a scene's grid


def round_disparity(disparity: NDArray[np.floating], dtype: str) -> NDArray[np.float32]:
    """Disparities as stored, in float32, rounded to nearest: of 1/1024 px, or of float16."""
    if dtype == "float16":
        return disparity.astype(np.float16).astype(np.float32)
    return (np.rint(disparity * STEPS) / STEPS).astype(np.float32)


@dataclass(frozen=True)
class City:
    """A name, the prefix of its tiles, and tiles of table 3 by split.

    As in the cities sheet, whose reader no code digest may hold.
    """

    city: str
    prefix: str
    training: int
    validation: int
    testing: int

    @property
    def split_counts(self) -> dict[str, int]:
        """Tiles by split, which are scaled to the tiles there are."""
        return {"train": self.training, "val": self.validation, "test": self.testing}


@dataclass(frozen=True, eq=False)
class Cut:
    """How the tiles of a city are cut and written.

    ``flags``: meaning of the status values of all scenes; ``work``: where the files of finished
    tiles wait, with the ledger.
    """

    city: City
    settings: Export
    code: str
    flags: Mapping[int, str]
    work: Path
    provenance: Mapping[str, Any]

    @property
    def ledger(self) -> Ledger:
        """Records of the tiles whose files are there."""
        return Ledger(self.work / "done")


@dataclass(frozen=True, eq=False)
class _Crop:
    """The pixels of a tile, and what they are called."""

    left: NDArray[np.uint16]
    right: NDArray[np.uint16]
    disparity: NDArray[np.float64]  # of the pair, NaN where there is none
    stored: NDArray[np.float32]  # the same as the file has it
    status: NDArray[np.uint8]
    of_right: NDArray[np.float32] | None
    status_of_right: NDArray[np.uint8] | None
    colour_left: NDArray[np.uint16] | None  # [3, h, w]
    colour_right: NDArray[np.uint16] | None

    @classmethod
    def of(cls, source: SceneStores, window: Window, cut: Cut) -> _Crop:
        here = window.of_left(cut.settings.size)
        there = here[0], slice(here[1].start - window.offset, here[1].stop - window.offset)
        disparity = source.disparity[here].astype(np.float64) - window.offset
        of_right = status_of_right = None
        if window.labelled and source.of_right is not None:
            values = source.of_right["disparity"][there].astype(np.float64) - window.offset
            of_right = round_disparity(values, cut.settings.disparity_dtype)
            status_of_right = source.of_right["status"][there]
        colours = dict.fromkeys(("colour_left", "colour_right"))
        if source.colours is not None:
            for name, bands, part in zip(colours, source.colours, (here, there)):
                colours[name] = np.stack([band[part] for band in bands])
        return cls(
            left=source.left[here],
            right=source.right[there],
            disparity=disparity,
            stored=round_disparity(disparity, cut.settings.disparity_dtype),
            status=source.status[here],
            of_right=of_right,
            status_of_right=status_of_right,
            **colours,
        )

    def arrays(self) -> list[NDArray[Any]]:
        """All that the tile's files but the orientation follow from."""
        found = (getattr(self, f.name) for f in fields(self))
        return [np.ascontiguousarray(array) for array in found if array is not None]


def tile_names(
    source: SceneStores, window: Window, number: int, prefix: str, layers: Sequence[str] = ()
) -> dict[str, str]:
    """Paths of a tile's files in the city's folder, by kind."""
    group = "" if window.labelled else "unlabelled/"
    names = {
        "left": f"{group}left/{prefix}_left_{number}.tiff",
        "right": f"{group}right/{prefix}_right_{number}.tiff",
        "orientation": f"orientation/{prefix}_{number}.json",
    }
    if window.labelled:
        names["disp"] = f"disp/{prefix}_disparity_{number}.tiff"
        names["status"] = f"status/{prefix}_status_{number}.tiff"
        if source.of_right is not None:
            names["disp_right"] = f"disp_right/{prefix}_disparity_right_{number}.tiff"
            names["status_right"] = f"status_right/{prefix}_status_right_{number}.tiff"
        names |= {column(layer): f"{layer}/{prefix}_{layer}_{number}.tiff" for layer in layers}
    return names


def _write_images(
    paths: Mapping[str, Path], source: SceneStores, window: Window, crop: _Crop, cut: Cut
) -> None:
    """Write a tile's TIFF files."""
    for path in paths.values():
        path.parent.mkdir(parents=True, exist_ok=True)
    for view in ("left", "right"):
        grey, colour = getattr(crop, view), getattr(crop, f"colour_{view}")
        write_tiff(paths[view], grey if colour is None else colour, nodata=0)
    if not window.labelled:
        return
    meanings = ", ".join(f"{value} {meaning}" for value, meaning in source.flags.items())
    options = {"nodata": cut.settings.nodata, "half": cut.settings.disparity_dtype == "float16"}
    known = np.isfinite(crop.disparity)
    _write_labels(paths["disp"], np.where(known, crop.stored, np.nan), **options)
    write_tiff(paths["status"], crop.status, description=meanings)
    if crop.of_right is not None and crop.status_of_right is not None:
        _write_labels(paths["disp_right"], crop.of_right, **options)
        write_tiff(paths["status_right"], crop.status_of_right, description=meanings)


@dataclass(frozen=True, eq=False)
class LabelsKnown:
    """What is known of a tile's labels beside their values: uint8[h, w], and px, float64[h, w].

    ``kind``: class of the tile; ``surface``: see :class:`.label_surfaces.LabelSurface`; ``sigma``:
    their uncertainty, 0 where a store does not tell.
    """

    kind: str
    surface_class: NDArray[np.uint8]
    surface: NDArray[np.uint8]
    sigma: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        source: SceneStores,
        here: Slices,
        disparity: NDArray[np.float64],
        building_share: float,
    ) -> LabelsKnown:
        """Of the tile at those rows and columns."""
        surface_class = _classes(source, here)
        sigma = np.zeros(disparity.shape)
        if source.uncertainty is not None:
            sigma = np.nan_to_num(np.asarray(source.uncertainty[here], np.float64))
        buildings = Buildings.of_tile(surface_class, source.height, here)
        return cls(
            kind=buildings.tile_class(building_share),
            surface_class=surface_class,
            surface=label_surfaces(disparity, sigma, surface_class, buildings.found),
            sigma=sigma,
        )


def tile_layers(source: SceneStores, here: Slices, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The layers of a tile at those rows and columns, as their files have them."""
    if not names:
        return {}
    known = np.isfinite(np.asarray(source.disparity[here]))
    values: dict[str, NDArray[Any]] = {}
    if "class" in names:
        values["class"] = _classes(source, here)
    if "lidar_date" in names:
        dates = source.lidar_date
        values["lidar_date"] = np.zeros(known.shape) if dates is None else dates[here]
    if "uncertainty" in names:
        sigma = source.uncertainty
        values["uncertainty"] = np.full(known.shape, np.nan) if sigma is None else sigma[here]
    if "height" in names or "agl" in names:
        margin = MARGIN_PX if "agl" in names else 0
        wide = tuple(
            slice(max(s.start - margin, 0), min(s.stop + margin, n))
            for s, n in zip(here, source.left.shape)
        )
        part = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(here, wide))
        disparity = np.asarray(source.disparity[wide], np.float32)
        ground = intersect(source.model, disparity, wide[0].start, wide[1].start)
        values["height"] = ground[2][part]
        if "agl" in names:
            values["agl"] = heights_above_ground(ground, _classes(source, wide))[part]
    return {name: _stored(name, values[name], known) for name in names}


def _classes(source: SceneStores, window: Slices) -> NDArray[np.uint8]:
    if source.surface_class is None:
        return np.zeros(source.left[window].shape, np.uint8)
    return np.asarray(source.surface_class[window])


def _stored(name: str, values: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[Any]:
    """Values as the file has them: nodata where the pixel has no label."""
    kind = KINDS[name]
    dtype = np.dtype(kind.dtype)
    with np.errstate(invalid="ignore"):
        good = known & np.isfinite(values.astype(np.float64))
    return np.where(good, values, kind.nodata).astype(dtype)


def _finished(
    source: SceneStores, window: Window, names: Mapping[str, str], crop: _Crop, cut: Cut
) -> tuple[dict[str, str], TileChecks | None]:
    """Write a tile's TIFF files and check it, or take it over; their checksums, and the checks.

    A tile is taken over if its pixels, what its checks need, names, settings and code are the same.
    """
    here, known = window.of_left(cut.settings.size), None
    if window.labelled:
        known = LabelsKnown.of(source, here, crop.disparity, cut.settings.building_share)
    layers = tile_layers(source, here, cut.settings.layers) if window.labelled else {}
    pixels = hashlib.sha256()
    arrays = [*crop.arrays(), *layers.values()]
    if known is not None:  # what the checks follow from, beside the pixels
        arrays += [known.surface_class, known.surface, known.sigma]
    for array in arrays:
        pixels.update(array)
    files = {name: path for name, path in names.items() if name != "orientation"}
    paths = {name: cut.work / path for name, path in files.items()}
    made_of = {
        "pixels": pixels.hexdigest(),
        "files": files,
        "flags": [[int(value), meaning] for value, meaning in source.flags.items()],
        "settings": [
            cut.settings.disparity_dtype,
            cut.settings.nodata,
            known.kind if known else "",
        ],
        "code": cut.code,
    }
    key, tile = digest(made_of), f"{cut.city.prefix}_{names['left'].rpartition('_')[2][:-5]}"
    piece = cut.ledger.find(tile, key, paths)
    if piece is None:
        _write_images(paths, source, window, crop, cut)
        for name, values in layers.items():
            kind, path = KINDS[name], paths[column(name)]
            write_tiff(path, values, nodata=kind.nodata, description=kind.description)
        checks = None
        if known is not None:
            stored = np.where(np.isfinite(crop.disparity), crop.stored.astype(np.float64), np.nan)
            checks = check_labels(crop.left, crop.right, stored, known)
        piece = cut.ledger.put(tile, key, paths, None if checks is None else checks.to_dict())
    found = piece.result
    return dict(piece.sha256), None if found is None else TileChecks.from_dict(found)


def write_tile(
    folder: Path, source: SceneStores, window: Window, number: int, cut: Cut
) -> tuple[dict[str, Any], NDArray[np.float64], TileChecks | None]:
    """Put a tile into ``folder``: manifest row (without split), ring on the ground, checks."""
    name = f"{cut.city.prefix}_{number}"
    crop = _Crop.of(source, window, cut)
    known, disparity = np.isfinite(crop.disparity), crop.disparity
    if any((v == cut.settings.nodata).any() for v in (crop.stored, crop.of_right) if v is not None):
        raise InputError(
            f"tile {name} has a true disparity of {cut.settings.nodata:g} px, the value for nodata",
            remedy="set tiles.nodata to a value that no disparity takes",
        )
    files = tile_names(source, window, number, cut.city.prefix, cut.settings.layers)
    sums, checks = _finished(source, window, files, crop, cut)
    for kind in sums:
        link(cut.work / files[kind], folder / files[kind])
    height = source.height[window.of_left(cut.settings.size)]
    record = orientation(
        source.model,
        source.sensors,
        row0=window.row0,
        col0=window.col0,
        size=cut.settings.size,
        offset=window.offset,
        height=height,
        disparity=np.where(known, crop.stored, np.nan),
    )
    head = {"tile": name, "city": cut.city.city, "scene": source.scene, "files": files}
    if source.lidar and (frame := source.lidar.get("frame")):
        head["ground_frame"] = frame
    save(folder / files["orientation"], head | record | {"provenance": cut.provenance})
    sums["orientation"] = file_sha256(folder / files["orientation"])

    ring = np.array(record["footprint"]["coordinates"][0][:-1])
    rounding = np.abs(crop.stored[known].astype(np.float64) - disparity[known])
    lon, lat = ring.mean(axis=0)
    row = {
        "tile": name,
        "number": number,
        "city": cut.city.city,
        "scene": source.scene,
        "row0": window.row0,
        "col0": window.col0,
        "size": cut.settings.size,
        "right_offset_px": window.offset,
        "complete": "yes" if window.labelled else "no",
        "split": NONE,
        **disparity_cells(crop.stored, disparity),
        "disparity_rounding_px": f"{rounding.max():.6f}" if rounding.size else "",
        "disparity_nodata": f"{cut.settings.nodata:g}",
        "lon": f"{turn(lon):.7f}",
        "lat": f"{lat:.7f}",
        **_lidar_days(source, window, known),
        **_light(source),
        **check_cells(checks, cut.settings.quality),
    }
    for value, meaning in cut.flags.items():
        row[f"count_{meaning}"] = int((crop.status == value).sum())
    for kind in (
        *FILES,
        *(RIGHT_FILES if source.of_right is not None else ()),
        *map(column, cut.settings.layers),
    ):
        row[kind] = files.get(kind, "")
        row[f"{kind}_sha256"] = sums.get(kind, "")
    return row, ring, checks


def _lidar_days(
    source: SceneStores, window: Window, known: NDArray[np.bool_]
) -> dict[str, int | str]:
    """Days from the LiDAR to both images: of a pair's labels (``known``), the median of those whose
    day is known; empty where no such day, or none of the image, is."""
    days = np.empty(0, np.uint16)
    if source.lidar_date is not None:
        days = np.asarray(source.lidar_date[window.of_left(len(known))])[known]
        days = np.sort(days[days > 0])
    found: dict[str, int | str] = {}
    for view, taken in zip(("left", "right"), source.acquired):
        cell = f"lidar_days_{view}"
        found[cell] = ""
        if taken and days.size:
            since_1970 = int(np.datetime64(taken, "D").astype(np.int64))
            found[cell] = since_1970 - int(days[days.size // 2])
    return found


def _light(source: SceneStores) -> dict[str, str]:
    """Whether the images share no light, and what decided that; empty where nothing says it."""
    if source.light is None:
        return {"diachronic": "", "diachronic_by": ""}
    told = "yes" if source.light["diachronic"] else "no"
    return {"diachronic": told, "diachronic_by": source.light["decided_by"]}


def _write_labels(path: Path, disparity: NDArray[np.float32], *, nodata: float, half: bool) -> None:
    """Disparities (px, NaN where there is none) as a TIFF."""
    write_tiff(
        path,
        np.where(np.isfinite(disparity), disparity, np.float32(nodata)),
        nodata=nodata,
        half=half,
        description="disparity in px, x_left - x_right of this pair",
    )


def check_labels(
    left: NDArray[np.uint16],
    right: NDArray[np.uint16],
    disparity: NDArray[np.float64],
    known: LabelsKnown,
) -> TileChecks:
    """Hold the labels of a tile (px, as stored, NaN where there is none) against its images."""
    x = np.arange(left.shape[1])[None, :] - disparity
    matches = match_tile(left, right, disparity, known.surface_class)
    labelled = np.isfinite(disparity)
    return TileChecks(
        kind=known.kind,
        matches=matches,
        warping=agreement(left.astype(np.float64), warp_rows(right.astype(np.float64), x)),
        surface=known.surface[matches.pixel],
        sigma=known.sigma[matches.pixel],
        stated=count_sigma(known.sigma[labelled], known.surface[labelled]),
    )
