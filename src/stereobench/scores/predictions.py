"""A method over the pairs of a dataset: a folder of disparity maps, with the time of each.

``<pair>.tiff`` is float32, NaN where the method gives no disparity; ``uncertainty/<pair>.tiff`` is
its standard uncertainty in px, of methods that state one. ``predictions.json`` says what the method
is (:func:`identity`), how they were made, the seconds of each pair (the first pair that a process
works on is matched twice, and only the second time counts), and the memory of the process at its
peak. Programs of their own (kind ``command``) measure themselves, with their start, and nothing is
matched twice. ``machine`` is the one of the last call.

Pairs stay in a work folder (hard links) with a record of what they were made of, images and
method, so that a later call carries on where one was killed, and takes over what it would make the
same: labels may change without any pair being matched again.
"""

from __future__ import annotations

import json
import os
import platform
import re
import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from importlib.metadata import Distribution, distribution, packages_distributions
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from stereotruth.core.errors import InputError, without_secrets
from stereotruth.core.job import progress
from stereotruth.core.products.files import atomic_folder, link
from stereotruth.core.products.making import marks, refuse_replaced
from stereotruth.core.products.provenance import digest, file_sha256
from stereotruth.core.products.rasters import image_shape, read_image, write_disparity
from stereotruth.core.products.resumable_grids import Ledger
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from ..methods.kinds import FOLDER, MCCNN, MOVED, TOLD, names_of, place_of
from ..methods.matcher import BatchMatcher, ImagePair, Matched, Matcher, UncertainMatcher
from ..methods.methods import make_method
from ..methods.user_methods import SUFFIXES, read_result
from .prediction_files import RECORD, SUBMITTED, UNCERTAINTY, Submission

MB = 1 << 20

Took = dict[str, float | None]  # of a pair: seconds (None: not run here), peak memory_mb

# What a method is.
GIB = 1 << 30
INSTALLED = {"sgm": ["cv2"], "pandora": ["pandora"]}  # packages that kinds are made of,
OF_PIPELINE = {MCCNN: ["mc_cnn"]}  # and pipelines of Pandora
LICENCES = {"pandora": "Apache License 2.0"}  # of distributions whose files do not state it


def predict(
    dataset: StereoDataset,
    split: str | None,
    name: str,
    settings: Mapping[str, Any],
    out: str | Path,
    *,
    work: str | Path,
    files: Sequence[str | Path] = (),
    workers: int = 1,
    code: str = "",
    most: int | None = None,
) -> dict[str, Any]:
    """Match the pairs of a split (None: all), or take a folder's results; returns the record.

    ``most``: so many pairs, the first ones (None: all).

    ``settings``: the method's entry of the configuration; ``files``: what else the method is made
    of (weights, the user's code). ``work``: where finished pairs stay.

    Raises InputError if a pair, the method or one of its results cannot be used, or is written
    while it is used.
    """
    pairs = dataset.pairs(split)[:most]
    work = Path(work)
    files = [file for file in files if Path(file).is_file()]
    before = marks(files)
    made_of = {
        "method": {key: value for key, value in settings.items() if key not in TOLD},
        "files": [file_sha256(file) for file in files],
        "range": list(dataset.disparity_range),
        "code": code,
    }
    if settings["kind"] == FOLDER:
        made_of["nodata"] = dataset.nodata
        maker: _Results | _Runs = _Results(name, settings, dataset.nodata)
    else:
        maker = _Runs(name, settings, dataset.disparity_range, workers)
    ledger = Ledger(work / "done")
    found, keys, seen, missing = {}, {}, {}, []
    for pair in pairs:
        sources = maker.sources(pair)
        seen[pair.name] = marks(sources)
        keys[pair.name] = digest(made_of | {"images": [file_sha256(source) for source in sources]})
        piece = ledger.find(pair.name, keys[pair.name], _maps(work, pair))
        if piece is None:
            missing.append(pair)
        else:
            found[pair.name] = piece.result
    made = progress(maker(missing), len(missing), f"{name}: pairs matched")
    for pair, result in zip(missing, made, strict=True):
        places = _maps(work, pair)
        _check(result, pair, name)
        write_disparity(places["disparity"], result.disparity)
        if result.uncertainty is not None:
            write_disparity(places[UNCERTAINTY], result.uncertainty)
        refuse_replaced(before | seen[pair.name])
        took = {
            "seconds": result.seconds and round(result.seconds, 6),
            "memory_mb": result.memory_mb,
        }
        ledger.put(pair.name, keys[pair.name], places, took)
        found[pair.name] = took
    submitted = maker.submission
    record = {
        "dataset": dataset.name,
        "split": split,
        "method": name,
        "settings": {
            key: without_secrets(value) if isinstance(value, str) else value
            for key, value in settings.items()
        },
        "identity": identity(settings, files, code),
        "machine": machine(),
        "disparity_range": list(dataset.disparity_range),
        "device": maker.device,
        "threads": workers,
        **_summary(found),
        **({SUBMITTED: submitted.scores} if submitted and submitted.scores else {}),
        "pairs": {pair.name: found[pair.name] for pair in pairs},
    }
    text = json.dumps(record, indent=2) + "\n"
    with atomic_folder(out) as scratch:
        for pair in pairs:
            for source, target in zip(*(_maps(top, pair).values() for top in (work, scratch))):
                if source.exists():
                    link(source, target)
        (scratch / RECORD).write_text(text, encoding="utf-8")
    ledger.keep_only(set(found))
    for file in work.rglob("*.tiff"):
        if file.stem not in found:
            file.unlink()
    return record


