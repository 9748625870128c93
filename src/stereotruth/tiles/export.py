"""Benchmark tiles of a city: windows, crops, labels, manifest (section III-D of the paper).

A tile pair is a square of the left epipolar image and the square of the same rows of the right
one, moved along x by a whole number of pixels (``right_offset_px``: the mean disparity, rounded,
so that no image is resampled again). The tile's disparity is that of the scene less the offset.

Rules for a pair, at its window of the scene's grid:

- complete images: no pixel of the left crop is nodata, the right crop lies inside the right grid
  and at most :data:`.scene_stores.MAX_RIGHT_NODATA` of it is nodata;
- labelled: a share of at least ``min_labelled`` of its pixels has a disparity. Other pairs with
  complete images go under ``unlabelled/``.

Each labelled pair is held against its images as it is written: SIFT matches, image warping, and the
gates of :mod:`.label_doubts`, which flag tiles and scenes in the manifest and the summary.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import Export
from ..core.errors import InputError
from ..core.job import progress
from ..core.products.files import atomic_file, atomic_folder, growing_table, write_table
from ..core.products.provenance import describe, source_digest
from .label_doubts import Doubt, doubts, flag, missed
from .manifest import NONE, STATUS_COLOURS_FILE, column
from .quick_looks import (
    draw_contact_sheet,
    draw_coverage,
    feature,
    write_footprints,
    write_ground_looks,
    write_status_colours,
)
from .scene_stores import (
    SceneFiles,
    SceneStores,
    Window,
    cell_step,
    choose_windows,
    open_stores,
    scan_scene,
)
from .sift_matches import MATCH_COLUMNS, match_rows
from .splits import Place, scaled_counts, split_tiles
from .tile_checks import (
    CHECK_COLUMNS,
    SceneChecks,
    TileChecks,
    flagged,
    in_counts,
    sigma_by_surface,
    summarise,
)
from .tile_files import FILES, RIGHT_FILES, City, Cut, write_tile
from .verify import write_export

log = logging.getLogger("stereotruth")

SPARSE = 1.0  # LiDAR points in a pixel; with fewer, most windows have too few labels


@dataclass(frozen=True)
class Extras:
    """What is made together with the tiles: files and a folder to write, None for what is not.

    ``coverage`` and ``contact_sheet``: PNG; ``matches``: CSV of all SIFT matches;
    ``ground_looks``: folder of georeferenced quick looks.
    """

    coverage: str | Path | None = None
    contact_sheet: str | Path | None = None
    matches: str | Path | None = None
    ground_looks: str | Path | None = None

    @contextmanager
    def being_written(self) -> Iterator[tuple[Extras, Any]]:
        """Places that become the files when the block ends well, all at the end; and the writer of
        the table of matches.

        A job that outlives its run cannot be found halfway.
        """
        with ExitStack() as stack:
            table = None
            if self.matches is not None:
                table = stack.enter_context(growing_table(self.matches, MATCH_COLUMNS))
            coverage, contact_sheet = (
                None if path is None else stack.enter_context(atomic_file(path))
                for path in (self.coverage, self.contact_sheet)
            )
            looks = None
            if self.ground_looks is not None:
                looks = stack.enter_context(atomic_folder(self.ground_looks))
            yield Extras(coverage, contact_sheet, self.matches, looks), table


@dataclass(frozen=True)
class _Windows:
    """The windows of all scenes of a city, in the order of their tiles' numbers.

    ``phases``, ``outcomes``, ``pictures`` (small image, mask, scale): by scene.
    """

    sources: list[SceneStores]
    chosen: list[tuple[SceneStores, Window]]
    phases: dict[str, tuple[int, int]]
    outcomes: dict[str, dict[str, int]]
    pictures: dict[str, tuple[NDArray[np.uint16], NDArray[np.bool_], int]]

    @classmethod
    def of(cls, scenes: Iterable[SceneFiles | tuple], settings: Export, workers: int) -> _Windows:
        """Open the scenes and choose their windows; labelled ones come first."""
        stride = settings.stride or settings.size
        step = cell_step(settings.size, stride)
        found = cls([], [], {}, {}, {})
        for item in scenes:
            source = open_stores(SceneFiles(*item), settings.max_uncertainty_px)
            cells = scan_scene(source, step, workers)
            windows, phase, outcome = choose_windows(
                cells, settings.size, stride, settings.min_labelled, settings.right_offset
            )
            found.sources.append(source)
            found.chosen.extend((source, window) for window in windows)
            found.phases[source.scene], found.outcomes[source.scene] = phase, outcome
            found.pictures[source.scene] = (cells.picture, cells.mask, cells.scale)
        found.chosen.sort(key=lambda pair: not pair[1].labelled)  # stable
        return found

    def kinds(self, layers: Sequence[str]) -> set[str]:
        """Folders of the files that tiles with these ``layers`` have."""
        kinds = {"left", "right", "disp", "status", "orientation", *layers}
        if any(source.of_right is not None for source in self.sources):
            kinds |= set(RIGHT_FILES)
        if not all(window.labelled for _, window in self.chosen):
            kinds |= {"unlabelled/left", "unlabelled/right"}
        return kinds


def export_city(
    city: City,
    scenes: Iterable[SceneFiles | tuple],
    out_dir: str | Path,
    settings: Export,
    *,
    extras: Extras | None = None,
    code: str = "",
    workers: int = 1,
    work: str | Path | None = None,
) -> dict[str, Any]:
    """Cut a city's scenes into tiles: the whole folder ``tiles/<City>``, or nothing.

    ``scenes``: per scene its id, disparity.zarr, left.zarr, right.zarr and optionally
    alignment.json (for the record), the store of the right view's labels, the days of its images
    and what the alignment says. ``extras``: what is
    made besides. ``work``: folder in which finished tiles wait for a later call that would make the
    same, by default a hidden one beside ``out_dir``. Returns a summary, see
    :func:`.tile_checks.summary_lines`.

    Raises InputError if there is no labelled pair, if the settings cannot work, or if
    ``strict`` and the splits' counts cannot be met or a limit of ``quality`` is exceeded.
    """
    out, extras = Path(out_dir), extras or Extras()
    dtype, nodata = settings.disparity_dtype, settings.nodata
    if float(np.dtype(dtype).type(nodata)) != float(nodata):
        raise InputError(
            f"nodata {nodata:g} cannot be stored in {dtype}",
            remedy="set tiles.nodata to -999, or tiles.disparity_dtype to float32",
        )
    windows = _Windows.of(scenes, settings, workers)
    if not any(window.labelled for _, window in windows.chosen):
        _refuse_empty(city.city, windows, settings)
    parameters = _parameters(settings, city)
    inputs = {name: value for source in windows.sources for name, value in source.inputs.items()}
    flags = {name: flag for source in windows.sources for name, flag in source.flags.items()}
    cut = Cut(
        city=city,
        settings=settings,
        code=code or source_digest("stereotruth.tiles.export"),
        flags=dict(sorted(flags.items())),
        work=out.with_name(f".{out.name}.work") if work is None else Path(work),
        provenance=describe(inputs, parameters, code),
    )
    with extras.being_written() as beside, atomic_folder(out) as scratch:
        for kind in windows.kinds(settings.layers):
            (scratch / kind).mkdir(parents=True)
        summary, rows = _write_tiles(scratch, windows, cut, beside, parameters, workers)
        write_export(scratch, summary, cut.provenance)
        _forget_others(cut, rows)
    return summary


def _refuse_empty(city: str, windows: _Windows, settings: Export) -> None:
    size, sources = settings.size, windows.sources
    lines = [
        f"scene {scene}: " + ", ".join(f"{count} {what}" for what, count in outcome.items())
        for scene, outcome in windows.outcomes.items()
    ]
    sparse = ", ".join(
        f"{source.scene} {source.points_per_px:.2g}"
        for source in sources
        if source.points_per_px is not None and source.points_per_px < SPARSE
    )
    if sparse:
        sparse = (
            f"; LiDAR points are sparser than pixels (a pixel has, on the average: {sparse}): "
            "project.recipe: surface, the default, labels pixels between them"
        )
    told = "; ".join(
        f"the alignment of scene {source.scene} is in doubt: {doubt}"
        for source in sources
        for doubt in source.doubts
    )
    remedy = (
        f"a smaller tiles.size (now {size}), a smaller tiles.min_labelled (now "
        f"{settings.min_labelled:g}), or LiDAR that covers the overlap of the two images{sparse}"
    )
    if told:
        told = f". Labels are missing where LiDAR and images disagree: {told}"
        remedy = f"first what the alignment's doubts say; else {remedy}"
    raise InputError(
        f"{city}: not one labelled tile pair of {size} px ({'; '.join(lines)}){told}",
        remedy=remedy,
    )


def _parameters(settings: Export, city: City) -> dict[str, Any]:
    """What the tiles follow from besides the scenes, for their record."""
    parameters = {
        "size": settings.size,
        "stride": settings.stride or settings.size,
        "min_labelled": settings.min_labelled,
        "right_offset": settings.right_offset,
        "disparity_dtype": settings.disparity_dtype,
        "nodata": settings.nodata,
        "max_uncertainty_px": settings.max_uncertainty_px,
        "split_counts": city.split_counts,
        "seed": settings.seed,
        "quality": settings.quality.model_dump(),
        "building_share": settings.building_share,
    }
    return parameters | ({"layers": list(settings.layers)} if settings.layers else {})


def _write_tiles(
    scratch: Path,
    windows: _Windows,
    cut: Cut,
    beside: tuple[Extras, Any],
    parameters: Mapping[str, Any],
    workers: int,
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Write tiles, manifest, footprints and extras; the summary, and the manifest's rows."""
    (extras, table), settings = beside, cut.settings

    def write(k: int) -> tuple[dict[str, Any], NDArray[np.float64], TileChecks | None]:
        return write_tile(scratch, *windows.chosen[k], k, cut)

    def draw(rows: Sequence[dict[str, Any]]) -> None:
        """One figure after the other: Matplotlib is not made for threads."""
        if extras.coverage is not None:
            draw_coverage(extras.coverage, city, rows, windows.pictures)
        if extras.contact_sheet is not None:
            draw_contact_sheet(extras.contact_sheet, city, rows, scratch, settings.nodata)

    city, count = cut.city.city, len(windows.chosen)
    written, scene_checks = [], {s.scene: SceneChecks(s.gcp_rms) for s in windows.sources}
    with ThreadPoolExecutor(workers) as pool:
        tiles = pool.map(write, range(count))
        drawn = []  # while the last tiles are written
        if (looks := extras.ground_looks) is not None:
            drawn = [pool.submit(write_ground_looks, looks, s) for s in windows.sources]
        for row, ring, checks in progress(tiles, count, f"{city}: tiles"):
            written.append((row, ring))
            if checks is not None:
                scene_checks[row["scene"]].add(checks, row["row0"], row["col0"])
                if table is not None:
                    head = {key: row[key] for key in ("city", "scene", "tile", "class")}
                    table.writerows(match_rows(head, checks.matches))
        rows = [row for row, _ in written]
        splits = _split(written, cut.city, settings)
        drawn.append(pool.submit(draw, rows))
        told = {source.scene: source.told for source in windows.sources}
        gates = _gates(city, rows, scene_checks, told, settings)
        for source in windows.sources:
            gates["scenes"][source.scene]["lidar_points_per_m2"] = source.points_per_m2
            gates["scenes"][source.scene]["lidar"] = source.lidar
        summary = summarise(city, rows, splits, windows.phases, windows.outcomes, parameters)
        summary["quality"] = gates
        stated = np.sum([checks.stated for checks in scene_checks.values()], axis=0)
        summary["label_uncertainty"] = sigma_by_surface(stated)
        write_table(scratch / "manifest.csv", rows)
        write_footprints(scratch, [feature(row, ring) for row, ring in written])
        write_status_colours(scratch / STATUS_COLOURS_FILE, cut.flags)
        for picture in drawn:
            picture.result()
    return summary, rows


