"""From measurements to verdicts: what is wrong with a pair, at a stated rate of false alarms.

A quantity is a fault only if its confidence interval lies beyond the tolerance, and all right only
if it lies within; else the pair is undecided in it. Intervals are as wide as it takes for the
chance that any pair of a faultless dataset is called faulty by a check to stay below
``false_alarms``: each check of each of n pairs has level ``false_alarms`` / n (Bonferroni), shared
by the numbers that it looks at.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from stereotruth.core.config.methods import AuditLimits

from . import conventions
from .pair import estimate
from .registration import SHIFTS

FAULT, UNDECIDED, NOTE = "fault", "undecided", "note"
GOOD = "good"
EXPLAINS = 0.05  # share of the matches that another meaning of the labels must explain more
GAIN = 0.15  # of the squared difference beside steps, by which a move must make it less
WRONG = 0.25  # share of wrong labels among those of one frequent value
NEGLIGIBLE = 1e-3  # share of labels outside the range
MIN_LEVELS = 8  # grey values of an image
CHECKS = {  # what a pair must have, in the order of the page
    "files": "files that fit together",
    "rows": "rows that correspond",
    "convention": "sign and sides as stated",
    "bias": "labels free of offset",
    "registration": "labels on the pixels that they belong to",
    "values": "values as stated",
    "contradicted": "labels that the images bear out",
    "hidden": "labels on visible pixels only",
    "shared": "ground in one split only",
}


@dataclass(frozen=True)
class Finding:
    """Something about a pair: which check, whether a fault, undecided or a note, and in words."""

    check: str
    level: str
    text: str


@dataclass(frozen=True)
class Verdict:
    """The findings of a pair."""

    findings: tuple[Finding, ...] = field(default=())

    @property
    def word(self) -> str:
        """Fault, undecided or good."""
        levels = {finding.level for finding in self.findings}
        return next((level for level in (FAULT, UNDECIDED) if level in levels), GOOD)

    def of(self, level: str) -> list[Finding]:
        """The findings of a level."""
        return [finding for finding in self.findings if finding.level == level]


def judge(
    figures: Mapping[str, Any], limits: AuditLimits, pairs: int, shared: Sequence[Finding] = ()
) -> Verdict:
    """The verdict on one of ``pairs`` pairs, from its figures and what it shares with others."""
    level = limits.false_alarms / max(pairs, 1)
    found = [*_files(figures)]
    if figures["same_shape"] and not figures["identical_images"]:
        found += _rows(figures, limits.parallax_px, level)
        if "labels" in figures:
            found += _labels(figures, limits, level)
    return Verdict((*found, *shared))


def _files(figures: Mapping[str, Any]) -> list[Finding]:
    found = []
    if not figures["same_shape"]:
        found.append(Finding("files", FAULT, "images and labels differ in size"))
    if figures["identical_images"]:
        found.append(Finding("files", FAULT, "left and right image are the same"))
    for side, image in figures["images"].items():
        if image["levels"] < MIN_LEVELS:
            found.append(Finding("files", FAULT, f"the {side} image is empty"))
    if len(set(figures["dtype"])) > 1:
        found.append(Finding("files", NOTE, f"images of types {' and '.join(figures['dtype'])}"))
    return found


def _beyond(
    figures: Mapping[str, Any], names: Mapping[tuple[str, ...], str], tolerance: float, level: float
) -> tuple[list[str], bool]:
    """In words what is beyond a tolerance, and whether something is undecided."""
    faults, open_ = [], False
    for where, what in names.items():
        value = estimate(figures, *where)
        says = value.beyond(tolerance, level / len(names))
        if says:
            low, high = value.interval(0.05)
            faults.append(f"{what} {value.value:+.2f} px ({low:+.2f} … {high:+.2f})")
        open_ |= says is None
    return faults, open_


def _rows(figures: Mapping[str, Any], tolerance: float, level: float) -> list[Finding]:
    names = {
        ("rows", "parallax"): "vertical parallax",
        ("rows", "tilt_x"): "vertical parallax, from the middle to the right edge",
        ("rows", "tilt_y"): "vertical parallax, from the middle to the lower edge",
    }
    faults, open_ = _beyond(figures, names, tolerance, level)
    if faults:
        return [Finding("rows", FAULT, "; ".join(faults))]
    text = f"vertical parallax: {figures['matches']} matches do not tell"
    return [Finding("rows", UNDECIDED, text)] if open_ else []


def _labels(figures: Mapping[str, Any], limits: AuditLimits, level: float) -> list[Finding]:
    found = _values(figures, level)
    if not figures["labels"]["labelled"]:
        return [*found, Finding("values", FAULT, "no labels")]
    meaning = figures["convention"]
    if meaning["taken"] != conventions.AS_STATED:
        more = estimate(figures, "convention", "more")
        if more.interval(level)[0] > 0 and more.value > EXPLAINS:
            text = f"labels agree with the images as: {meaning['best']}"
            text += f" ({100 * more.value:.0f} % of the matches more than as stated)"
            found.append(Finding("convention", FAULT, text))
    names = {
        ("bias", "bias"): "label - match",
        ("bias", "tilt_x"): "label - match, from the middle to the right edge",
        ("bias", "tilt_y"): "label - match, from the middle to the lower edge",
    }
    faults, open_ = _beyond(figures, names, limits.label_bias_px, level)
    if faults:
        found.append(Finding("bias", FAULT, "; ".join(faults)))
    elif open_:
        text = f"label - match: {figures['bias']['matches']} matches do not tell"
        found.append(Finding("bias", UNDECIDED, text))
    gain = estimate(figures, "registration", "gain")
    if gain.interval(level / len(SHIFTS))[0] > GAIN:
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


def _values(figures: Mapping[str, Any], level: float) -> list[Finding]:
    found = []
    labels = figures["labels"]
    for value, share in labels["strays"]:
        text = f"{100 * share:.1f} % of the pixels are {value:g}, outside the range: nodata?"
        found.append(Finding("values", FAULT, text))
    outside = labels["outside"] - sum(s for _, s in labels["strays"]) / max(
        labels["labelled"], 1e-9
    )
    if outside > NEGLIGIBLE:
        text = f"{100 * outside:.1f} % of the labels are outside the range"
        found.append(Finding("values", NOTE, text))
    for k, (value, share) in enumerate(labels["spikes"]):
        wrong = estimate({"at": figures["spikes"][k]}, "at")
        if wrong.interval(level)[0] > WRONG:
            text = (
                f"{100 * share:.1f} % of the pixels are {value:g}, and the images say no: nodata?"
            )
            found.append(Finding("values", FAULT, text))
    if labels["step"]:
        text = f"labels are multiples of {labels['step']:g} px"
        found.append(Finding("values", NOTE, text))
    return found