class _Runs:
    """Makes the disparity of pairs by a method; the method is made when the first is asked for."""

    submission = None

    def __init__(
        self, name: str, settings: Mapping[str, Any], range_px: tuple[int, int], workers: int
    ) -> None:
        self._range = range_px
        self._matcher: Matcher = make_method(name, settings, workers)
        self.device = str(getattr(self._matcher, "device", f"CPU, {platform.machine()}"))

    def sources(self, pair: Pair) -> list[Path]:
        """The files that the disparity of a pair follows from."""
        return [pair.left, pair.right]

    def __call__(self, pairs: Sequence[Pair]) -> Iterator[Matched]:
        """Disparities of pairs, and what they took."""
        images = (ImagePair(pair.name, *_images(pair)) for pair in pairs)
        if isinstance(self._matcher, BatchMatcher):
            yield from self._matcher.many(images, self._range)
            return
        for number, (_, left, right) in enumerate(images):
            for _ in range(1 if number else 2):
                start = time.perf_counter()
                disparity, uncertainty = self._matched(left, right)
                seconds = time.perf_counter() - start
            yield Matched(disparity, seconds, round(peak_memory_mb(), 1), uncertainty)

    def _matched(
        self, left: NDArray[Any], right: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        if isinstance(self._matcher, UncertainMatcher):
            return self._matcher.with_uncertainty(left, right, self._range)
        return self._matcher(left, right, self._range), None


def _images(pair: Pair) -> tuple[NDArray[Any], NDArray[Any]]:
    pair.refuse_changed()
    left, right = read_image(pair.left), read_image(pair.right)
    if left.shape != right.shape or left.dtype != right.dtype:
        raise InputError(
            f"left image is {left.shape} {left.dtype}, right one {right.shape} {right.dtype}",
            file=pair.right,
            remedy="give images of one size and type",
        )
    return left, right


class _Results:
    """Takes the disparity of pairs from a folder."""

    device = ""

    def __init__(self, name: str, settings: Mapping[str, Any], nodata: float) -> None:
        if moved := [key for key in MOVED if key in settings]:
            raise InputError(
                f"method {name!r}: {' and '.join(moved)} cannot change a folder of results",
                remedy="take it away: results are x_left − x_right as they are",
            )
        folder = Path(settings["folder"])
        self._name, self._folder, self._nodata = name, folder, nodata
        if not folder.is_dir():
            raise InputError(
                f"method {name!r}: no such folder", file=folder, remedy="name a folder of results"
            )
        self.submission = Submission.of(folder)

    def _file(self, name: str) -> Path | None:
        candidates = (self._folder / f"{name}{end}" for end in SUFFIXES)
        return next(filter(Path.is_file, candidates), None)

    def sources(self, pair: Pair) -> list[Path]:
        """The file with the result of a pair, and that of its uncertainty if there is one."""
        file = self._file(pair.name)
        if file is None:
            raise InputError(
                f"method {self._name!r}: no result for pair {pair.name} ({' or '.join(SUFFIXES)})",
                file=self._folder,
                remedy=f"put {pair.name}.tif there",
            )
        uncertainty = self._file(f"{pair.name}_{UNCERTAINTY}")
        files = [file] if uncertainty is None else [file, uncertainty]
        if self.submission:
            self.submission.check(files)
        return files

    def __call__(self, pairs: Sequence[Pair]) -> Iterator[Matched]:
        """Disparities of pairs."""
        for pair in pairs:
            disparity, *uncertainty = (
                read_result(file, self._nodata) for file in self.sources(pair)
            )
            yield Matched(disparity, None, None, *uncertainty)


def _maps(folder: Path, pair: Pair) -> dict[str, Path]:
    """The files of a pair in a folder of predictions."""
    file = f"{pair.name}.tiff"
    return {"disparity": folder / file, UNCERTAINTY: folder / UNCERTAINTY / file}


def _check(result: Matched, pair: Pair, name: str) -> None:
    shape, uncertainty = image_shape(pair.left), result.uncertainty
    for what, values in (("disparity", result.disparity), (UNCERTAINTY, uncertainty)):
        if values is not None and values.shape != shape:
            raise InputError(
                f"method {name!r}: {what} of pair {pair.name} is {values.shape}, its image {shape}",
                file=pair.left,
                remedy=f"give the {what} of each pixel of the left image",
            )
    if uncertainty is not None and np.any(uncertainty < 0):
        raise InputError(
            f"method {name!r}: the uncertainty of pair {pair.name} is below 0 in places",
            file=pair.left,
            remedy="give standard uncertainties in px, NaN where there is none",
        )


def _summary(found: Mapping[str, Took]) -> dict[str, float | None]:
    """Median time of a pair, with what the middle 95 % of the pairs took; largest memory."""
    seconds = [of["seconds"] for of in found.values() if of["seconds"] is not None]
    memory = [of["memory_mb"] for of in found.values() if of["memory_mb"] is not None]
    return {
        "median_seconds": round(median(seconds), 6) if seconds else None,
        "median_seconds_low": round(float(np.quantile(seconds, 0.025)), 6) if seconds else None,
        "median_seconds_high": round(float(np.quantile(seconds, 0.975)), 6) if seconds else None,
        "peak_memory_mb": max(memory, default=None),
    }


def peak_memory_mb() -> float:
    """Most memory that this process ever held, in MB (2^20 bytes).

    Linux's ``ru_maxrss`` begins with that of the process that started this one, ``VmHWM`` does not.
    """
    status = Path("/proc/self/status")
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+) kB", status.read_text())):
        return int(found[1]) / 1024
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / MB


