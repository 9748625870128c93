"""Ends with an error unless envs/requirements.lock holds what pyproject.toml asks for, hashed."""

from __future__ import annotations

import re
import sys
import tomllib
from itertools import chain
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

NOT_LOCKED = {"mccnn", "networks"}  # which build of PyTorch fits depends on the machine
ROOT = Path(__file__).parents[1]


def locked_versions(text: str) -> dict[str, list[Requirement]]:
    """Pinned requirements of a lock file by canonical name (several where markers differ)."""
    pins: dict[str, list[Requirement]] = {}
    for entry in re.sub(r"\\\n", " ", text).splitlines():
        if entry.strip() and not entry.startswith("#"):
            pin = Requirement(entry.split(" --hash")[0].strip())
            pins.setdefault(canonicalize_name(pin.name), []).append(pin)
    return pins


def disagreements(pyproject: str, lock: str) -> list[str]:
    """What the lock file lacks or holds in a version that pyproject.toml does not admit."""
    project = tomllib.loads(pyproject)["project"]
    extras = project["optional-dependencies"]
    locked = (extras[name] for name in extras if name not in NOT_LOCKED)
    asked = [*project["dependencies"], *chain(*locked)]
    pins = locked_versions(lock)
    wrong = []
    for text in asked:
        asked_for = Requirement(text)
        found = pins.get(canonicalize_name(asked_for.name), [])
        if not found:
            wrong.append(f"{asked_for.name} is not in the lock file")
        for pin in found:
            version = str(pin.specifier).removeprefix("==")
            if version not in asked_for.specifier:
                wrong.append(f"{pin} does not satisfy {asked_for}")
    here = default_environment()
    for name, found in pins.items():
        if sum(pin.marker is None or pin.marker.evaluate(here) for pin in found) > 1:
            wrong.append(f"{name} is pinned twice for this machine")
    entries = [e for e in re.sub(r"\\\n", " ", lock).splitlines() if "==" in e]
    wrong += [f"{e.split()[0]} has no hash" for e in entries if "--hash=sha256:" not in e]
    if re.search(r"https?://|--(extra-)?index", lock):
        wrong.append("the lock file names an address")
    return wrong


if __name__ == "__main__":
    problems = disagreements(
        (ROOT / "pyproject.toml").read_text(), (ROOT / "envs/requirements.lock").read_text()
    )
    if problems:
        sys.exit("\n".join([*problems, "run: make lock"]))
    print("envs/requirements.lock agrees with pyproject.toml")