def _forget_others(cut: Cut, rows: Sequence[Mapping[str, Any]]) -> None:
    """Remove what earlier calls have left for tiles that are no more."""
    cut.ledger.keep_only({row["tile"] for row in rows})
    kept = {
        cut.work / row[kind]
        for row in rows
        for kind in (*FILES, *RIGHT_FILES, *map(column, cut.settings.layers))
        if row.get(kind)
    }
    for file in cut.work.rglob("*.tiff"):
        if file not in kept:
            file.unlink()


def _split(
    written: Sequence[tuple[dict[str, Any], NDArray[np.float64]]], city: City, settings: Export
) -> dict[str, Any]:
    """Set the split of every labelled row; wanted and realised counts."""
    weights = city.split_counts
    labelled = [(row, ring) for row, ring in written if row["complete"] == "yes"]
    places = [
        Place(row["scene"], row["row0"], row["col0"], row["size"], ring) for row, ring in labelled
    ]
    found = split_tiles(places, weights, settings.seed)
    for (row, _), split in zip(labelled, found):
        row["split"] = split
    wanted = scaled_counts(len(labelled), weights)
    realised = {name: found.count(name) for name in (*wanted, NONE)}
    if any(realised[name] != count for name, count in wanted.items()):
        problem = (
            f"{city.city}: splits of {in_counts(realised)} tiles instead of {in_counts(wanted)}, "
            "since tiles that share ground must not be in two splits"
        )
        if settings.strict:
            raise InputError(problem, remedy="a tiles.stride of tiles.size, or strict: false")
        log.warning("%s", problem)
    return {"wanted": wanted, "realised": realised}


