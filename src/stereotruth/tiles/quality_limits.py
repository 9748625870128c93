"""Quality gates: limits on what images, labels and control points say about a tile or a scene.

The figures need no truth: residuals of the control points, SIFT matches and image warping (section
IV of the paper). A tile or scene beyond a limit is flagged, not dropped.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..core.config.configuration import Limits

FIGURES = {  # the figure that a limit is for; of signed figures, the size counts
    "max_gcp_rms_px": "gcp_rms_px",
    "max_y_parallax_px": "y_parallax_median_px",
    "max_sift_error_px": "sift_median_error_px",
    "max_sift_mean_absolute_error_px": "sift_mean_absolute_error_px",
    "min_sift_matches": "sift_matches",
    "min_warp_correlation": "warp_correlation",
    "min_agreement": "agreement",
}
OF_ERRORS = ("max_sift_error_px", "max_sift_mean_absolute_error_px")


class Miss(NamedTuple):
    """A gate that was missed: its name in the configuration, the value found, the limit."""

    gate: str
    value: float
    limit: float

    def __str__(self) -> str:
        word = "below" if self.gate.startswith("min_") else "above"
        return f"{FIGURES[self.gate]} {self.value:.3g} is {word} {self.gate} {self.limit:g}"


def missed(figures: Mapping[str, float | int | None], limits: Limits) -> list[Miss]:
    """Gates that the figures miss, in the order of the limits.

    A figure that is absent, None or NaN misses nothing. With fewer matches than
    ``min_sift_matches``, that gate alone speaks for their errors: a few say nothing.
    """
    found = []
    count = figures.get("sift_matches")
    few = limits.min_sift_matches is not None and (count or 0) < limits.min_sift_matches
    for gate, name in FIGURES.items():
        limit, value = getattr(limits, gate), figures.get(name)
        if limit is None or value is None or math.isnan(value) or (few and gate in OF_ERRORS):
            continue
        low = gate.startswith("min_")
        if value < limit if low else abs(value) > limit:
            found.append(Miss(gate, value, limit))
    return found


def flag(misses: Sequence[Miss]) -> str:
    """Cell of the manifest: ``ok``, or the names of the missed gates with ``;`` between."""
    return ";".join(miss.gate for miss in misses) or "ok"
