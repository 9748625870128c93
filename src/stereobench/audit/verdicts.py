"""From measurements to verdicts: what is wrong with a pair, and with a dataset, by stated limits.

A quantity is a fault only if its confidence interval lies beyond the tolerance, and all right only
if it lies within; else the pair is undecided in it. Intervals are as wide as it takes for the
chance that any pair of a faultless dataset is called faulty by a check to stay below
``false_alarms``: each check of each of n pairs has level ``false_alarms`` / n (Bonferroni), shared
by the numbers that it looks at.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereotruth.core.config.methods import AuditLimits
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from .label_checks import AS_STATED, MOVES
from .matches import Shared
from .pair import estimate, figure

Figures = Mapping[str, Any]  # of a pair, see measure

FAULT, UNDECIDED, NOTE = "fault", "undecided", "note"
GOOD = "good"
EXPLAINS = 0.05  # share of the matches that another meaning of the labels must explain more
GAIN = 0.15  # of the squared difference beside steps, by which a move must make it less
WRONG = 0.25  # share of wrong labels among those of one frequent value
NEGLIGIBLE = 1e-3  # share of labels outside the range
MIN_GREY_VALUES = 8  # of an image
CHECKS = {  # what is wrong with a pair that fails, in the order of the page
    "files": "files do not fit together, or are not those of the manifest",
    "rows": "rows do not correspond",
    "convention": "sign or sides are not as stated",
    "bias": "labels are offset",
    "registration": "labels lie beside the pixels that they belong to",
    "values": "values are not as stated",
    "contradicted": "the images contradict labels",
    "hidden": "labels lie on hidden pixels",
    "shared": "ground lies in two splits, or a pair twice in the dataset",
}
TO_EDGES = {
    "": "",
    "tilt_x": ", from the middle to the right edge",
    "tilt_y": ", from the middle to the lower edge",
}
TO_ENDS = {"scale": ", from the middle to the largest labels"}
OFFSETS = {  # check, what it is, and where it may differ
    "parallax": ("rows", "vertical parallax", TO_EDGES),
    "bias": ("bias", "label - match", TO_EDGES | TO_ENDS),
}

# A dataset.
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
    "label_scale_px": ("bias", "scale"),
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
class Finding:
    """Something about a pair: which check, whether a fault, undecided or a note, and in words."""

    check: str
    level: str
    text: str


@dataclass(frozen=True)
class Audited:
    """A pair, what was measured of it, and the findings."""

    pair: Pair
    figures: Figures
    findings: Sequence[Finding]

    @property
    def verdict(self) -> str:
        """Fault, undecided or good."""
        return next((level for level in (FAULT, UNDECIDED) if self.of(level)), GOOD)

    def of(self, level: str) -> list[Finding]:
        """The findings of a level."""
        return [finding for finding in self.findings if finding.level == level]

    def severity(self, limits: AuditLimits) -> float:
        """By how much the pair is off, in tolerances; faults of files count most."""
        faults = self.of(FAULT)
        found = 100.0 * sum(f.check in ("files", "convention") for f in faults)
        found += 10.0 * len({f.check for f in faults})
        for where, tolerance in (
            (("rows", "parallax"), limits.parallax_px),
            (("bias", "bias"), limits.label_bias_px),
            (("contradicted", "share"), limits.contradicted_share),
        ):
            value = estimate(self.figures, *where).value
            found += min(abs(value) / tolerance, 50.0) if np.isfinite(value) else 0.0
        return found


# -------------------------------------------------------------------------------------- a pair


def judge(figures: Figures, limits: AuditLimits, pairs: int) -> list[Finding]:
    """What is found of one of ``pairs`` pairs, from its figures."""
    level = limits.false_alarms / max(pairs, 1)
    found = _files(figures)
    if figures["same_shape"] and not figures["identical_images"]:
        found += _offset(figures, "parallax", limits.parallax_px, level, figures["matches"])
        if "labels" in figures:
            found += _labels(figures, limits, level)
    return found


def _files(figures: Figures) -> list[Finding]:
    found = []
    if not figures["same_shape"]:
        found.append(Finding("files", FAULT, "images and labels differ in size"))
    if figures["identical_images"]:
        found.append(Finding("files", FAULT, "left and right image are the same"))
    for side, count in figures["grey_values"].items():
        if count < MIN_GREY_VALUES:
            found.append(Finding("files", FAULT, f"the {side} image is empty"))
    if len(set(figures["dtype"])) > 1:
        found.append(Finding("files", NOTE, f"images of types {' and '.join(figures['dtype'])}"))
    return found


def _offset(
    figures: Figures, name: str, tolerance: float, level: float, matches: int
) -> list[Finding]:
    """Whether one of OFFSETS and its tilts, told by so many matches, are tolerated."""
    check, what, places = OFFSETS[name]
    faults, is_open = [], False
    for tilt, where in places.items():
        value = estimate(figures, check, tilt or name)
        says = value.beyond(tolerance, level / len(places))
        if says:
            low, high = value.interval(0.05)
            faults.append(f"{what}{where} {value.value:+.2f} px ({low:+.2f} … {high:+.2f})")
        is_open |= says is None
    if faults:
        return [Finding(check, FAULT, "; ".join(faults))]
    return [Finding(check, UNDECIDED, f"{what}: {matches} matches do not tell")] if is_open else []


def _labels(figures: Figures, limits: AuditLimits, level: float) -> list[Finding]:
    found = _values(figures, level)
    if not figures["labels"]["labelled"]:
        return [*found, Finding("values", FAULT, "no labels")]
    meaning = figures["convention"]
    more = estimate(figures, "convention", "more")
    if meaning["taken"] != AS_STATED and more.interval(level)[0] > 0 and more.value > EXPLAINS:
        text = f"labels agree with the images as: {meaning['best']}"
        text += f" ({100 * more.value:.0f} % of the matches more than as stated)"
        found.append(Finding("convention", FAULT, text))
    matches = figures["bias"]["matches"]
    found += _offset(figures, "bias", limits.label_bias_px, level, matches)
    gain = estimate(figures, "registration", "gain")
    if gain.interval(level / len(MOVES))[0] > GAIN:
        x, y = figures["registration"]["move"]
        text = f"beside steps, labels fit better when moved by ({x:+d}, {y:+d}) px (columns, rows)"
        found.append(Finding("registration", FAULT, text))
    share = estimate(figures, "contradicted", "share")
    says = share.beyond(limits.contradicted_share, level)
    if says:
        text = f"the images contradict {100 * share.value:.1f} % of the labels"
        found.append(Finding("contradicted", FAULT, text))
    elif says is None:
        text = f"share of contradicted labels: {figures['contradicted']['labels']} do not tell"
        found.append(Finding("contradicted", UNDECIDED, text))
    if (hidden := figures["hidden"]["share"]) > limits.hidden_share:
        text = f"{100 * hidden:.1f} % of the labels lie behind others, seen from the right"
        found.append(Finding("hidden", FAULT, text))
    return found


def _values(figures: Figures, level: float) -> list[Finding]:
    found = []
    labels = figures["labels"]
    for value, share in labels["strays"]:
        text = f"{100 * share:.1f} % of the pixels are {value:g}, outside the range: nodata?"
        found.append(Finding("values", FAULT, text))
    strays = sum(share for _, share in labels["strays"]) / max(labels["labelled"], 1e-9)
    if (outside := labels["outside"] - strays) > NEGLIGIBLE:
        text = f"{100 * outside:.1f} % of the labels are outside the range"
        found.append(Finding("values", NOTE, text))
    for (value, share), at in zip(labels["spikes"], figures.get("spikes", ())):
        if estimate({"at": at}, "at").interval(level)[0] > WRONG:
            text = (
                f"{100 * share:.1f} % of the pixels are {value:g}, and the images say no: nodata?"
            )
            found.append(Finding("values", FAULT, text))
    if labels["step"]:
        found.append(Finding("values", NOTE, f"labels are multiples of {labels['step']:g} px"))
    return found


# ----------------------------------------------------------------------------------- a dataset


def bootstrap(values: Sequence[float | None]) -> dict[str, Any]:
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


def pooled(audited: Sequence[Audited]) -> dict[str, Any]:
    """Every figure over the pairs that have it."""
    found = {
        name: bootstrap([estimate(a.figures, *where).value for a in audited])
        for name, where in POOLED.items()
    }
    found |= {
        name: bootstrap([figure(a.figures, *where) for a in audited])
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
            level: sum(any(f.check == check for f in a.of(level)) for a in audited)
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
            word: sum(a.verdict == word for a in audited) for word in (GOOD, UNDECIDED, FAULT)
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
        values = (figure(figures, *where) for figures in labelled)
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


def _in_words(figures: Figures, share: bool) -> str:
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
            found.append(f"{_pairs(counts[FAULT])}: {CHECKS[check]}.")
    for name, what in (
        ("parallax_px", "Vertical parallax"),
        ("label_bias_px", "Label - match of the images"),
        ("contradicted_share", "Labels that the images contradict"),
        ("hidden_share", "Labels on pixels hidden in the right view"),
    ):
        if name in of:
            found.append(f"{what}: {_in_words(of[name], name.endswith('share'))}.")
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
            f"Labels outside the range [{low}, {high}) as it is stated: {_in_words(outside, True)}."
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


def readme(summary: Mapping[str, Any]) -> str:
    """The summary as text."""
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
            "verdict": a.verdict,
            "faults": "; ".join(f.text for f in a.of(FAULT)),
            "undecided": "; ".join(f.text for f in a.of(UNDECIDED)),
            "notes": "; ".join(f.text for f in a.of(NOTE)),
            "matches": as_text(a.figures.get("matches")),
        }
        for name, where in POOLED.items():
            value = estimate(a.figures, *where)
            ends = zip((f"{name}_low", f"{name}_high"), value.interval(CONFIDENCE))
            row |= {name: as_text(value.value), **{end: as_text(v) for end, v in ends}}
        row |= {name: as_text(figure(a.figures, *where)) for name, where in PLAIN.items()}
        row["labels_mean"] = figure(a.figures, "convention", "taken") or ""
        row["in_front"] = figure(a.figures, "hidden", "nearer") or ""
        rows.append(row)
    return rows


def as_text(value: float | None) -> str:
    """A value as it stands in a table: empty if there is none."""
    if value is None or not np.isfinite(value):
        return ""
    return str(value) if isinstance(value, int) else f"{value:.4f}"
