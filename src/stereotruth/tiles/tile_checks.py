"""What images say about labelled tiles, and what the tiles of a city are, in figures and lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.config.configuration import Limits
from ..core.errors import in_number
from ..core.numerics.statistics import ErrorSum
from ..core.products.rasters import read_tile
from ..core.status import HIDDEN, Status, carries_label
from ..epipolar import warping
from ..epipolar.warping import CorrelationSum
from .label_doubts import SceneMatches, agreement, flag, missed
from .label_surfaces import LabelSurface
from .manifest import tells_of_change
from .sift_matches import FIGURES, SIFT_NOISE_PX, TileMatches

ALONE = (*HIDDEN, Status.OUT_OF_FRAME.label)  # pixels that one image has alone
MISFIT_SHARE = 0.05  # of the pixels that do not fit their images: more is told
SIGMA_COLUMNS = ("uncertainty_median_px", "uncertainty_p95_px")
CHECK_COLUMNS = (*FIGURES, "warp_correlation", *SIGMA_COLUMNS)
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


def sigma_by_surface(counts: NDArray[np.int64]) -> dict[str, dict[str, Any]]:
    """The same of all labels and by what they lie on, where there are any."""
    by = {"all": counts.sum(axis=0)} | {kind.name.lower(): counts[kind] for kind in LabelSurface}
    return {name: sigma_figures(of) for name, of in by.items() if of.any()}


@dataclass(frozen=True, eq=False)
class TileChecks:
    """What its images say about a labelled tile: class, SIFT matches, sums of image warping.

    ``surface``, ``sigma`` of each match: what its label lies on
    (:class:`.label_surfaces.LabelSurface`), and the uncertainty (px) that it states; ``stated``: of
    all labels, see :func:`count_sigma`.
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


@dataclass(frozen=True, eq=False)
class WarpedTile:
    """An exported tile: left, warped right (NaN unlabelled) and disparity, float64[h, w]."""

    name: str
    left: NDArray[np.float64]
    warped: NDArray[np.float64]
    disparity: NDArray[np.float64]

    @property
    def sums(self) -> CorrelationSum:
        """Of left and warped right image over the labelled pixels."""
        return warping.agreement(self.left, self.warped)

    @property
    def correlation(self) -> float:
        """Coefficient of left and warped right image over the labelled pixels."""
        return self.sums.coefficient


def warp_tile(tiles: str | Path, row: Mapping[str, str]) -> WarpedTile:
    """Warp an exported tile by its own disparity; ``row`` is its line of the manifest."""
    folder = Path(tiles)
    left, right, disparity = (read_tile(folder / row[kind]) for kind in ("left", "right", "disp"))
    x = np.arange(left.shape[1])[None, :] - disparity
    warped = warping.warp_rows(np.nan_to_num(right), x)
    return WarpedTile(row["tile"], np.nan_to_num(left), warped, disparity)


# ------------------------------------------------------------------ of a city


def in_counts(counts: Mapping[str, int]) -> str:
    """Counts in words: 3 train, 1 val."""
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def reach_of(rows: Iterable[Mapping[str, Any]]) -> dict[str, float | None]:
    """Least and greatest disparity of rows of a manifest; None if none of them has labels."""
    labelled = [row for row in rows if row["disparity_min_px"] != ""]
    low = [float(row["disparity_min_px"]) for row in labelled]
    high = [float(row["disparity_max_px"]) for row in labelled]
    return {"min": min(low, default=None), "max": max(high, default=None)}


