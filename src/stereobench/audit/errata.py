"""Errata of a stereo dataset: corrections of its labels, made by an audit, without its data.

====================  =============================================================================
``errata.json``       of each corrected pair: the disparity file by name and SHA-256, the
                      correction, its standard uncertainty, and what the audit says before and after
``masks/<pair>.png``  uint8 of the size of the labels: 0 as it is, 1 hidden from the right view,
                      2 contradicted by the images, 3 a nodata value that nobody declared
====================  =============================================================================

A label d becomes ``gain * (d - pivot_px) + field_px``. The values of ``field_px`` [k, k] lie evenly
over the pixels, from the centre of the first to that of the last. Between, the field is the
polynomial of degree k - 1 in row and in column through them: a shift for k = 1, affine along rows
and columns for 2, a disparity field for more. ``sigma_px`` has their standard uncertainties,
``gain_sigma`` is that of the gain.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereotruth.core.config.configuration import Limits
from stereotruth.core.config.methods import AuditLimits
from stereotruth.core.errors import InputError, in_number
from stereotruth.core.job import progress
from stereotruth.core.numerics.arrays import Floats
from stereotruth.core.numerics.statistics import reweighted_fit, tukey_weights
from stereotruth.core.products.files import (
    atomic_folder,
    copy,
    files_below,
    is_foreign,
    path_below,
    read_record,
    read_sealed,
    refuse_others,
    sealed,
)
from stereotruth.core.products.provenance import file_sha256
from stereotruth.core.products.rasters import (
    KITTI_STEPS,
    read_disparity,
    read_image,
    read_labels,
    read_tile,
    write_tiff,
)
from stereotruth.tiles.layouts import catalogs_of, write_tables
from stereotruth.tiles.manifest import disparity_cells, read_manifest, refuse_changed
from stereotruth.tiles.quick_looks import feature, read_footprints
from stereotruth.tiles.seals import FILE as SEAL
from stereotruth.tiles.stereo_dataset import StereoDataset
from stereotruth.tiles.tile_checks import check_cells, flagged, reach_of
from stereotruth.tiles.tile_files import LabelsKnown, check_labels
from stereotruth.tiles.verify import write_export

from .estimates import SMALLEST_SCALE, cells, robust_fit, share
from .label_checks import LARGER, SMALLER, WRONG_PX
from .matches import grey, label_offsets
from .pair import (
    LEAST_REACH_PX,
    estimate,
    figure,
    matches_of,
    measure_arrays,
    scale_of_labels,
    wrong_labels,
)
from .verdicts import FAULT, WRONG, Audited, judge

log = logging.getLogger("stereotruth")

Labels = NDArray[np.float32]  # [h, w] px, NaN: none

ERRATA, EXPORT = "errata.json", "export.json"
MENDED = ("values", "convention", "bias", "hidden", "contradicted")  # checks
HIDDEN, CONTRADICTED, NODATA = 1, 2, 3  # in masks
MEANINGS = {HIDDEN: "hidden", CONTRADICTED: "contradicted", NODATA: "nodata"}
KNOTS = (1, 2, 5)  # of a shift, an affine function, a field
FITS = 3  # of a correction, each to the labels as the last one left them
FOLDS = 8
LARGEST_LOSS_PX = 1.0  # of a match that a correction misses
SURE = 3.0  # standard errors by which a correction with more unknowns must be better,
WORTH_PX = 0.02  # and change labels by in the mean
SUPPORT = 1.0  # sum of squared weights of the matches that a knot needs


def _weights(places: Floats, knots: int) -> Floats:
    """Lagrange's weights [n, knots] of knots 0, 1, … at places [n]."""
    found = np.ones((places.size, knots))
    for one in range(knots):
        for other in set(range(knots)) - {one}:
            found[:, one] *= (places - other) / (one - other)
    return found


