"""Scores that others have published by a protocol's name, beside one's own.

Their protocols are less than those here: each row says where it stands and what is not known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stereotruth.core.errors import in_number

from ..methods.kinds import KINDS
from .published_scores import TABLE5
from .tables import Table, nothing, plain_table

Row = Mapping[str, Any]
PAPER = "Li et al., IEEE TGRS 2023, table 5"
LATER = "READMEs of later networks"
INVALID = "how pixels that SGM leaves invalid count, SGM's settings"
LITTLE = "pair list, range, mask, pooling; whether trained and scored by one program"
ORDER = f"{LITTLE}; the networks are taken to stand in the order of those of WHU-Stereo"


@dataclass(frozen=True)
class Published:
    """A published score: EPE in px, D1 (3 px) in percent, its source, and what that leaves open."""

    method: str
    epe_px: float
    d1_percent: float
    source: str
    not_known: str


def _paper(kind: str, epe: float, d1: float) -> Published:
    lacking = "pair list; whether labels beyond the range count"
    return Published(
        KINDS[kind].label, epe, d1, PAPER, f"{lacking}; {INVALID}" if kind == "sgm" else lacking
    )


PUBLISHED = {
    "whu-2023": (
        *(_paper(kind, epe, d1) for kind, (epe, d1, _) in TABLE5.items()),
        Published("TGRNet", 1.586, 12.63, LATER, LITTLE),
        Published("RAFT-Stereo", 1.729, 14.12, LATER, LITTLE),
        Published("HMSM-Net, again", 2.040, 19.00, LATER, f"{LITTLE}; why not the paper's 1.672"),
    ),
    "us3d-track2": (
        Published("TGRNet", 1.313, 7.17, LATER, ORDER),
        Published("RAFT-Stereo", 1.366, 7.72, LATER, ORDER),
        Published("HMSM-Net", 1.473, 9.17, LATER, ORDER),
    ),
}


def beside_published(methods: Sequence[Row]) -> Table:
    """One's own scores of all labelled pixels, holes filled, and the published ones below."""
    title = "Published: scores of others beside these"
    name = methods[0]["protocol"]["name"] if methods else ""
    if name not in PUBLISHED:
        text = f"Nothing is published by a protocol like this one; some is by {_and(PUBLISHED)}."
        return nothing("published", title, text)
    rows = [
        {
            "method": of["label"],
            "epe_px": of["all"]["filled_epe_px"],
            "d1_percent": round(100 * of["all"]["filled_d1_3_px_share"], 4)
            if of["all"]["labelled"]
            else None,
            "source": f"here, {in_number(of['tiles'], 'pair')}",
            "not_known": "",
        }
        for of in methods
    ] + [vars(of) for of in PUBLISHED[name]]
    lines = [
        [
            row["method"],
            "–" if row["epe_px"] is None else f"{row['epe_px']:.3f}",
            "–" if row["d1_percent"] is None else f"{row['d1_percent']:.2f}",
            row["source"],
            row["not_known"],
        ]
        for row in rows
    ]
    heading = ["Method", "EPE (px)", "D1, 3 px (%)", "Source", "Not known of its protocol"]
    caption = f"Only those scored here are known to be by protocol {methods[0]['protocol']['id']}."
    return Table("published", title, rows, [(caption, plain_table(heading, lines))])


def _and(names: Sequence[str]) -> str:
    return " and ".join(names)
