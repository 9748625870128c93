"""Splines of epipolar models, fitted once for all tests that need the same one."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterator
from typing import Any

import pytest

from stereotruth.epipolar import fit
from stereotruth.epipolar.fit import grow

GROWN: dict[str, Any] = {}


def grow_once(*arguments: Any) -> Any:
    """As :func:`.fit.grow`, which is most of what a model takes."""
    key = hashlib.sha256(pickle.dumps(arguments)).hexdigest()
    if key not in GROWN:
        GROWN[key] = grow(*arguments)
    return GROWN[key]


@pytest.fixture(scope="session", autouse=True)
def models_grow_once() -> Iterator[None]:
    """In all tests but those that take ``anew``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fit, "grow", grow_once)
        yield


@pytest.fixture
def anew(monkeypatch) -> None:
    """A fit that has been made is made again."""
    monkeypatch.setattr(fit, "grow", grow)