class Correction(NamedTuple):
    """Of a pair's labels, see above."""

    gain: float = 1.0
    gain_sigma: float = 0.0
    pivot_px: float = 0.0
    field_px: Sequence[Sequence[float]] = ((0.0,),)
    sigma_px: Sequence[Sequence[float]] = ((0.0,),)

    def apply(self, labels: Labels) -> Labels:
        """The corrected labels."""
        knots = len(self.field_px)
        down, across = (_weights(np.linspace(0, knots - 1, n), knots) for n in labels.shape)
        field = down @ np.array(self.field_px) @ across.T
        return (self.gain * (labels.astype(np.float64) - self.pivot_px) + field).astype(np.float32)


def _designs(x: Floats, y: Floats, values: Floats, shape: tuple[int, int]) -> Iterator[Floats]:
    """Designs [n, p] of corrections, fewest unknowns first: knots, and perhaps the gain."""
    middle, reach = scale_of_labels(values)
    for knots in KNOTS:
        down, across = (_weights(v / (n - 1) * (knots - 1), knots) for v, n in zip((y, x), shape))
        design = (down[:, :, None] * across[:, None, :]).reshape(x.size, -1)
        if np.square(design).sum(axis=0).min() >= SUPPORT:
            yield design
            if reach >= LEAST_REACH_PX:
                yield np.column_stack([design, values - middle])


def fit_correction(
    x: Floats, y: Floats, labels: Floats, offsets: Floats, shape: tuple[int, int]
) -> Correction | None:
    """The correction with as few unknowns as explain ``offsets`` [n], px, of ``labels`` at pixels.

    More unknowns are taken only if they foretell the matches of cells that they are not fitted to.
    None: there are too few matches.
    """
    fitted = partial(reweighted_fit, weights_of=tukey_weights, least_sigma=SMALLEST_SCALE)
    groups = cells(x, y)
    names, group = np.unique(groups, return_inverse=True)
    middle = float(np.median(offsets))
    values = offsets - middle
    best = None
    for design in _designs(x, y, labels, shape):
        if names.size <= max(FOLDS, design.shape[1]):
            break
        missed, change = np.empty(values.size), design @ fitted(design, values)
        for out in (group % FOLDS == fold for fold in range(FOLDS)):
            missed[out] = values[out] - design[out] @ fitted(design[~out], values[~out])
        loss = np.minimum(np.abs(missed), LARGEST_LOSS_PX)
        if best is not None:
            gain = np.bincount(group, best[1] - loss, names.size)
            sure = gain.sum() > SURE * np.sqrt(names.size) * gain.std(ddof=1)
            if not sure or np.abs(change - best[2]).mean() < WORTH_PX:
                continue
        best = design, loss, change
    found = [] if best is None else robust_fit(best[0], values, groups)
    if not found or not np.isfinite([of.error for of in found]).all():
        return None
    knots = math.isqrt(len(found))
    value, error = (np.array([getattr(of, name) for of in found]) for name in ("value", "error"))
    field, sigma = (v[: knots * knots].reshape(knots, knots) for v in (value + middle, error))
    if len(found) == knots * knots:
        return Correction(field_px=field.tolist(), sigma_px=sigma.tolist())
    pivot, gain = scale_of_labels(labels)[0], (1.0 + float(value[-1]), float(error[-1]))
    return Correction(*gain, pivot, (field + pivot).tolist(), sigma.tolist())


