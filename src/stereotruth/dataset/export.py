"""Benchmark tiles of a city: windows, crops, labels, manifest (section III-D of the paper).

A tile pair is a square of the left epipolar image and the square of the same rows of the right
one, moved along x by a whole number of pixels (``right_offset_px``: the mean disparity, rounded,
so that no image is resampled again). The tile's disparity is that of the scene less the offset.

Rules for a pair, at its window of the scene's grid:

- complete images: no pixel of the left crop is nodata, the right crop lies inside the right grid
  and at most ``MAX_RIGHT_NODATA`` of it is nodata;
- labelled: a share of at least ``min_labelled`` of its pixels has a disparity. Other pairs with
  complete images go under ``unlabelled/``.

Each labelled pair is held against its images as it is written: SIFT matches, image warping, and the
gates of :mod:`.quality_limits`, which flag tiles and scenes in the manifest and the summary.

The phase of each scene's tile grid (origin of its first window, in steps of about an eighth of a
tile) is that which gives most labelled pairs, then most pairs, then most labelled pixels.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..job import progress
from ..products.files import growing_table, replacing, whole_folder, write_table
from ..products.provenance import describe, file_sha256, own_digest, source_digest
from .footprints import FOOTPRINTS, feature, write_footprints
from .ground_looks import write_ground_looks
from .label_doubts import doubts, surface_figures
from .orientation import save
from .quality_limits import flag, missed
from .quick_looks import draw_contact_sheet, draw_coverage
from .scene_stores import SceneFiles, SceneStores, open_stores
from .settings import Limits, Settings
from .sift_matches import MATCH_COLUMNS, match_rows
from .split_names import NONE
from .splits import Place, scaled_counts, split_tiles
from .summary import in_counts, summarise
from .tile_checks import CHECK_COLUMNS, SceneChecks, TileChecks
from .tile_files import FILES, RIGHT_FILES, Cut, write_tile
from .windows import cell_step, choose_windows, scan_scene

log = logging.getLogger("stereotruth")

SPARSE = 1.0  # LiDAR points in a pixel; with fewer, most windows have too few labels


def _refuse_empty(
    city: str,
    outcomes: Mapping[str, Mapping[str, int]],
    size: int,
    min_labelled: float,
    sources: Sequence[SceneStores],
) -> None:
    lines = [
        f"scene {scene}: " + ", ".join(f"{count} {what}" for what, count in outcome.items())
        for scene, outcome in outcomes.items()
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
        f"a smaller tiles.size (now {size}), a smaller tiles.min_labelled (now {min_labelled:g}), "
        f"or LiDAR that covers the overlap of the two images{sparse}"
    )
    if told:
        told = f". Labels are missing where LiDAR and images disagree: {told}"
        remedy = f"first what the alignment's doubts say; else {remedy}"
    raise InputError(
        f"{city}: not one labelled tile pair of {size} px ({'; '.join(lines)}){told}",
        remedy=remedy,
    )


def export_city(
    city: str,
    prefix: str,
    scenes: Iterable[SceneFiles | tuple],
    out_dir: str | Path,
    *,
    settings: Settings,
    training: int,
    validation: int,
    testing: int,
    code: str = "",
    workers: int = 1,
    coverage: str | Path | None = None,
    contact_sheet: str | Path | None = None,
    matches: str | Path | None = None,
    ground_looks: str | Path | None = None,
    work: str | Path | None = None,
) -> dict[str, Any]:
    """Cut a city's scenes into tiles: the whole folder ``tiles/<City>``, or nothing.

    ``scenes``: per scene its id, disparity.zarr, left.zarr, right.zarr and optionally
    alignment.json (for the record) and the store of the right view's labels. ``training``,
    ``validation``, ``testing`` are the counts of table 3, which are scaled to the tiles there are.
    ``coverage`` and ``contact_sheet`` are PNG files to write, ``matches`` a CSV file of all SIFT
    matches, ``ground_looks`` a folder of georeferenced quick looks. ``work``: folder in which
    finished tiles wait for a later call that would make the same, by default a hidden one beside
    ``out_dir``. Returns a summary, see :func:`.summary.summary_lines`.

    Raises InputError if there is no labelled pair, if the settings cannot work, or if
    ``strict`` and the splits' counts cannot be met or a limit of ``quality`` is exceeded.
    """
    out, size, stride = Path(out_dir), settings.size, settings.stride or settings.size
    disparity_dtype, nodata = settings.disparity_dtype, settings.nodata
    if float(np.dtype(disparity_dtype).type(nodata)) != float(nodata):
        raise InputError(
            f"nodata {nodata:g} cannot be stored in {disparity_dtype}",
            remedy="set tiles.nodata to -999, or tiles.disparity_dtype to float32",
        )
    step = cell_step(size, stride)
    sources, chosen, phases, outcomes, scans = [], [], {}, {}, {}
    for item in scenes:
        source = open_stores(SceneFiles(*item), settings.max_uncertainty_px)
        cells = scan_scene(source, step, workers)
        windows, phase, outcome = choose_windows(
            cells, size, stride, settings.min_labelled, settings.right_offset
        )
        sources.append(source)
        chosen += [(source, window) for window in windows]
        phases[source.scene], outcomes[source.scene] = phase, outcome
        scans[source.scene] = (cells.picture, cells.mask, cells.scale)
    if not any(window.labelled for _, window in chosen):
        _refuse_empty(city, outcomes, size, settings.min_labelled, sources)
    chosen.sort(key=lambda pair: not pair[1].labelled)  # stable: unlabelled pairs get last numbers
    parameters = {
        "size": size,
        "stride": stride,
        "min_labelled": settings.min_labelled,
        "right_offset": settings.right_offset,
        "disparity_dtype": disparity_dtype,
        "nodata": nodata,
        "max_uncertainty_px": settings.max_uncertainty_px,
        "split_counts": {"train": training, "val": validation, "test": testing},
        "seed": settings.seed,
        "quality": asdict(settings.quality),
        "building_share": settings.building_share,
    }
    inputs = {name: value for source in sources for name, value in source.inputs.items()}
    provenance = describe(inputs, parameters, code)

    cut = Cut(
        city=city,
        prefix=prefix,
        size=size,
        dtype=disparity_dtype,
        nodata=nodata,
        building_share=settings.building_share,
        limits=settings.quality,
        code=code or source_digest("dataset.export"),
        flags=dict(sorted({k: v for source in sources for k, v in source.flags.items()}.items())),
        work=out.with_name(f".{out.name}.work") if work is None else Path(work),
        provenance=provenance,
    )
    with ExitStack() as stack:
        # all appear when the tiles do: a job that outlives its run cannot be found halfway
        table = None
        if matches is not None:
            table = stack.enter_context(growing_table(matches, MATCH_COLUMNS))
        coverage, contact_sheet = (
            None if path is None else stack.enter_context(replacing(path))
            for path in (coverage, contact_sheet)
        )
        looks = None
        if ground_looks is not None:
            looks = stack.enter_context(whole_folder(ground_looks))
        scratch = stack.enter_context(whole_folder(out))
        kinds = {"left", "right", "disp", "status", "orientation"}
        if any(source.of_right is not None for source in sources):
            kinds |= set(RIGHT_FILES)
        if not all(window.labelled for _, window in chosen):
            kinds |= {"unlabelled/left", "unlabelled/right"}
        for kind in kinds:
            (scratch / kind).mkdir(parents=True)

        def write(k: int) -> tuple[dict[str, Any], NDArray[np.float64], TileChecks | None]:
            return write_tile(scratch, *chosen[k], k, cut)

        def draw(rows: Sequence[dict[str, Any]]) -> None:
            # one figure at a time: Matplotlib is not made for threads
            if coverage is not None:
                draw_coverage(coverage, city, rows, scans)
            if contact_sheet is not None:
                draw_contact_sheet(contact_sheet, city, rows, scratch, nodata)

        written, scene_checks = [], {s.scene: SceneChecks(s.gcp_rms) for s in sources}
        with ThreadPoolExecutor(workers) as pool:
            numbers = range(len(chosen))
            tiles = pool.map(write, numbers)
            drawn = []  # while the last tiles are written
            if looks is not None:
                drawn = [pool.submit(write_ground_looks, looks, source) for source in sources]
            for row, ring, checks in progress(tiles, len(chosen), f"{city}: tiles"):
                written.append((row, ring))
                if checks is None:
                    continue
                scene_checks[row["scene"]].add(checks, row["row0"], row["col0"])
                if table is not None:
                    head = {key: row[key] for key in ("city", "scene", "tile", "class")}
                    table.writerows(match_rows(head, checks.matches))
            rows = [row for row, _ in written]
            splits = _split(
                written, parameters["split_counts"], settings.seed, settings.strict, city
            )
            drawn.append(pool.submit(draw, rows))
            gates = _gates(city, rows, scene_checks, settings.quality, settings.strict)
            for source in sources:
                gates["scenes"][source.scene]["lidar_points_per_m2"] = source.points_per_m2
            half = disparity_dtype == "float16"
            summary = summarise(city, rows, splits, phases, outcomes, parameters, half)
            summary["quality"] = gates
            write_table(scratch / "manifest.csv", rows)
            write_footprints(scratch, [feature(row, ring) for row, ring in written])
            for picture in drawn:
                picture.result()
        record = summary | {
            "manifest_sha256": file_sha256(scratch / "manifest.csv"),
            "footprints_sha256": file_sha256(scratch / FOOTPRINTS),
            "provenance": provenance,
        }
        save(scratch / "export.json", record | {"digest": own_digest(record)})
        _forget_others(cut, rows)
    return summary


def _forget_others(cut: Cut, rows: Sequence[Mapping[str, Any]]) -> None:
    """Remove what earlier calls have left for tiles that are no more."""
    cut.ledger.keep_only({row["tile"] for row in rows})
    kept = {
        cut.work / row[kind] for row in rows for kind in (*FILES, *RIGHT_FILES) if row.get(kind)
    }
    for file in cut.work.rglob("*.tiff"):
        if file not in kept:
            file.unlink()


def _split(
    written: Sequence[tuple[dict[str, Any], NDArray[np.float64]]],
    weights: Mapping[str, int],
    seed: int,
    strict: bool,
    city: str,
) -> dict[str, Any]:
    """Set the split of every labelled row; wanted and realised counts."""
    labelled = [(row, ring) for row, ring in written if row["complete"] == "yes"]
    places = [
        Place(row["scene"], row["row0"], row["col0"], row["size"], ring) for row, ring in labelled
    ]
    found = split_tiles(places, weights, seed)
    for (row, _), split in zip(labelled, found):
        row["split"] = split
    wanted = scaled_counts(len(labelled), weights)
    realised = {name: found.count(name) for name in (*wanted, NONE)}
    if any(realised[name] != count for name, count in wanted.items()):
        problem = (
            f"{city}: splits of {in_counts(realised)} tiles instead of {in_counts(wanted)}, since "
            "tiles that share ground must not be in two splits"
        )
        if strict:
            raise InputError(problem, remedy="a tiles.stride of tiles.size, or strict: false")
        log.warning("%s", problem)
    return {"wanted": wanted, "realised": realised}


def _gates(
    city: str,
    rows: Sequence[dict[str, Any]],
    scenes: Mapping[str, SceneChecks],
    limits: Limits,
    strict: bool,
) -> dict[str, Any]:
    """Figures, missed gates and doubts of scenes, flagged tiles; sets the doubt of every tile.

    Logs each miss and doubt, or ends a strict run.
    """
    found, problems, in_doubt = {}, [], {}
    for scene, checks in scenes.items():
        figures = checks.figures()
        misses = missed(figures, limits)
        found[scene] = figures | {"quality": flag(misses)}
        in_doubt[scene] = doubts(checks.matches.biases, limits.min_agreement)
        problems += [f"scene {scene}: {miss}" for miss in misses]
        problems += [f"scene {scene}: {doubt}" for doubt in in_doubt[scene] if not doubt.explained]
    labelled = [row for row in rows if row["complete"] == "yes"]
    for row in labelled:
        row["doubt"] = "; ".join(map(str, in_doubt[row["scene"]]))
        figures = {name: float(row[name]) for name in CHECK_COLUMNS if row[name] != ""}
        problems += [
            f"tile {row['tile']} of scene {row['scene']}: {miss}"
            for miss in missed(figures, limits)
        ]
    if problems and strict:
        more = f"; and {len(problems) - 5} more" if len(problems) > 5 else ""
        raise InputError(
            f"{city}: beyond the limits of quality: {'; '.join(problems[:5])}{more}",
            remedy="better control points, images or LiDAR for what is named, another limit "
            "(null: none) in quality of the configuration, or strict: false to have it flagged",
        )
    remarks = [
        f"scene {scene}: {doubt}"
        for scene, of in in_doubt.items()
        for doubt in of
        if doubt.explained
    ]
    for problem in problems + remarks:
        log.warning("%s: %s", city, problem)
    return {
        "limits": asdict(limits),
        "scenes": found,
        "surfaces": {s: surface_figures(of.matches.biases) for s, of in scenes.items()},
        "doubts": {s: [d.to_dict() for d in of] for s, of in in_doubt.items() if of},
        "flagged_tiles": {r["tile"]: r["quality"] for r in labelled if r["quality"] != "ok"},
    }
