"""What its images say about a labelled tile: SIFT matches, warping, class, limits."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import Limits
from ..core.numerics.statistics import ErrorSum
from ..epipolar.warping import CorrelationSum
from .label_doubts import SceneMatches, agreement
from .label_surfaces import LabelSurface
from .quality_limits import flag, missed
from .sift_matches import FIGURES, TileMatches

SIGMA_ENDS_PX = np.geomspace(1e-3, 10.0, 257)  # of the bins in which uncertainties are counted


def count_sigma(sigma: NDArray[np.float64], surface: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Labels int64[LabelSurface, bin] by what they lie on and by their uncertainty ``sigma``.

    Arrays of labels; px, 0 where it is not known: such labels are not counted.
    """
    last = SIGMA_ENDS_PX.size - 2
    place = np.clip(np.searchsorted(SIGMA_ENDS_PX, sigma, "right") - 1, 0, last)
    counts = np.zeros((len(LabelSurface), last + 1), np.int64)
    np.add.at(counts, (surface[sigma > 0], place[sigma > 0]), 1)
    return counts


def sigma_figures(counts: NDArray[np.int64]) -> dict[str, int | float | None]:
    """Labels, and the median and 95 % quantile of their uncertainty in px, of counts [bin]."""
    total = int(counts.sum())
    if not total:
        return {"labels": 0, "uncertainty_median_px": None, "uncertainty_p95_px": None}
    share = np.concatenate([[0.0], np.cumsum(counts) / total])
    median, most = np.interp((0.5, 0.95), share, SIGMA_ENDS_PX)
    return {
        "labels": total,
        "uncertainty_median_px": round(float(median), 4),
        "uncertainty_p95_px": round(float(most), 4),
    }


def sigma_by_surface(counts: NDArray[np.int64]) -> dict[str, dict[str, int | float | None]]:
    """The same of all labels and by what they lie on, where there are any."""
    by = {"all": counts.sum(axis=0)} | {kind.name.lower(): counts[kind] for kind in LabelSurface}
    return {name: sigma_figures(of) for name, of in by.items() if of.any()}


@dataclass(frozen=True, eq=False)
class TileChecks:
    """What its images say about a labelled tile: class, SIFT matches, sums of image warping.

    ``surface``, ``sigma`` of each match: what its label lies on (:class:`.LabelSurface`), and the
    uncertainty (px) that it states; ``stated``: of all labels, see :func:`count_sigma`.
    """

    kind: str
    matches: TileMatches
    warping: CorrelationSum
    surface: NDArray[np.uint8]
    sigma: NDArray[np.float64]
    stated: NDArray[np.int64]

    def figures(self) -> dict[str, float | int | None]:
        """By names of the manifest."""
        return (
            self.matches.figures()
            | {"warp_correlation": _finite(self.warping.coefficient)}
            | _pooled(self.stated)
        )

    def to_dict(self) -> dict[str, Any]:
        """JSON-ready, to the last bit."""
        matches = {f.name: getattr(self.matches, f.name).tolist() for f in fields(self.matches)}
        return {
            "kind": self.kind,
            "matches": matches,
            "warping": asdict(self.warping),
            "surface": self.surface.tolist(),
            "sigma": self.sigma.tolist(),
            "stated": self.stated.tolist(),
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
            np.array(values["stated"], np.int64),
        )


@dataclass
class SceneChecks:
    """The same of all labelled tiles of a scene."""

    gcp_rms: float | None = None
    errors: ErrorSum = field(default_factory=ErrorSum)
    parallax: ErrorSum = field(default_factory=ErrorSum)
    warping: CorrelationSum = field(default_factory=CorrelationSum)
    matches: SceneMatches = field(default_factory=SceneMatches)
    stated: NDArray[np.int64] = field(
        default_factory=lambda: np.zeros((len(LabelSurface), SIGMA_ENDS_PX.size - 1), np.int64)
    )

    def add(self, checks: TileChecks, row0: int, col0: int) -> None:
        """Add those of the tile whose upper-left pixel lies there in the scene's grid."""
        self.matches.add(checks.matches, checks.surface, checks.sigma, row0, col0)
        self.errors.add(checks.matches.row_errors)
        self.parallax.add(checks.matches.agreeing_parallax)
        self.warping.merge(checks.warping)
        self.stated += checks.stated

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
            **_pooled(self.stated),
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _pooled(stated: NDArray[np.int64]) -> dict[str, Any]:
    figures = sigma_figures(stated.sum(axis=0))
    return {name: figures[name] for name in SIGMA_COLUMNS}


SIGMA_COLUMNS = ("uncertainty_median_px", "uncertainty_p95_px")
CHECK_COLUMNS = (*FIGURES, "warp_correlation", *SIGMA_COLUMNS)


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
