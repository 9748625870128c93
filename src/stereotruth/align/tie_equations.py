"""The equations of a pair's tie points as a file, for the adjustment of all images of a site."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from ..core.products.files import atomic_file, read_record, sealed
from .equations import Equations, PairEquations, PlanObservation

MEANING = (
    "observed [along, across the epipolar rows; px] = design [2, 12] @ parameters + error, one row "
    "per tie point; parameters: (a_u, a_v, a_1, b_u, b_v, b_1) of the left image, then of the "
    "right, of the correction of the RPC's (col, row) by (a_u u + a_v v + a_1, b_u u + b_v v + "
    "b_1), px, (u, v) being px from the image's middle in halves of its longer side; own: px, "
    "standard deviation of the match by itself; site: tie points of one part of the scene; at: "
    "(col, row) px in the left image, there: in the right one; in_plan: of the left and the right "
    "image, by edges of roofs: observed [col, row; px] = design [2, 6] @ parameters of the image + "
    "error of this covariance [px^2], and px_per_m @ (east, north; m) of an error that all share"
)


def write_equations(path: str | Path, ties: PairEquations | None, reason: str) -> None:
    """Write the equations as JSON; without any, the ``reason`` why there are none."""
    values: dict[str, Any] = {"what": "equations of tie points of a pair", "meaning": MEANING}
    values["reason"] = reason if ties is None else ""
    if ties is not None:
        values |= {
            "places": ties.places,
            "common_px": ties.common_px,
            "start": ties.start.tolist(),
            "linearised_at": ties.linearised_at.tolist(),
            **{name: array.tolist() for name, array in vars(ties.equations).items()},
            "in_plan": [
                {name: array.tolist() for name, array in vars(seen).items()}
                for seen in ties.in_plan
            ],
        }
    with atomic_file(path) as scratch:
        scratch.write_text(re.sub(r"\n {2,}", " ", sealed(values)), encoding="utf-8")


def read_equations(path: str | Path) -> tuple[PairEquations | None, str]:
    """What :func:`write_equations` was given. Raises InputError if the file is damaged."""
    return read_record(path, _from_dict, what="equations of tie points", stage="refine")


def _from_dict(values: dict[str, Any]) -> tuple[PairEquations | None, str]:
    if "design" not in values:
        return None, values["reason"]
    names = ("design", "observed", "own", "site", "at", "there")
    equations = Equations(*(np.array(values[name]) for name in names))
    about = (np.array(values[name]) for name in ("start", "linearised_at"))
    in_plan = tuple(
        PlanObservation(**{name: np.array(rows) for name, rows in seen.items()})
        for seen in values["in_plan"]
    )
    return PairEquations(equations, *about, values["places"], values["common_px"], in_plan), ""
