"""What a city's tiles are, in figures and in a few lines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..core.errors import in_number
from ..core.status import HIDDEN, Status, carries_label
from .sift_matches import SIFT_NOISE_PX


def in_counts(counts: Mapping[str, int]) -> str:
    """Counts in words: 3 train, 1 val."""
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def summarise(
    city: str,
    rows: Sequence[Mapping[str, Any]],
    splits: Mapping[str, Any],
    phases: Mapping[str, tuple[int, int]],
    outcomes: Mapping[str, Mapping[str, int]],
    parameters: Mapping[str, Any],
    half: bool,
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
        "disparity_px": {
            "min": min(float(row["disparity_min_px"]) for row in labelled),
            "max": max(float(row["disparity_max_px"]) for row in labelled),
        },
        "disparity_rounding": {
            "largest_px": largest,
            "meaning": (
                "16-bit float: at most 1/128 px off below 32 px, 1/64 below 64, 1/32 below 128, "
                "1/16 from 128 px on"
                if half
                else "32-bit float, rounded to 1/1024 px: at most 1/2048 px off"
            ),
        },
    }


ALONE = (*HIDDEN, Status.OUT_OF_FRAME.label)  # pixels that one image has alone


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
