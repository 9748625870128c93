"""What others have published of methods, beside one's own scores; what methods were trained on.

The paper's results (section V) are on the real WHU-Stereo, by methods trained on it. EPE in px, D1
(3 px) in percent, milliseconds per pair of 1024 × 1024 px; keys are kinds of methods. Protocols of
others are less than those here: each row says where it stands and what is not known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from ..methods.kinds import KINDS, MCCNN

TABLE5 = {
    "sgm": (4.889, 50.79, 506),
    "stereonet": (2.453, 25.12, 238),
    "psmnet": (2.481, 24.81, 614),
    "hmsmnet": (1.672, 12.94, 511),
}


def _by_city(text: str) -> dict[str, dict[str, tuple[float, float]]]:
    """EPE and D1 by city and kind of method, of a table with a city in a line."""
    (_, *kinds), *lines = (line.split() for line in text.strip().splitlines())
    return {
        city: dict(zip(kinds, zip(map(float, values[::2]), map(float, values[1::2]))))
        for city, *values in lines
    }


TABLE6 = _by_city("""
city            sgm       stereonet      psmnet        hmsmnet
Shaoguan   7.862 63.19   2.660 24.58   2.514 21.45   2.091 16.94
Kunming    3.065 37.50   1.225  6.09   1.181  5.77   1.017  4.44
Yingde     5.497 47.22   1.821 14.69   1.993 15.09   1.436  9.86
Qichun     4.484 54.19   2.801 34.63   2.953 37.04   1.596 13.65
Wuhan      6.790 58.65   4.836 47.83   4.105 36.49   3.905 35.66
Hengyang   9.081 61.82   4.375 43.50   3.761 31.23   2.914 23.43
""")
TABLE7 = _by_city("""
city        stereonet      psmnet        hmsmnet
Shaoguan   2.467 23.26   2.366 20.61   1.928 15.67
Kunming    1.245  6.19   1.091  4.86   0.996  5.05
Yingde     1.758 13.52   1.481  9.96   1.351  8.72
Qichun     2.760 34.07   2.817 35.05   1.483 12.09
Wuhan      4.346 42.88   4.025 34.92   3.718 34.51
Hengyang   3.885 39.18   3.553 34.85   2.539 19.62
""")

PAPER = "Li et al., IEEE TGRS 2023, table 5"
LATER = "READMEs of later networks"
LACKING = "pair list; whether labels beyond the range count"
INVALID = "; how pixels that SGM leaves invalid count, SGM's settings"
LITTLE = "pair list, range, mask, pooling; whether trained and scored by one program"
ORDER = f"{LITTLE}; the networks are taken to stand in the order of those of WHU-Stereo"

# What methods learnt from.
NOTHING = "nothing"
NOT_STATED = "not stated"
US3D = "US3D"  # the Data Fusion Contest of 2019
TRAINING_COLUMNS = {
    "trained_on": "trained on",
    "licence": "licence",
    "seen_in_training": "dataset seen in training",
}


@dataclass(frozen=True)
class Published:
    """A published score: EPE in px, D1 (3 px) in percent, its source, and what that leaves open."""

    method: str
    epe_px: float
    d1_percent: float
    source: str
    not_known: str


PUBLISHED = {
    "whu-2023": (
        *(
            Published(KINDS[kind].label, epe, d1, PAPER, LACKING + INVALID * (kind == "sgm"))
            for kind, (epe, d1, _) in TABLE5.items()
        ),
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


# --------------------------------------------------------------------- what methods learnt from


def training_data(of: Mapping[str, Any]) -> dict[str, str]:
    """The columns of TRAINING_COLUMNS for the summary of a method, ``scores.json``.

    A method states ``trained_on`` in its entry, () if it learns nothing. Known without that:
    methods that learn nothing, MC-CNN, and networks that rule ``train`` trained, on the training
    pairs of a dataset.
    """
    dataset, settings = of["dataset"], of["settings"]
    stated = list(settings.get("trained_on") or ())
    own = _trained_here(settings)
    if own:
        stated.append(f"{own}, training pairs")
    elif not stated and settings["kind"] == "pandora" and settings.get("pipeline") == MCCNN:
        stated = [US3D]
    licence = settings.get("licence") or (of.get("identity") or {}).get("licence") or NOT_STATED
    if not stated and settings.get("trained_on") is not None:
        trained, seen = NOTHING, "no"
    elif not stated:
        learns = settings["kind"] not in ("sgm", "pandora") or settings.get("pipeline")
        trained = NOT_STATED if learns else NOTHING
        seen = NOT_STATED if learns else "no"
    else:
        trained = "; ".join(stated)
        names = {name.casefold() for name in stated}
        seen = "yes" if dataset.casefold() in names else "no"
        if seen == "no" and own == dataset:
            seen = "training pairs only"
    return {"trained_on": trained, "licence": licence, "seen_in_training": seen}


def _trained_here(settings: Mapping[str, Any]) -> str | None:
    """The dataset that rule ``train`` trained a network on; None: weights from elsewhere."""
    if not KINDS[settings["kind"]].is_network:
        return None
    parts = PurePath(settings.get("weights") or "").parts
    return parts[2] if parts[:2] == ("results", "train") and len(parts) > 3 else None
