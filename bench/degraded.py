"""How methods bear what the synthetic pairs lack: noise, haze, shadows that moved, few grey levels.

The right images of a dataset's test pairs are changed (noise: both), each method matches them, and
EPE and D1 are printed beside those of the pairs as they are. See README.md beside this file.

python bench/degraded.py --method sgm --method stereonet=results/train/.../best.pt
"""

from __future__ import annotations

import argparse
import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from whole_scene import parsed

from stereotruth.dataset.stereo_dataset import StereoDataset
from stereotruth.matching.benchmark.scores import Collector, Scorer
from stereotruth.matching.image_faults import (
    FAULTS,
    Fault,
    Image,
    as_images,
    blur,
    haze,
    shadows,
)
from stereotruth.matching.methods import Matcher, make_method
from stereotruth.products.rasters import read_image

Change = Callable[[Image, Image, np.random.Generator], tuple[Image, Image]]
THRESHOLD_PX = 3.0


def noise(left: Image, right: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """White noise of a fifth of the image's standard deviation, in both images."""
    sigma = 0.2 * left.std()
    return tuple(image + rng.normal(0, sigma, image.shape) for image in (left, right))


def on_the_right(fault: Fault) -> Change:
    """A fault of the right image alone."""
    return lambda left, right, rng: (left, fault(right, rng, 1.0))


def upper_bits(left: Image, right: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """The upper 8 of the images' 16 bits."""
    return tuple(np.maximum(image // 256, 1) for image in (left, right))


CHANGES: dict[str, tuple[Change, ...]] = {
    "as they are": (),
    "noise": (noise,),
    "haze": (on_the_right(haze),),
    "moved shadows": (on_the_right(shadows),),
    "blur": (on_the_right(blur),),
    "noise, haze, shadows, blur": (*map(on_the_right, FAULTS.values()), noise),
    "upper 8 bits": (upper_bits,),
}


def changed(
    left: NDArray, right: NDArray, changes: tuple[Change, ...], seed: list[int]
) -> list[NDArray[np.uint16]]:
    """A pair after the changes, uint16; nodata stays."""
    rng = np.random.default_rng(seed)
    images = [image.astype(np.float32) for image in (left, right)]
    for change in changes:
        images = list(change(*images, rng))
    return as_images(images, (left, right))


def score(matcher: Matcher, dataset: StereoDataset, changes: tuple[Change, ...]) -> dict:
    """EPE (px) and D1 (%) over the labelled pixels of the test pairs, holes filled."""
    scorer = Scorer(dataset.disparity_range, (THRESHOLD_PX,), dataset.grows_with_height)
    collector = Collector(scorer.thresholds_px)
    for number, pair in enumerate(dataset.pairs("test", labelled=True)):
        images = changed(read_image(pair.left), read_image(pair.right), changes, [1, number])
        found = matcher(*images, dataset.disparity_range)
        collector.add(pair.name, pair.city, scorer.sums(found, dataset.labels(pair)))
    row = collector.scores().row()
    return {
        "epe_px": round(row["filled_epe_px"], 3),
        "d1_percent": round(100 * row[f"filled_d1_{THRESHOLD_PX:g}_px_share"], 2),
    }


def main() -> None:
    """Print a table; ``--json`` keeps the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dataset", type=Path, default=Path("dataset"))
    parser.add_argument("--range", type=int, nargs=2, default=(-64, 128), metavar="px")
    parser.add_argument(
        "--method", action="append", required=True, help="sgm, or stereonet[-x]=weights"
    )
    parser.add_argument("--change", action="append", choices=list(CHANGES), help="default: all")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    dataset = StereoDataset("synthetic", given.dataset, "stereotruth", tuple(given.range))
    figures: dict[str, dict[str, dict]] = {}
    chosen = given.change or list(CHANGES)
    print(f"{'EPE, px / D1, %':<22}" + "".join(f"{name:>28}" for name in chosen), flush=True)
    for method in given.method:
        name, settings = parsed(method)
        if "weights" in settings:
            settings["precision"] = "bfloat16"
        matcher = make_method(name, settings, given.threads)
        figures[name] = {}
        print(f"{name:<22}", end="", flush=True)
        for change in chosen:
            of = figures[name][change] = score(matcher, dataset, CHANGES[change])
            cell = f"{of['epe_px']:.2f} / {of['d1_percent']:.1f}"
            print(f"{cell:>28}", end="", flush=True)
        print()
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
