"""A network under each polarity, on pairs whose disparity grows and falls with height.

Each labelled pair of a dataset is matched as it is, and flipped from left to right, which turns the
sign of its disparities and of its relief. See README.md beside this file.

python bench/polarity.py --weights StereoNet_US3D.h5 --dataset us3d --layout us3d --range -96 96
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from label_tables import print_table

from stereotruth.dataset.stereo_dataset import StereoDataset
from stereotruth.matching.benchmark.scores import Collector, Scorer
from stereotruth.matching.methods import make_method
from stereotruth.matching.polarity import POLARITIES
from stereotruth.products.rasters import read_image

THRESHOLDS_PX = (3.0, 1.0)


def main() -> None:
    """Print the table: EPE and D1 over the labelled pixels, holes filled."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weights", type=Path, nargs="+", help="of StereoNet; default: SGM")
    parser.add_argument("--dataset", type=Path, required=True)
    parser.add_argument("--layout", default="us3d", help="stereotruth, whu, kitti or us3d")
    parser.add_argument("--range", type=int, nargs=2, default=(-96, 96), metavar="px")
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    low, high = given.range
    dataset = StereoDataset("pairs", given.dataset, given.layout, (low, high))
    rows = []
    for weights in given.weights or [None]:
        for polarity in POLARITIES:
            entry = {"kind": "stereonet", "weights": str(weights)} if weights else {"kind": "sgm"}
            method = make_method("method", {**entry, "polarity": polarity}, given.threads)
            cells = []
            for flipped in (False, True):
                span = (1 - high, 1 - low) if flipped else (low, high)
                scorer = Scorer(span, THRESHOLDS_PX, True)
                collector = Collector(THRESHOLDS_PX)
                for pair in dataset.pairs(None, labelled=True):
                    images = [read_image(file) for file in (pair.left, pair.right)]
                    truth = dataset.labels(pair)
                    if flipped:
                        images = [np.ascontiguousarray(image[:, ::-1]) for image in images]
                        truth = -truth[:, ::-1]
                    collector.add(pair.name, pair.city, scorer.sums(method(*images, span), truth))
                row = collector.scores().row()
                cells += [
                    f"{row['filled_epe_px']:.3f}",
                    *(f"{100 * row[f'filled_d1_{t:g}_px_share']:.2f}" for t in THRESHOLDS_PX),
                ]
            rows.append([weights.stem if weights else "SGM", polarity, *cells])
            print(*rows[-1], flush=True)
    names = ["EPE, px", *(f"> {t:g} px, %" for t in THRESHOLDS_PX)]
    columns = [f"{sign}: {name}" for sign in ("as it is", "flipped") for name in names]
    print_table(f"{given.dataset.name}, by polarity", ["method", "polarity", *columns], rows)


if __name__ == "__main__":
    main()
