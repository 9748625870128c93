"""What a method is, and on which machine it ran, as far as that can be known."""

from __future__ import annotations

import os
import platform
import re
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import Distribution, distribution, packages_distributions
from pathlib import Path
from typing import Any

import psutil

from ...errors import InputError
from ...products.provenance import file_sha256
from ..kinds import names_of, place_of

GIB = 1 << 30
INSTALLED = {"sgm": "cv2", "pandora": "pandora"}  # packages that kinds are made of


def identity(
    settings: Mapping[str, Any], files: Sequence[str | Path] = (), code: str = ""
) -> dict[str, Any]:
    """Licence, version and checksums of a method, from its configuration entry.

    ``licence`` and ``version``: as the entry states them, else those of the installed distribution
    that holds SGM, Pandora or the user's function, else None. ``files``: SHA-256 of the method's
    files by name (weights, the user's code). ``code``: digest of this package's code that runs it.
    """
    found = _distribution(settings)
    licence = settings.get("licence") or (found and _licence(found))
    version = settings.get("version") or (found and f"{found.name} {found.version}")
    return {
        "licence": licence or None,
        "version": version or None,
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


def _distribution(settings: Mapping[str, Any]) -> Distribution | None:
    """The installed one that SGM, Pandora or the user's function comes from."""
    if settings["kind"] in INSTALLED:
        top = INSTALLED[settings["kind"]]
    elif settings["kind"] == "function":
        try:
            place, _ = place_of(settings["function"])
        except InputError:
            return None
        top = "" if place.endswith(".py") else place.partition(".")[0]
    else:
        return None
    names = packages_distributions().get(top)
    return distribution(names[0]) if names else None


def _licence(found: Distribution) -> str | None:
    about = found.metadata
    for key in ("License-Expression", "License"):
        # some put the whole text there
        if (text := (about.get(key) or "").strip()) and "\n" not in text:
            return text
    named = [c for c in about.get_all("Classifier") or () if c.startswith("License ::")]
    return named[0].rpartition(" :: ")[2] if named else None
