"""How many pixels get a label: the shares that `stereotruth check` goes by.

Measured on fresh synthetic pairs and written to the package
(``src/stereotruth/command/estimates.json``), which holds no other copy. See README.md beside this.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from labelled_block import Block
from synthetic_pairs import Pair, fresh_pair

from stereotruth.command.check_tiles import pixel_m2
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluation.labels_against_truth import WATER
from stereotruth.status import is_labelled

PROJECT = Path(__file__).resolve().parents[1]
TABLE = PROJECT / "src/stereotruth/command/estimates.json"
DENSITIES = (0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 6.0)  # points/m²
MIDDLE_PX = 1024
RECIPES = ("paper", "surface")


def labelled(pair: Pair, rectified: Path, asked: Sequence[float]) -> dict[str, list[float]]:
    """Share of the visible pixels with a label by density and recipe.

    In the middle of the grid, all of which both images show and LiDAR covers; water, which has no
    labels, does not count.
    """
    model = EpipolarModel.load(rectified / "epipolar.json")
    starts = ((side - MIDDLE_PX) // 2 for side in model.shape)
    block = Block(pair, rectified, *(slice(start, start + MIDDLE_PX) for start in starts))
    area = pixel_m2(model)
    densities = [min(d, block.density) for d in asked]
    found: dict[str, list[float]] = {"points_per_px": [d * area for d in densities]}
    visible = block.truth.groups()["visible"] & (block.truth.kind != WATER)
    for recipe in RECIPES:
        statuses = (block.labels(block.job(d, recipe))["status"] for d in densities)
        found[recipe] = [float(is_labelled(status)[visible].mean()) for status in statuses]
        print(recipe, *zip(densities, found[recipe]), flush=True)
    return found


def main() -> None:
    """Measure, and write the shares to the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=PROJECT / "bench/out/estimates")
    parser.add_argument(
        "--cities", type=int, nargs="+", default=[1, 2, 3], help="numbers of the fresh cities"
    )
    parser.add_argument("--densities", type=float, nargs="+", default=DENSITIES)
    parser.add_argument("--out", type=Path, default=TABLE)
    arguments = parser.parse_args()
    shares = []
    for city in arguments.cities:
        pair = fresh_pair(city, arguments.folder)
        rectified = pair.rectified("plain", arguments.folder / "rectified")
        shares.append(labelled(pair, rectified, arguments.densities))
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    table["labelled"] = {
        name: [round(float(share), 3) for share in np.mean([of[name] for of in shares], axis=0)]
        for name in shares[0]
    }
    arguments.out.write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    print(arguments.out.read_text())


if __name__ == "__main__":
    main()