def _gates(
    city: str,
    rows: Sequence[dict[str, Any]],
    scenes: Mapping[str, SceneChecks],
    told: Mapping[str, Sequence[Doubt]],
    settings: Export,
) -> dict[str, Any]:
    """Figures, missed gates and doubts of scenes, flagged tiles; sets the doubt of every tile.

    ``told``: by scene, what earlier stages have said of it. Logs each miss and what the images
    doubt, or ends a strict run.
    """
    limits, found, problems = settings.quality, {}, []
    in_doubt: dict[str, list[Doubt]] = {}
    for scene, checks in scenes.items():
        figures = checks.figures()
        misses = missed(figures, limits)
        found[scene] = figures | {"quality": flag(misses)}
        by_images = doubts(checks.matches.biases, limits.min_agreement)
        in_doubt[scene] = [*by_images, *told.get(scene, ())]
        problems += [f"scene {scene}: {miss}" for miss in misses]
        problems += [f"scene {scene}: {doubt}" for doubt in by_images if not doubt.explained]
    labelled = [row for row in rows if row["complete"] == "yes"]
    for row in labelled:
        row["doubt"] = "; ".join(map(str, in_doubt[row["scene"]]))
        figures = {name: float(row[name]) for name in CHECK_COLUMNS if row[name] != ""}
        problems += [
            f"tile {row['tile']} of scene {row['scene']}: {miss}"
            for miss in missed(figures, limits)
        ]
    if problems and settings.strict:
        more = f"; and {len(problems) - 5} more" if len(problems) > 5 else ""
        raise InputError(
            f"{city}: beyond the limits of quality: {'; '.join(problems[:5])}{more}",
            remedy="better control points, images or LiDAR for what is named, another limit "
            "(null: none) in quality of the configuration, or strict: false to have it flagged",
        )
    explained = [
        f"scene {scene}: {doubt}"
        for scene, of in in_doubt.items()
        for doubt in of
        if doubt.explained
    ]
    for problem in problems + explained:
        log.warning("%s: %s", city, problem)
    return {
        "limits": limits.model_dump(),
        "scenes": found,
        "surfaces": {
            scene: {bias.surface.replace(" ", "_"): bias.to_dict() for bias in of.matches.biases}
            for scene, of in scenes.items()
        },
        "doubts": {s: [d.to_dict() for d in of] for s, of in in_doubt.items() if of},
        "flagged_tiles": flagged(labelled),
    }
