"""From a configuration entry (``benchmark.methods.<name>``) to a stereo method.

``sgm``                         OpenCV's semi-global matching (:mod:`.sgm`)
``stereonet, psmnet, hmsmnet``  the networks (:mod:`.networks`; needs PyTorch)
``function``                    the user's own, named by ``function``: ``package.module:name``
                                (modules of the working directory are found), ``path.py:name``, or
                                the entry point ``name`` of the group ``stereotruth.methods``
``folder``                      a folder of disparities made elsewhere: scored, never run
==============================  ====================================================================

The user's function takes ``(left, right, disparity_range)`` and the entry's ``options`` as keyword
arguments, and returns the disparity as :class:`Matcher` says. What has ``scaling`` and
``margin_px`` is taken for a Matcher as it is; of a class, the options make the object.
=======
A method is a :class:`Matcher`; :mod:`kinds` lists the kinds of entries, and names the module that
makes the methods of each.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

from ..errors import InputError
from .kinds import kind_of
from .matcher import Matcher

SHOWN = ("kind", "label", "fine_tuned_of")  # keys of an entry that are no settings


def make_method(name: str, settings: Mapping[str, Any], workers: int = 1) -> Matcher:
    """The method of a configuration entry; ``workers`` are the threads that it may use.

    ``label`` (how tables call the method) and ``fine_tuned_of`` (the method whose training was
    carried on) are no settings.

    Raises InputError for an unknown kind, a function that cannot be found, and settings that the
    method does not take.
    """
    kind, options = kind_of(name, settings), {k: v for k, v in settings.items() if k not in SHOWN}
    if kind.module is None:
        raise InputError(f"method {name!r} is a folder of results", remedy="take one that can run")
    try:  # by its name, so that code digests of one method do not hold the others' code
        module = importlib.import_module(f"stereotruth.{kind.module}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] == "stereotruth":
            raise
        raise InputError(
            f"{settings['kind']} needs {error.name}, which is not installed",
            remedy="pip install '.[networks]'",
        ) from error
    return module.make(name, settings["kind"], options, workers)