def flagged(labelled: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """The gates that tiles miss, of rows of a manifest that have labels."""
    return {row["tile"]: row["quality"] for row in labelled if row["quality"] != "ok"}


def summarise(
    city: str,
    rows: Sequence[Mapping[str, Any]],
    splits: Mapping[str, Any],
    phases: Mapping[str, tuple[int, int]],
    outcomes: Mapping[str, Mapping[str, int]],
    parameters: Mapping[str, Any],
) -> dict[str, Any]:
    """JSON-ready figures of a city's tiles."""
    labelled = [row for row in rows if row["complete"] == "yes"]
    pixels = len(labelled) * int(parameters["size"]) ** 2
    status = {
        name.removeprefix("count_"): sum(row[name] for row in labelled) / pixels
        for name in labelled[0]
        if name.startswith("count_")
    }
    largest = max(float(row["disparity_rounding_px"]) for row in labelled)
    return {
        "city": city,
        "labelled_pairs": len(labelled),
        "unlabelled_pairs": len(rows) - len(labelled),
        "size_px": parameters["size"],
        "splits": dict(splits),
        "scenes": {
            scene: {"grid_phase_row_col_px": list(phases[scene]), "windows": dict(outcome)}
            for scene, outcome in outcomes.items()
        },
        "share_of_pixels": {name: round(share, 6) for name, share in status.items()},
        "disparity_px": reach_of(labelled),
        "disparity_rounding": {
            "largest_px": largest,
            "meaning": (
                "16-bit float: at most 1/128 px off below 32 px, 1/64 below 64, 1/32 below 128, "
                "1/16 from 128 px on"
                if parameters["disparity_dtype"] == "float16"
                else "32-bit float, rounded to 1/1024 px: at most 1/2048 px off"
            ),
        },
    }


def summary_lines(summary: Mapping[str, Any], out_dir: str | Path) -> list[str]:
    """What was made and where to look, for the end of a run."""
    shares = summary["share_of_pixels"]
    labelled = sum(share for name, share in shares.items() if carries_label(name))
    hidden = sum(shares.get(name, 0.0) for name in ALONE)
    in_both = max(1.0 - hidden, 1e-9)
    low, high = summary["disparity_px"]["min"], summary["disparity_px"]["max"]
    lines = [
        f"{summary['city']}: {in_number(summary['labelled_pairs'], 'labelled pair')} of "
        f"{summary['size_px']} × {summary['size_px']} px "
        f"({in_counts(summary['splits']['realised'])}), "
        f"{in_number(summary['unlabelled_pairs'], 'pair')} without complete labels",
        f"{100 * labelled:.1f} % of their pixels labelled ({100 * labelled / in_both:.1f} % of "
        f"those that neither image hides), disparities {low:.1f} … {high:.1f} px, "
        f"rounded by at most {summary['disparity_rounding']['largest_px']:.4f} px",
        *label_uncertainty(summary),
        *(_quality_line(scene, found) for scene, found in summary["quality"]["scenes"].items()),
    ]
    flagged = summary["quality"]["flagged_tiles"]
    if flagged:
        some = ", ".join(f"{tile} ({gates})" for tile, gates in list(flagged.items())[:5])
        more = f" and {len(flagged) - 5} more" if len(flagged) > 5 else ""
        lines.append(f"Beyond the limits of quality: {some}{more}")
    elif not summary["quality"]["doubts"]:
        lines.append("All labelled pairs are within the limits of quality")
    lines += [
        f"{'Remark on' if doubt['explained_by_alignment'] else 'Doubt about'} {scene}: "
        f"{doubt['text']}"
        for scene, found in summary["quality"]["doubts"].items()
        for doubt in found
    ]
    return [*lines, f"Look at {out_dir}/manifest.csv, {out_dir}/left, right, disp, status"]


def misfit_lines(rows: Iterable[Mapping[str, str]]) -> list[str]:
    """That pixels do not fit the images, of rows of a manifest whose ground cannot have changed."""
    labelled = [row for row in rows if row["complete"] == "yes"]
    column = f"count_{Status.CHANGED.label}"
    misfits = sum(int(row.get(column) or 0) for row in labelled if not tells_of_change(row))
    share = misfits / max(sum(int(row["size"]) ** 2 for row in labelled), 1)
    if share < MISFIT_SHARE:
        return []
    return [
        f"{100 * share:.1f} % of the pixels do not fit the images or are water (status "
        f"{Status.CHANGED.label}), and no date or sun tells of a change: look at the points, their "
        "date and the alignment"
    ]


def label_uncertainty(summary: Mapping[str, Any]) -> list[str]:
    """How well labels are known by what they state, and by what they lie on; nothing of none."""
    by = dict(summary["label_uncertainty"])
    if "all" not in by:
        return []
    total = by.pop("all")
    surfaces = ", ".join(
        f"{name.replace('_', ' ')} {of['uncertainty_median_px']:.2g} px" for name, of in by.items()
    )
    return [
        f"Labels known to {total['uncertainty_median_px']:.2g} px (median), "
        f"{total['uncertainty_p95_px']:.2g} px for 95 % ({surfaces})"
    ]


def _quality_line(scene: str, found: Mapping[str, Any]) -> str:
    def px(name: str, sign: str = "") -> str:
        return "–" if found[name] is None else f"{found[name]:{sign}.2f} px"

    warp = found["warp_correlation"]
    return (
        f"{scene}: {found['sift_matches']} SIFT matches, error {px('sift_mean_error_px', '+')} "
        f"mean, {px('sift_mean_absolute_error_px')} mean absolute, of which about "
        f"{SIFT_NOISE_PX:g} px are SIFT's own; y-parallax "
        f"{px('y_parallax_median_px', '+')} median; correlation with the warped right image "
        f"{'–' if warp is None else f'{warp:.3f}'}"
        + ("" if found["quality"] == "ok" else f"; beyond the limits: {found['quality']}")
    )