@dataclass(eq=False)
class _Mending:
    """A faulty pair, of so many ``pairs``, on its way to right labels."""

    dataset: StereoDataset
    a: Audited
    limits: AuditLimits
    pairs: int

    def __post_init__(self) -> None:
        self.left, self.right = read_image(self.a.pair.left), read_image(self.a.pair.right)
        self.matches = matches_of(self.dataset, self.left, self.right)
        self.given = self.dataset.labels(self.a.pair)
        self.mask = np.zeros(self.given.shape, np.uint8)
        self.correction = Correction()
        strays = [value for value, _ in self.a.figures["labels"]["strays"]]
        self.mask[np.isin(self.given, np.array(strays, np.float32))] = NODATA
        self.figures = self.a.figures
        if strays:
            self.measure()
        else:
            self.judge()

    @property
    def labels(self) -> Labels:
        """As far as they are mended."""
        return self.correction.apply(np.where(self.mask > 0, np.float32(np.nan), self.given))

    def measure(self) -> None:
        """Measure and judge the labels as far as they are mended."""
        grows = self.dataset.grows_with_height
        found = measure_arrays(self.left, self.right, self.labels, self.matches, grows=grows)
        self.figures = {**self.a.figures, **found}
        self.judge()

    def judge(self) -> None:
        """Judge what was measured."""
        findings = judge(self.figures, self.limits, self.pairs)
        self.left_over = [f for f in findings if f.level == FAULT and f.check != "values"]
        self.faults = {finding.check for finding in self.left_over}

    def mend(self) -> bool:
        """Mend what can be mended; whether anything has been."""
        if "convention" in self.faults:
            self.correction = Correction(gain=-1.0)
            self.measure()
            if "convention" in self.faults:
                return False
        if "bias" in self.faults:
            self.fit()
            self.measure()
        self.mask_values()
        if self.faults & {"hidden", "contradicted"}:
            nearer = figure(self.figures, "hidden", "nearer")
            front = nearer or (LARGER if self.dataset.grows_with_height else SMALLER)
            found = wrong_labels(self.left, self.right, self.labels, self.matches, front)
            for check, value, wrong in zip(("hidden", "contradicted"), MEANINGS, found):
                if check in self.faults:
                    self.mask[wrong] = value
            self.measure()
        return bool(self.mask.any()) or self.correction != Correction()

    def fit(self) -> None:
        """Find the correction; its fit is to labels of the right sign."""
        sign, images = self.correction.gain, (grey(self.left), grey(self.right))
        for _ in range(FITS):
            labels = self.labels
            errors = label_offsets(*images, labels, self.matches)
            known = np.isfinite(errors)
            x, y = self.matches.x[known], self.matches.y[known]
            at = y.astype(int), x.astype(int)
            given = sign * self.given[at].astype(np.float64)
            offsets = labels[at] - errors[known] - given
            if found := fit_correction(x, y, given, offsets, labels.shape):
                pivot, gain = sign * found.pivot_px, sign * found.gain
                self.correction = found._replace(gain=gain, pivot_px=pivot)

    def mask_values(self) -> None:
        """Mask values that stand for nodata, as the corrected labels on them are wrong."""
        at = self.matches.y.astype(int), self.matches.x.astype(int)
        off = np.abs(self.labels[at] - self.matches.disparity) > WRONG_PX
        for value, _ in self.a.figures["labels"]["spikes"]:
            on = self.given[at] == np.float32(value)
            wrong = share(off[on].astype(float), cells(self.matches.x[on], self.matches.y[on]))
            if wrong.interval(self.limits.false_alarms / max(self.pairs, 1))[0] > WRONG:
                self.mask[self.given == np.float32(value)] = NODATA


