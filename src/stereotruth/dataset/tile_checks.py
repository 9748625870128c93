"""What its images say about a labelled tile: SIFT matches, warping, class, limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config.labels import Limits
from ..epipolar.warping import CorrelationSum
from ..numerics.error_sums import ErrorSum
from .label_doubts import SceneMatches, agreement
from .quality_limits import flag, missed
from .sift_matches import FIGURES, TileMatches


@dataclass(frozen=True, eq=False)
class TileChecks:
    """What its images say about a labelled tile: class, SIFT matches, sums of image warping.

    ``surface``, ``sigma`` of each match: what its label lies on (:class:`.LabelSurface`), and the
    uncertainty (px) that it states.
    """

    kind: str
    matches: TileMatches
    warping: CorrelationSum
    surface: NDArray[np.uint8]
    sigma: NDArray[np.float64]

    def figures(self) -> dict[str, float | int | None]:
        """By names of the manifest."""
        return self.matches.figures() | {"warp_correlation": _finite(self.warping.coefficient)}

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, to the last bit."""
        matches = {f.name: getattr(self.matches, f.name).tolist() for f in fields(self.matches)}
        return {
            "kind": self.kind,
            "matches": matches,
            "warping": asdict(self.warping),
            "surface": self.surface.tolist(),
            "sigma": self.sigma.tolist(),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> TileChecks:
        """The inverse of :meth:`to_dict`."""
        types = {"surface_class": np.uint8}
        matches = {
            name: np.array(column, dtype=types.get(name, np.float64))
            for name, column in values["matches"].items()
        }
        return cls(
            values["kind"],
            TileMatches(**matches),
            CorrelationSum(**values["warping"]),
            np.array(values["surface"], np.uint8),
            np.array(values["sigma"], np.float64),
        )


@dataclass
class SceneChecks:
    """The same of all labelled tiles of a scene."""

    gcp_rms: float | None = None
    errors: ErrorSum = field(default_factory=ErrorSum)
    parallax: ErrorSum = field(default_factory=ErrorSum)
    warping: CorrelationSum = field(default_factory=CorrelationSum)
    matches: SceneMatches = field(default_factory=SceneMatches)

    def add(self, checks: TileChecks, row0: int, col0: int) -> None:
        """Add those of the tile whose upper-left pixel lies there in the scene's grid."""
        self.matches.add(checks.matches, checks.surface, checks.sigma, row0, col0)
        self.errors.add(checks.matches.row_errors)
        self.parallax.add(checks.matches.agreeing_parallax)
        self.warping.merge(checks.warping)

    def figures(self) -> dict[str, float | int | None]:
        """By names of the manifest, over all matches and all labelled pixels of the tiles."""
        errors, parallax = self.errors.figures(), self.parallax.figures()
        return {
            "gcp_rms_px": self.gcp_rms,
            "sift_matches": errors["count"],
            "sift_mean_error_px": errors["bias"],
            "sift_mean_absolute_error_px": errors["mean_absolute"],
            "sift_median_error_px": errors["median"],
            "y_parallax_median_px": parallax["median"],
            "y_parallax_rms_px": parallax["rms"],
            "warp_correlation": _finite(self.warping.coefficient),
            "agreement": agreement(self.matches.biases),
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


CHECK_COLUMNS = (*FIGURES, "warp_correlation")


def check_cells(checks: TileChecks | None, limits: Limits) -> dict[str, Any]:
    """Cells of the manifest; empty for pairs without complete labels."""
    if checks is None:
        return dict.fromkeys(("class", *CHECK_COLUMNS, "quality", "doubt"), "")
    figures = checks.figures()
    cells = {
        name: "" if (v := figures[name]) is None else v if isinstance(v, int) else f"{v:.4f}"
        for name in CHECK_COLUMNS
    }
    return {"class": checks.kind, **cells, "quality": flag(missed(figures, limits)), "doubt": ""}
