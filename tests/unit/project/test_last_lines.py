"""What a run says at its end."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stereotruth.evaluate.labels_against_truth import Comparison, SceneComparison
from stereotruth.project.last_lines import last_lines

SCORES = {
    "label": "SGM",
    "thresholds_px": [3, 1],
    "tiles": 4,
    "all": {"labelled": 9, "valid_share": 1, "epe_px": 0.5, "d1_3_px_share": 0.02},
}


def truth(errors: list[float]) -> dict:
    """What ``truth.json`` holds of tiles with these errors."""
    result = SceneComparison("A")
    result.all_tiles.parts["ground"] = part = Comparison()
    part.errors.add(np.array(errors))
    return result.figures()


FILES = {
    "results/export/A/summary.json": {"lines": ["A: 16 pairs", "Look at tiles/A"]},
    "results/evaluate/A/truth.json": truth([0.01] * 98 + [-0.02, -1.1]),
    "results/evaluate/A/A-1/truth.json": truth([]),
    "results/adjust/A.json": {
        "images": {
            "one": {"doubts": [], "refused": "", "sigma": 0.0312},
            "two": {"doubts": ["clouds", "x"], "refused": "", "sigma": 0.02},
        }
    },
    "results/closure/A.json": {
        "triplets": [{}, {}],
        "site": {
            "labels": {"count": 3, "rms": 0.0071, "within_1_sigma": 0.7, "within_2_sigma": 0.95}
        },
    },
    "results/train/own/net/training.json": {"best": {"val_epe_px": 1.25, "val_d1": 0.5}},
    "benchmark/own/sgm/scores.json": SCORES | {"doubts": ["is the sign turned?"]},
    "audit/own/summary.json": {"statements": ["4 pairs: 3 good.", "Labels fit."]},
}


@pytest.fixture(autouse=True)
def made(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, values in FILES.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(json.dumps(values))


def test_each_product_is_named_with_its_figures_in_the_order_of_the_workflow():
    products = [
        "results/predict/A/A-1/sgm_dsm.tif",
        "audit/own",
        "benchmark/own/index.html",
        "benchmark/own/methods.csv",
        "benchmark/own/sgm",
        "results/train/own/net/best.pt",
        "results/train/own/net/training.json",
        "results/report/A/index.html",
        "results/evaluate/A/A-1/truth.json",
        "results/evaluate/A/truth.json",
        "tiles/A",
        "tiles/A",
        "results/project/A/A-1.zarr",
    ]
    assert last_lines(products) == [
        "A: 16 pairs",
        "Look at tiles/A",
        "A against its exact truth: 0.021 px mean absolute error, 1.00 % off by more than 1 px; "
        "look at results/evaluate/A/truth.csv",
        "Look at results/report/A/index.html",
        "net trained on own: EPE 1.250 px, D1 50.00 % on the validation tiles; "
        "look at results/train/own/net/curves.png",
        "SGM on own: EPE 0.500 px, D1 (3 px) 2.00 %; 4 pairs; look at benchmark/own/sgm/cities.csv",
        "Warning: SGM on own: is the sign turned?",
        "Look at benchmark/own/index.html",
        "Audit of own: 4 pairs: 3 good.",
        "Labels fit.",
        "Look at audit/own/index.html",
        "Look at results/predict/A/A-1/sgm_dsm.tif",
    ]


def test_images_adjusted_together_and_closed_triplets_are_told():
    assert last_lines(["results/closure/A.json", "results/adjust/A.json"]) == [
        "A: 2 images adjusted together, known to 0.031 px at worst",
        "A: image two: clouds; x",
        "Look at results/adjust/A.json",
        "A: 2 triplets of images, whose labels close to 0.007 px rms, 70 % within 1 and 95 % "
        "within 2 σ; look at results/closure/A.json",
    ]


def test_what_has_no_figures_is_named():
    assert last_lines([]) == []
    stores = [f"results/ingest/A/A-1/{n}.points" for n in range(5)]
    assert last_lines(stores) == [f"Made {stores[2]}, {stores[3]}, {stores[4]} and 2 more"]


def test_figures_that_cannot_be_read_end_no_run():
    for text in (b"{", b"[]", b"{}", b"\xff"):
        Path("results/export/A/summary.json").write_bytes(text)
        (line,) = last_lines(["tiles/A"])
        assert line.startswith("Look at tiles/A: its figures cannot be read")