def write_errata(
    folder: str | Path, dataset: StereoDataset, audited: Sequence[Audited], limits: AuditLimits
) -> dict[str, Any]:
    """Write the corrections of an audited dataset's faulty labels; returns what the file says."""
    tiles, others = [], {}
    faulty = [a for a in audited if {f.check for f in a.of(FAULT)} - {"shared"}]
    with atomic_folder(folder) as scratch:
        (scratch / "masks").mkdir()
        for a in progress(faulty, len(faulty), f"{dataset.name}: labels mended"):
            name, file = a.pair.name, a.pair.disparity
            job = None
            checks = {f.check for f in a.of(FAULT)}
            if checks & set(MENDED) and "files" not in checks and "bias" in a.figures:
                job = _Mending(dataset, a, limits, len(audited))
            if job is None or file is None or not job.mend():
                others[name] = [f.text for f in a.of(FAULT)]
                continue
            record: dict[str, Any] = {
                "pair": name,
                "disparity": file.relative_to(dataset.root).as_posix(),
                "disparity_sha256": file_sha256(file),
                "kind": {1: "shift", 2: "affine"}.get(len(job.correction.field_px), "field"),
                **job.correction._asdict(),
                "masked": {of: int((job.mask == k).sum()) for k, of in MEANINGS.items()},
                "why": [f.text for f in a.of(FAULT) if f.check in MENDED],
                "left": [f.text for f in job.left_over],
            }
            for when, of in (("before", a.figures), ("after", job.figures)):
                bias = estimate(of, "bias", "bias")
                record[f"label_bias_{when}_px"] = [round(bias.value, 4), round(bias.error, 4)]
            if job.mask.any():
                record["mask"] = f"masks/{name}.png"
                cv2.imwrite(str(scratch / record["mask"]), job.mask)
                record["mask_sha256"] = file_sha256(scratch / record["mask"])
            tiles.append(record)
        said = {
            "what": "corrections of disparity labels: gain * (label - pivot_px) + field_px",
            "dataset": dataset.name,
            "nodata": None if np.isnan(dataset.nodata) else dataset.nodata,
            "limits": limits.model_dump(include=set(AuditLimits.model_fields)),
            "tiles": tiles,
            "not_mended": others,
        }
        (scratch / ERRATA).write_text(sealed(said), encoding="utf-8")
    log.info("%s: errata of %s", folder, in_number(len(tiles), "pair"))
    return said


def read_errata(delta: str | Path) -> dict[str, Any]:
    """What the file of a folder of errata says. Raises InputError if it is not as it was made."""
    try:
        return read_record(Path(delta, ERRATA), dict, what="errata", stage="audit")
    except InputError as error:
        remedy = "get the folder again from who made it, or make it by audit --delta"
        raise InputError(error.problem, file=error.file, remedy=remedy) from None


def apply_errata(delta: str | Path, dataset: str | Path, out: str | Path) -> int:
    """Copy ``dataset`` to the new folder ``out`` with its labels corrected; how many files are.

    Files are found by name, wherever they lie. They are held against the checksums of the errata,
    and all that a manifest lists against those of the manifest, before anything is written. What
    the copy states of its labels (manifest, footprints, catalogs, ``export.json``) is of the
    corrected ones. The seal of labels that were held back stays behind.

    Raises InputError if a file is missing or another one, if the errata are not as they were
    written, or if there is something at ``out``.
    """
    delta, dataset, out = Path(delta), Path(dataset), Path(out)
    refuse_others(out, source=dataset)
    said = read_errata(delta)
    none = np.nan if said["nodata"] is None else said["nodata"]
    files, found = [file for file in files_below(dataset) if not is_foreign(file.name)], {}
    for record in said["tiles"]:
        name = Path(path_below(record["disparity"], "the file of a pair", delta / ERRATA)).name
        same = [file for file in files if file.name == name]
        file = next((f for f in same if file_sha256(f) == record["disparity_sha256"]), None)
        if file is None:
            raise InputError(
                "is not the file that the errata are of" if same else f"has no file {name}",
                file=[*same, dataset][0],
                remedy="get the version of the dataset that was audited, or audit this one",
            )
        found[file] = record
    if has_manifest := (dataset / "manifest.csv").is_file():
        refuse_changed(dataset)
        not_copied = (SEAL, EXPORT, "croissant.json", "stac") if found else ()
        files = [f for f in files if f.relative_to(dataset).parts[0] not in not_copied]
    with atomic_folder(out) as scratch:
        for file in progress(files, len(files), f"{out}: files"):
            target = scratch / file.relative_to(dataset)
            copy(file, target)
            if file in found:
                _write_corrected(file, target, found[file], delta, none)
        if has_manifest and found:
            _tell(scratch, dataset, {f.relative_to(dataset).as_posix() for f in found}, none)
    log.info("%s: labels of %s corrected", out, in_number(len(found), "pair"))
    return len(found)