# ---------------------------------------------------------------------------- what a method is


def identity(
    settings: Mapping[str, Any], files: Sequence[str | Path] = (), code: str = ""
) -> dict[str, Any]:
    """Licence, version and checksums of a method, from its configuration entry.

    ``licence`` and ``version``: as the entry states them, else those of the installed distributions
    that hold SGM, Pandora, MC-CNN or the user's function, else None. ``files``: SHA-256 of the
    method's files by name (weights, the user's code). ``code``: digest of this package's code that
    runs it.
    """
    found = _distributions(settings)
    licences = dict.fromkeys(filter(None, map(_licence, found)))
    versions = (f"{one.name} {one.version}" for one in found)
    return {
        "licence": settings.get("licence") or ", ".join(licences) or None,
        "version": settings.get("version") or ", ".join(versions) or None,
        "files": {name: file_sha256(path) for name, path in names_of([*map(Path, files)]).items()},
        "code": code or None,
    }


def machine() -> dict[str, Any]:
    """System, processor, cores that may be used, memory in GiB, GPU and Python of this machine."""
    torch = sys.modules.get("torch")  # if nothing has imported it, no GPU is used
    gpu = torch.cuda.get_device_name() if torch and torch.cuda.is_available() else None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "system": f"{platform.system()} {platform.release()}",
        "processor": _processor(),
        "cores": cores,
        "memory_gib": round(psutil.virtual_memory().total / GIB, 1),
        "gpu": gpu,
        "python": platform.python_version(),
    }


def _processor() -> str:
    about = Path("/proc/cpuinfo")
    text = about.read_text(encoding="utf-8", errors="replace") if about.exists() else ""
    named = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return named[1].strip() if named else platform.processor() or platform.machine()


def _distributions(settings: Mapping[str, Any]) -> list[Distribution]:
    """The installed ones that SGM, Pandora and its pipeline, or the user's function come from."""
    tops: list[str] = []
    if settings["kind"] in INSTALLED:
        tops = INSTALLED[settings["kind"]] + OF_PIPELINE.get(settings.get("pipeline") or "", [])
    elif settings["kind"] == "function":
        with suppress(InputError):
            place, _ = place_of(settings["function"])
            tops = [] if place.endswith(".py") else [place.partition(".")[0]]
    names = packages_distributions() if tops else {}  # reads what all packages say of themselves
    return [distribution(names[top][0]) for top in tops if top in names]


def _licence(found: Distribution) -> str | None:
    """Its name, where the distribution states it in a line or by a classifier."""
    about = found.metadata
    stated = [(about.get(key) or "").strip() for key in ("License-Expression", "License")]
    classes = [c for c in about.get_all("Classifier") or () if "License ::" in c]
    named = [text for text in stated if text and "\n" not in text]
    named += [text.rpartition(" :: ")[2] for text in classes]
    return next(iter(named), LICENCES.get(found.name))
