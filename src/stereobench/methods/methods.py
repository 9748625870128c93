"""From a configuration entry (``benchmark.methods.<name>``) to a stereo method.

A method is a :class:`Matcher`; :mod:`kinds` lists the kinds of entries, and names the module that
makes the methods of each.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from stereotruth.core.errors import InputError, install_extra
from stereotruth.core.products.provenance import PACKAGES

from .kinds import MOVED, TOLD, kind_of
from .matcher import Matcher
from .polarity import with_polarity


def make_method(name: str, settings: Mapping[str, Any], workers: int = 1) -> Matcher:
    """The method of a configuration entry; ``workers`` are the threads that it may use.

    ``label`` (how tables call the method), ``fine_tuned_of`` (the method whose training was
    carried on), ``licence``, ``version`` and ``trained_on`` are no settings; ``polarity`` and
    ``outside`` are those of any kind (:mod:`polarity`).

    Raises InputError for an unknown kind, a function that cannot be found, and settings that the
    method does not take or lacks.
    """
    kind = kind_of(name, settings)
    options = {k: v for k, v in settings.items() if k not in ("kind", *TOLD, *MOVED)}
    moved = {key: settings[key] for key in MOVED if key in settings}
    if kind.module is None:
        raise InputError(f"method {name!r} is a folder of results", remedy="take one that can run")
    try:  # by its name, so that code digests of one method do not hold the others' code
        module = importlib.import_module(kind.module)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in PACKAGES:
            raise
        raise InputError(
            f"{settings['kind']} needs {error.name}, which is not installed",
            remedy=install_extra(kind.extra) if kind.extra else "install it",
        ) from error
    made = module.make(name, settings["kind"], options, workers)
    return with_polarity(name, made, **moved)
