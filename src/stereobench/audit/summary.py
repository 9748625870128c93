"""What an audit found, pooled over the pairs: figures, statements, table."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereotruth.core.config.methods import AuditLimits
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from .conventions import AS_STATED
from .pair import estimate
from .sharing import Shared
from .verdicts import CHECKS, FAULT, GOOD, NOTE, UNDECIDED, Verdict

NONE = "none"
CONFIDENCE = 0.05  # of all limits that are stated
RESAMPLES = 2000
FEW = 8  # pairs: fewer give no limits of their mean
POOLED = {  # figure: where it stands, as an estimate or a number
    "parallax_px": ("rows", "parallax"),
    "parallax_tilt_x_px": ("rows", "tilt_x"),
    "parallax_tilt_y_px": ("rows", "tilt_y"),
    "label_bias_px": ("bias", "bias"),
    "label_bias_tilt_x_px": ("bias", "tilt_x"),
    "label_bias_tilt_y_px": ("bias", "tilt_y"),
    "contradicted_share": ("contradicted", "share"),
}
PLAIN = {
    "parallax_spread_px": ("rows", "spread"),
    "off_row_share": ("rows", "off_row"),
    "label_spread_px": ("bias", "spread"),
    "gross_share": ("bias", "gross"),
    "poor_correlation_share": ("contradicted", "poor"),
    "hidden_share": ("hidden", "share"),
    "labelled_share": ("labels", "labelled"),
    "label_min_px": ("labels", "low"),
    "label_max_px": ("labels", "high"),
    "outside_share": ("labels", "outside"),
}


@dataclass(frozen=True)
class Audited:
    """A pair, what was measured of it, and the verdict."""

    pair: Pair
    figures: Mapping[str, Any]
    verdict: Verdict

    def severity(self, limits: AuditLimits) -> float:
        """By how much the pair is off, in tolerances; faults of files count most."""
        found = 100.0 * sum(f.check in ("files", "convention") for f in self.verdict.of(FAULT))
        found += 10.0 * len({f.check for f in self.verdict.of(FAULT)})
        for where, tolerance in (
            (("rows", "parallax"), limits.parallax_px),
            (("bias", "bias"), limits.label_bias_px),
            (("contradicted", "share"), limits.contradicted_share),
        ):
            value = estimate(self.figures, *where).value
            found += min(abs(value) / tolerance, 50.0) if np.isfinite(value) else 0.0
        return found


def bootstrap(values: Sequence[float]) -> dict[str, Any]:
    """Mean, median, extremes of values of pairs; 95 % limits of the mean by the bootstrap."""
    known = np.array([v for v in values if v is not None and np.isfinite(v)])
    if not known.size:
        return {"pairs": 0}
    rng = np.random.default_rng(0)
    means = rng.choice(known, (RESAMPLES, known.size)).mean(axis=1)
    low, high = np.percentile(means, (100 * CONFIDENCE / 2, 100 - 100 * CONFIDENCE / 2))
    return {
        "pairs": int(known.size),
        "mean": float(known.mean()),
        "low": float(low) if known.size >= FEW else None,
        "high": float(high) if known.size >= FEW else None,
        "median": float(np.median(known)),
        "least": float(known.min()),
        "most": float(known.max()),
    }


def _plain(figures: Mapping[str, Any], where: Sequence[str]) -> float | None:
    at: Any = figures
    for name in where:
        at = (at or {}).get(name)
    return at


def pooled(audited: Sequence[Audited]) -> dict[str, Any]:
    """Every figure over the pairs that have it."""
    found = {
        name: bootstrap([estimate(a.figures, *where).value for a in audited])
        for name, where in POOLED.items()
    }
    found |= {
        name: bootstrap([_plain(a.figures, where) for a in audited])
        for name, where in PLAIN.items()
    }
    return {name: figures for name, figures in found.items() if figures["pairs"]}


def summarise(
    dataset: StereoDataset,
    audited: Sequence[Audited],
    shared: Sequence[Shared],
    limits: AuditLimits,
) -> dict[str, Any]:
    """What is known of the dataset, JSON-ready."""
    by_city = defaultdict(list)
    for a in audited:
        by_city[a.pair.city].append(a)
    checks = {
        check: {
            level: sum(any(f.check == check for f in a.verdict.of(level)) for a in audited)
            for level in (FAULT, UNDECIDED)
        }
        for check in CHECKS
    }
    summary = {
        "dataset": dataset.name,
        "layout": dataset.layout,
        "disparity_range": list(dataset.disparity_range),
        "nodata": None if np.isnan(dataset.nodata) else dataset.nodata,
        "pairs": len(audited),
        "labelled_pairs": sum("labels" in a.figures for a in audited),
        "splits": dict(Counter(a.pair.split for a in audited)),
        "verdicts": {
            w: sum(a.verdict.word == w for a in audited) for w in (GOOD, UNDECIDED, FAULT)
        },
        "checks": checks,
        "conventions": _conventions(audited),
        "pooled": pooled(audited),
        "by_city": {city: pooled(of) for city, of in sorted(by_city.items())},
        "shared": [
            {
                "first": audited[s.first].pair.name,
                "first_split": audited[s.first].pair.split,
                "second": audited[s.second].pair.name,
                "second_split": audited[s.second].pair.split,
                "matches": s.matches,
                "share": round(s.share, 4),
            }
            for s in shared
        ],
        "limits": limits.model_dump(include=set(AuditLimits.model_fields)),
    }
    return summary | {"statements": statements(summary)}


def _conventions(audited: Sequence[Audited]) -> dict[str, Any]:
    labelled = [a.figures for a in audited if "labels" in a.figures]

    def count(*where: str) -> dict[str, int]:
        values = (_plain(figures, where) for figures in labelled)
        return dict(Counter(NONE if value is None else str(value) for value in values))

    return {
        "image_shapes": dict(Counter(" × ".join(map(str, a.figures["shape"])) for a in audited)),
        "image_types": dict(Counter(a.figures["dtype"][0] for a in audited)),
        "label_types": count("labels", "dtype"),
        "nodata_tags": count("labels", "nodata_tag"),
        "label_steps_px": count("labels", "step"),
        "labels_mean": count("convention", "taken"),
        "in_front": count("hidden", "nearer"),
    }


def _figure(figures: Mapping[str, Any], share: bool) -> str:
    def show(value: float) -> str:
        return (f"{100 * value:.1f} %" if share else f"{value:+.2f} px").replace("-", "−")

    text = f"{show(figures['mean'])} in the mean"
    if figures["low"] is not None:
        text += f" ({show(figures['low'])} to {show(figures['high'])})"
    return f"{text}, pairs from {show(figures['least'])} to {show(figures['most'])}"


def _pairs(count: int) -> str:
    return f"{count} pair" if count == 1 else f"{count} pairs"


def statements(summary: Mapping[str, Any]) -> list[str]:
    """The summary in sentences, most important first; limits in brackets are of 95 %."""
    verdicts, of, limits = summary["verdicts"], summary["pooled"], summary["limits"]
    found = [
        f"{_pairs(summary['pairs'])}, {summary['labelled_pairs']} with labels: "
        f"{verdicts[GOOD]} good, {verdicts[FAULT]} failed, "
        f"{verdicts[UNDECIDED]} with too few matches."
    ]
    for check, counts in summary["checks"].items():
        if counts[FAULT]:
            found.append(f"{_pairs(counts[FAULT])} without {CHECKS[check]}.")
    for name, what in (
        ("parallax_px", "Vertical parallax"),
        ("label_bias_px", "Label - match of the images"),
        ("contradicted_share", "Labels that the images contradict"),
        ("hidden_share", "Labels on pixels hidden in the right view"),
    ):
        if name in of:
            found.append(f"{what}: {_figure(of[name], name.endswith('share'))}.")
    meaning = summary["conventions"]
    for step, count in meaning["label_steps_px"].items():
        if step != NONE:
            found.append(f"Labels are multiples of {float(step):g} px in {_pairs(count)}.")
    for kind, count in meaning["labels_mean"].items():
        if kind not in (AS_STATED, NONE):
            found.append(f"Labels agree with the images as '{kind}' in {_pairs(count)}.")
    outside = of.get("outside_share")
    if outside and outside["most"] > 0:
        low, high = summary["disparity_range"]
        found.append(
            f"Labels outside the range [{low}, {high}) as it is stated: {_figure(outside, True)}."
        )
    if summary["shared"]:
        across = sum(s["first_split"] != s["second_split"] for s in summary["shared"])
        found.append(
            f"Two pairs share ground {len(summary['shared'])} times, {across} in two splits."
        )
    found.append(
        f"The rate at which a check calls any pair of a faultless dataset faulty is "
        f"{100 * limits['false_alarms']:g} % or less."
    )
    return found


def in_words(summary: Mapping[str, Any]) -> str:
    """The README of the audit."""
    lines = [f"Audit of the stereo dataset {summary['dataset']}", ""]
    lines += [f"- {line}" for line in summary["statements"]]
    lines += ["", "What the files are like"]
    for name, counts in summary["conventions"].items():
        text = ", ".join(f"{value} ({n} pairs)" for value, n in counts.items())
        lines.append(f"- {name.replace('_', ' ')}: {text or 'none'}")
    lines += ["", "Tolerances"]
    lines += [f"- {name}: {value:g}" for name, value in summary["limits"].items()]
    lines += [
        "",
        "pairs.csv has a row per pair, index.html the pictures. Disparity is x_left - x_right in",
        "px; parallax is y_right - y_left; bias is label - match. Limits are of 95 %.",
    ]
    return "\n".join(lines) + "\n"


def table_rows(audited: Sequence[Audited]) -> list[dict[str, str]]:
    """Rows of ``pairs.csv``."""
    rows = []
    for a in audited:
        row = {
            "pair": a.pair.name,
            "city": a.pair.city,
            "split": a.pair.split,
            "verdict": a.verdict.word,
            "faults": "; ".join(f.text for f in a.verdict.of(FAULT)),
            "undecided": "; ".join(f.text for f in a.verdict.of(UNDECIDED)),
            "notes": "; ".join(f.text for f in a.verdict.of(NOTE)),
            "matches": _text(a.figures.get("matches")),
        }
        for name, where in POOLED.items():
            value = estimate(a.figures, *where)
            low, high = value.interval(CONFIDENCE)
            row |= {
                name: _text(value.value),
                f"{name}_low": _text(low),
                f"{name}_high": _text(high),
            }
        row |= {name: _text(_plain(a.figures, where)) for name, where in PLAIN.items()}
        row["labels_mean"] = str(_plain(a.figures, ("convention", "taken")) or "")
        row["in_front"] = str(_plain(a.figures, ("hidden", "nearer")) or "")
        rows.append(row)
    return rows


def _text(value: float | None) -> str:
    if value is None or not np.isfinite(value):
        return ""
    return str(value) if isinstance(value, int) else f"{value:.4f}"
