"""The last lines of a run: what this run has made, its figures, and where to look."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any


def last_lines(products: Iterable[str]) -> list[str]:
    """What to say of products, in the order of the workflow; without figures only where they are.

    ``products``: files and folders by their paths relative to the working directory.
    """
    products = list(dict.fromkeys(products))
    said = [
        line
        for pattern, say in SAYINGS.items()
        for product in sorted(products)
        if (found := re.fullmatch(pattern, product))
        for line in _lines(say, product, *found.groups())
    ]
    if said or not products:
        return said
    more = f" and {len(products) - 3} more" if len(products) > 3 else ""
    return [f"Made {', '.join(products[-3:])}{more}"]


def _lines(say: Callable[..., Iterator[str]], product: str, *groups: str) -> list[str]:
    """What to say of a product; where its figures cannot be read, that it is damaged."""
    try:
        return list(say(product, *groups))
    except Exception:  # whatever a damaged file makes of them
        return [f"Look at {product}: its figures cannot be read; delete it and run again"]


def _read(*parts: str) -> Mapping[str, Any]:
    return json.loads(Path(*parts).read_text(encoding="utf-8"))


def _tiles(product: str, city: str) -> Iterator[str]:
    yield from _read("results/export", city, "summary.json")["lines"]


def _against_truth(product: str, of: str) -> Iterator[str]:
    figures = _read(product)
    scopes = [figures[scope]["errors"] for scope in ("exported_tiles", "whole_scene")]
    if errors := next((of for of in scopes if of["count"]), None):
        yield (
            f"{of} against its exact truth: {errors['mean_absolute']:.3f} px mean absolute error, "
            f"{100 * errors['share_over_1_px']:.2f} % off by more than 1 px; look at "
            f"{Path(product).with_suffix('.csv')}"
        )


def _adjusted(product: str, city: str) -> Iterator[str]:
    images = _read(product)["images"]
    hurting = {name: image["doubts"] for name, image in images.items() if image["doubts"]}
    sigma = [image["sigma"] for image in images.values() if not image["refused"]]
    known = f"known to {max(sigma):.3f} px at worst" if sigma else "none of them placed"
    yield (
        f"{city}: {len(images)} images adjusted together, {known}"
        + ("" if hurting else "; none is doubtful")
    )
    for name, doubts in hurting.items():
        yield f"{city}: image {name}: {'; '.join(doubts)}"
    yield f"Look at {product}"


def _closure(product: str, city: str) -> Iterator[str]:
    values = _read(product)
    labels = values["site"]["labels"]
    if labels["count"]:
        yield (
            f"{city}: {len(values['triplets'])} triplets of images, whose labels close to "
            f"{labels['rms']:.3f} px rms, {100 * labels['within_1_sigma']:.0f} % within 1 and "
            f"{100 * labels['within_2_sigma']:.0f} % within 2 σ; look at {product}"
        )


def _look(product: str, *_: str) -> Iterator[str]:
    yield f"Look at {product}"


def _training(product: str, dataset: str, method: str) -> Iterator[str]:
    best = _read(product)["best"]
    yield (
        f"{method} trained on {dataset}: EPE {best['val_epe_px']:.3f} px, D1 "
        f"{100 * best['val_d1']:.2f} % on the validation tiles; look at "
        f"{Path(product).with_name('curves.png')}"
    )


def _scores(product: str, dataset: str) -> Iterator[str]:
    from stereobench.scores.score_method import describe  # seconds, which other runs need not take

    summary = _read(product, "scores.json")
    yield f"{summary['label']} on {dataset}: {describe(summary)}; look at {product}/cities.csv"
    for doubt in summary["doubts"]:
        yield f"Warning: {summary['label']} on {dataset}: {doubt}"


def _audit(product: str, dataset: str) -> Iterator[str]:
    for number, line in enumerate(_read(product, "summary.json")["statements"]):
        yield line if number else f"Audit of {dataset}: {line}"
    yield f"Look at {product}/index.html"


def _surface_model(product: str, scene: str, method: str) -> Iterator[str]:
    from ..evaluate.surface_models.score import describe

    line = describe(_read(product, "scores.json"))
    yield f"Surface model of {scene} by {method}: {line}; look at {product}/index.html"


SAYINGS: dict[str, Callable[..., Iterator[str]]] = {
    r"results/adjust/([^/]+)\.json": _adjusted,
    r"tiles/([^/]+)": _tiles,
    r"results/closure/([^/]+)\.json": _closure,
    r"results/evaluate/(?:[^/]+/)?([^/]+)/truth\.json": _against_truth,
    r"results/evaluate/([^/]+)/table4\.csv": _look,
    r"results/report/([^/]+)/index\.html": _look,
    r"results/site/([^/]+)/index\.html": _look,
    r"dataset": _look,
    r"results/train/([^/]+)/([^/]+)/training\.json": _training,
    r"benchmark/([^/]+)/[^/.]+": _scores,
    r"benchmark/([^/]+)/index\.html": _look,
    r"submission/[^/]+/[^/]+": _look,
    r"audit/([^/]+)": _audit,
    r"results/predict/.*_dsm\.tif": _look,
    r"score_dsm/[^/]+/([^/]+)/([^/]+)": _surface_model,
}