def _tell(folder: Path, dataset: Path, corrected: Collection[str], nodata: float) -> None:
    """Write what the copy of a dataset states of its labels, as it was written of the dataset.

    Of a scene with corrected labels nothing is stated that its tiles alone do not tell.
    """
    rows, places = read_manifest(dataset), read_footprints(dataset)
    record = read_sealed(dataset / EXPORT) if (dataset / EXPORT).is_file() else {}
    quality = record.get("quality", {})
    limits = Limits(**quality.get("limits", {}))
    renewed = [row for row in rows if row.get("disp") in corrected]
    for row in renewed:
        cells = {"disp_sha256": file_sha256(folder / row["disp"])}
        cells |= _cells(folder, row, nodata, limits)
        row |= {name: cell for name, cell in cells.items() if name in row}
        if place := places.get(row.get("tile", "")):
            ring = np.array(place["geometry"]["coordinates"][0][:-1])
            place["properties"] |= feature(row, ring)["properties"]
    scenes = {row.get("scene") for row in renewed}
    for row in rows:
        if row.get("doubt") and row["scene"] in scenes:
            row["doubt"] = ""
    where = {row["tile"]: dataset / row["orientation"] for row in rows if row.get("orientation")}
    write_tables(folder, rows, places, where, **catalogs_of(dataset, rows))
    if record:
        labelled = [row for row in rows if row["complete"] == "yes"]
        for name in ("scenes", "surfaces", "doubts"):
            quality[name] = {key: of for key, of in quality[name].items() if key not in scenes}
        quality["flagged_tiles"] = flagged(labelled)
        record.pop("label_uncertainty", None)  # which a corrected copy has not
        write_export(folder, record | {"disparity_px": reach_of(labelled)}, record["provenance"])


def _cells(folder: Path, row: Mapping[str, str], nodata: float, limits: Limits) -> dict[str, Any]:
    """Cells of the manifest that tell of a pair's labels; their uncertainty is not known."""
    labels = read_disparity(folder / row["disp"], nodata)
    cells: dict[str, Any] = disparity_cells(labels)
    if "quality" in row:
        images = (np.nan_to_num(read_tile(folder / row[view])) for view in ("left", "right"))
        left, right = (np.rint(image).astype(np.uint16) for image in images)
        known = LabelsKnown(row["class"], *[np.zeros(labels.shape, np.uint8)] * 3)
        checks = check_labels(left, right, labels.astype(np.float64), known)
        cells |= check_cells(checks, limits)
    return cells


def _write_corrected(
    file: Path, target: Path, record: Mapping[str, Any], delta: Path, nodata: float
) -> None:
    """Write the labels of a file as its errata have them, with the nodata value of the file."""
    labels = read_disparity(file, nodata)
    corrected = Correction(*(record[name] for name in Correction._fields)).apply(labels)
    if "mask" in record:
        mask = delta / path_below(record["mask"], "a mask", delta / ERRATA)
        if not mask.is_file() or file_sha256(mask) != record["mask_sha256"]:
            raise InputError("not what was written", file=mask, remedy="get the errata again")
        corrected[read_image(mask) > 0] = np.nan
    known = np.isfinite(corrected)
    if file.suffix.lower() == ".png":  # of KITTI
        steps = np.rint(corrected.astype(np.float64) * KITTI_STEPS)
        stored = np.where(known & (steps >= 1) & (steps <= 65535), steps, 0).astype(np.uint16)
        cv2.imwrite(str(target), stored)
    else:
        tag = read_labels(file)[1]
        none = nodata if tag is None else tag
        write_tiff(target, np.where(known, corrected, np.float32(none)), nodata=tag)
