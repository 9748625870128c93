"""What a method is, and on which machine it ran, as far as that can be known."""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib.metadata import Distribution, distribution, packages_distributions
from pathlib import Path
from typing import Any

import psutil

from stereotruth.core.errors import InputError
from stereotruth.core.products.provenance import file_sha256

from ..methods.kinds import MCCNN, names_of, place_of

GIB = 1 << 30
INSTALLED = {"sgm": ["cv2"], "pandora": ["pandora"]}  # packages that kinds are made of,
OF_PIPELINE = {MCCNN: ["mc_cnn"]}  # and pipelines of Pandora
LICENCES = {"pandora": "Apache License 2.0"}  # of distributions whose files do not state it


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
    names = packages_distributions()
    return [distribution(names[top][0]) for top in tops if top in names]


def _licence(found: Distribution) -> str | None:
    about = found.metadata
    stated = [about.get(key) or "" for key in ("License-Expression", "License")]
    named = [
        c.rpartition(" :: ")[2] for c in about.get_all("Classifier") or () if "License ::" in c
    ]
    names = [text.strip() for text in stated if "\n" not in text.strip()]
    titles = [_title(text) for text in stated]  # some put the whole text there
    return next(filter(None, [*names, *named, *titles]), LICENCES.get(found.name))


def _title(text: str) -> str:
    """Name of a licence, where its text begins with that."""
    first, second, *_ = [*(line.strip() for line in text.splitlines() if line.strip()), "", ""]
    if "license" not in first.casefold():
        return ""
    version = re.match(r"Version ([\d.]+)", second)
    return f"{first} {version[1]}" if version else first
