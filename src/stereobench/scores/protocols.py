"""Frozen definitions of how scores are made, so that numbers with one id may be compared.

A protocol says which pairs count, which pixels of them, by which truth, how pixels without a
disparity count, above which errors a pixel is wrong, and how pixels are pooled. Its id is its name
and eight digits of a checksum of all that and of the pairs: their names, images and true
disparities. Whatever differs, a pair more or a label that was mended, gets another id. Scores made
without a protocol are of protocol ``own``, with an id made in the same way.

===========  ======================================================================================
whu-2023     Li et al., IEEE TGRS 2023, section V: range [−128, 64), test pairs, 3 px
us3d-track2  US3D (DFC2019, track 2) as HMSM-Net's authors match it: range [−96, 96), 3 px
exact-2026   synthetic cities against their exact truth: all pixels that both views see, labelled or
             not, unchanged and no water; hidden ones apart (stratum ``exact_hidden``); 3 and 1 px
===========  ======================================================================================

In all of them the pixels of all tiles are pooled, and what a method leaves invalid is filled along
the row from the lower of its two sides (:func:`.scores.fill_holes`) and counts.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.errors import InputError
from stereotruth.core.products.provenance import file_sha256
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

OWN = "own"
DIGITS = 8


@dataclass(frozen=True)
class Protocol:
    """How scores are made; ``disparity_range``: px, the second excluded; ``split``: None: all.

    ``truth``: the dataset's labels, or the exact truth of a synthetic city.
    """

    name: str
    disparity_range: tuple[int, int]
    split: str | None
    thresholds_px: tuple[float, ...]
    truth: Literal["labels", "exact"] = "labels"
    grows_with_height: bool = True
    mask: str = "pixels with a true disparity in the range"
    holes: str = "filled along the row from the lower side, and counted"
    pooling: str = "all pixels of all pairs"

    def identified(self, pairs: Iterable[tuple[str, str]]) -> dict[str, Any]:
        """The definition with its ``id`` and the checksum of the pairs.

        ``pairs``: name and :func:`pair_sha256` of each.
        """
        listed = "".join(f"{name} {sha256}\n" for name, sha256 in sorted(pairs))
        definition = {**asdict(self), "pairs_sha256": hashlib.sha256(listed.encode()).hexdigest()}
        text = json.dumps(definition, sort_keys=True)
        short = hashlib.sha256(text.encode()).hexdigest()[:DIGITS]
        return {"id": f"{self.name}-{short}", **definition}


PROTOCOLS = {
    of.name: of
    for of in (
        Protocol("whu-2023", (-128, 64), "test", (3.0,)),
        Protocol("us3d-track2", (-96, 96), "test", (3.0,)),
        Protocol("exact-2026", (-64, 128), "test", (3.0, 1.0), truth="exact"),
    )
}


def protocol_of(
    name: str | None, dataset: StereoDataset, split: str | None, thresholds_px: Sequence[float]
) -> Protocol:
    """The protocol of that name; None: the one that the settings make.

    Raises InputError if dataset or split are not as the protocol has them.
    """
    given = (dataset.disparity_range, split, dataset.grows_with_height)
    if name is None:
        low_high, split, grows = given
        return Protocol(OWN, low_high, split, tuple(map(float, thresholds_px)), "labels", grows)
    if name not in PROTOCOLS:
        raise InputError(f"no protocol {name!r}", remedy=f"take one of {', '.join(PROTOCOLS)}")
    found = PROTOCOLS[name]
    wanted = (found.disparity_range, found.split, found.grows_with_height)
    for what, has, should in zip(("disparity_range", "split", "grows_with_height"), given, wanted):
        if has != should:
            place = "benchmark" if what == "split" else f"benchmark.datasets.{dataset.name}"
            raise InputError(
                f"{place}.{what} is {_said(has)}, in protocol {name} it is {_said(should)}",
                remedy="change it, or take the protocol away",
            )
    return found


def pair_sha256(pair: Pair, truths: Iterable[NDArray[np.float32]]) -> str:
    """Checksum of a pair's images and true disparities (float32[h, w], NaN where there is none)."""
    found = hashlib.sha256(f"{file_sha256(pair.left)} {file_sha256(pair.right)}".encode())
    for truth in truths:
        known = np.where(np.isfinite(truth), truth, np.float32(np.nan))  # NaN of one kind
        found.update(known.astype("<f4").tobytes())
    return found.hexdigest()


def one_id(methods: Sequence[Mapping[str, Any]]) -> str:
    """The id that the summaries of all methods share.

    Raises InputError if they have several.
    """
    ids = {of["label"]: of["protocol"]["id"] for of in methods}
    if len(set(ids.values())) > 1:
        each = "; ".join(f"{label}: {found}" for label, found in ids.items())
        raise InputError(
            f"scores of several protocols cannot stand in one table ({each})",
            remedy="score all methods by one protocol, on the same pairs",
        )
    return next(iter(ids.values()), "")


def _said(value: Any) -> str:
    return f"[{value[0]}, {value[1]}]" if isinstance(value, tuple) else str(value)
