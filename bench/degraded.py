"""How methods bear what the synthetic pairs lack: noise, haze, shadows that moved, few grey levels.

The right images of a dataset's test pairs are changed (noise: both), each method matches them, and
EPE and D1 are printed beside those of the pairs as they are, and how much each method differs from
the first on the same tiles. See README.md beside this file.

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
from stereotruth.matching.benchmark.differences import difference
from stereotruth.matching.benchmark.scores import Collector, Scorer, Scores
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
SAMPLES = 1000  # of the tiles


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


def score(matcher: Matcher, dataset: StereoDataset, changes: tuple[Change, ...]) -> Scores:
    """Scores of the test pairs after the changes."""
    scorer = Scorer(dataset.disparity_range, (THRESHOLD_PX,), dataset.grows_with_height)
    collector = Collector(scorer.thresholds_px)
    for number, pair in enumerate(dataset.pairs("test", labelled=True)):
        images = changed(read_image(pair.left), read_image(pair.right), changes, [1, number])
        found = matcher(*images, dataset.disparity_range)
        collector.add(pair.name, pair.city, scorer.sums(found, dataset.labels(pair)))
    return collector.scores()


def figures(scores: Scores, first: Scores | None = None) -> dict[str, dict[str, float | None]]:
    """EPE (px) and D1 (%) over the labelled pixels, holes filled.

    With ``first``: what of them differs from those of another method on the same tiles (less than
    0: this one is better), and the 95 % interval by resampling the tiles of both together.
    """
    found = {}
    for name, key, scale, column in (
        ("epe_px", "filled_epe_px", 1, 4),  # the last: its column in Scores.sums
        ("d1_percent", f"filled_d1_{THRESHOLD_PX:g}_px_share", 100, 5),
    ):
        of = {"value": scale * scores.row()[key]}
        if first is not None:
            sums = (
                {t: s[0, [0, column]] for t, s in zip(x.tiles, x.sums)} for x in (first, scores)
            )
            paired = difference(*sums, times=SAMPLES, seed=1)
            of |= {
                f"less_{k}": None if paired[k] is None else scale * paired[k]
                for k in ("value", "low", "high")
            }
        found[name] = {k: None if v is None else round(v, 3) for k, v in of.items()}
    return found


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
    table: dict[str, dict[str, dict]] = {}
    first: dict[str, Scores] = {}
    chosen = given.change or list(CHANGES)
    print(f"{'EPE, px / D1, %':<22}" + "".join(f"{name:>46}" for name in chosen), flush=True)
    for number, method in enumerate(given.method):
        name, settings = parsed(method)
        if "weights" in settings:
            settings["precision"] = "bfloat16"
        matcher = make_method(name, settings, given.threads)
        table[name] = {}
        lines = [f"{name:<22}", f"{'  less the first':<22}"]
        for change in chosen:
            scores = score(matcher, dataset, CHANGES[change])
            of = figures(scores, first.get(change))
            table[name][change] = of
            first.setdefault(change, scores)
            epe, d1 = of.values()
            lines[0] += f"{epe['value']:.2f} / {d1['value']:.1f}".rjust(46)
            if number and epe["less_low"] is not None:  # enough tiles for an interval
                apart = (
                    f"{x['less_value']:+.2f} ({x['less_low']:+.2f}, {x['less_high']:+.2f})"
                    for x in of.values()
                )
                lines[1] += " / ".join(apart).rjust(46)
        print(*lines[: 2 if number else 1], sep="\n", flush=True)
    if given.json:
        given.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
