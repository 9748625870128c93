"""Error rates of the audit: faults planted in good pairs, and how many of them it finds.

See README.md beside this file. Each pair is measured once for each fault and kept in ``--out``, so
that a call that was stopped is carried on by the next.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from stereotruth.config.methods import DATASETS, Audit
from stereotruth.dataset.manifest import Tile
from stereotruth.dataset.stereo_dataset import Pair, StereoDataset
from stereotruth.evaluation.audit import sharing
from stereotruth.evaluation.audit.conventions import label_values
from stereotruth.evaluation.audit.matches import Matches, match_pair
from stereotruth.evaluation.audit.pair import EXTRA_PX, measure_arrays
from stereotruth.evaluation.audit.verdicts import FAULT, UNDECIDED, judge
from stereotruth.products.files import atomic_file
from stereotruth.products.grids import require_complete
from stereotruth.products.rasters import read_image

PROJECT = Path(__file__).resolve().parents[1]
BLOCK = 48  # px: side of the places where labels are made wrong,
WRONG_PX = (4.0, 12.0)  # by so much
NONE = "none"
LAST_OF_LABELS = "labels 2 px too far right or low"
OVERLAPS = (1.0, 0.5, 0.25, 0.15)

Labels = NDArray[np.float32]


def moved(image: NDArray[Any], x: float, y: Callable[[NDArray[Any]], NDArray[Any]] | float) -> Any:
    """An image whose content lies x px further right and y px further down (or y of the column)."""
    rows, cols = np.mgrid[: image.shape[0], : image.shape[1]].astype(float)
    down = y(cols) if callable(y) else y
    found = map_coordinates(image.astype(float), [rows - down, cols - x], order=3, mode="nearest")
    top = np.iinfo(image.dtype).max
    return np.clip(np.rint(found), 1, top).astype(image.dtype)


def wrong_labels(labels: Labels, share: float, rng: np.random.Generator) -> Labels:
    """Labels of which a share, in blocks, is off by 4 to 12 px."""
    found = labels.copy()
    known = np.isfinite(labels)
    blocks = rng.permutation([(y, x) for y in range(0, 1024, BLOCK) for x in range(0, 1024, BLOCK)])
    done = 0
    for y, x in blocks:
        part = found[y : y + BLOCK, x : x + BLOCK]
        part += np.float32(rng.uniform(*WRONG_PX) * rng.choice((-1, 1)))
        done += int(np.isfinite(part).sum())
        if done >= share * known.sum():
            break
    return found


def with_hidden(labels: Labels, pair: Pair, truth: Path, share: float) -> Labels:
    """Labels, and exact disparities at a share of the pixels that the right view does not see."""
    tile = Tile.of(pair.row)
    store = require_complete(truth / tile.city / f"{tile.scene}.zarr")
    window, size = tile.window, tile.size
    exact = store["disparity"][window] - tile.right_offset_px
    hidden = (store["hidden"][window] > 0) & np.isfinite(exact) & ~np.isfinite(labels)
    if share < 1:
        patch = np.random.default_rng(1).random((size // 16 + 1, size // 16 + 1)) < share
        hidden &= np.kron(patch, np.ones((16, 16), bool))[:size, :size]
    return np.where(hidden, exact, labels).astype(np.float32)


def label_faults(
    labels: Labels, pair: Pair, other: Labels, truth: Path, sign: int
) -> Iterator[tuple[str, str, Labels]]:
    """Name, check that should find it, faulty labels."""
    rng = np.random.default_rng(sum(pair.name.encode()))
    yield NONE, "", labels
    for size in (0.25, 0.5, 1, 2):
        yield f"labels offset by {size:g} px", "bias", labels + np.float32(sign * size)
    yield "sign of the labels swapped", "convention", -labels
    for share in (0.05, 0.1, 0.2):
        name = f"{100 * share:.0f} % of the labels off by 4–12 px"
        yield name, "contradicted", wrong_labels(labels, share, rng)
    for share in (0.3, 1.0):
        name = f"labels on {100 * share:.0f} % of the hidden pixels"
        yield name, "hidden", with_hidden(labels, pair, truth, share)
    yield "unlabelled pixels hold 0", "values", np.nan_to_num(labels, nan=0.0)
    yield "unlabelled pixels hold −9999", "values", np.nan_to_num(labels, nan=-9999.0)
    yield "labels of another pair", "any", other
    for size in (1, 2):
        name = f"labels {size} px too far right or low"
        yield name, "registration", np.roll(labels, size, axis=sum(pair.name.encode()) // 2 % 2)


def image_faults(
    left: NDArray[Any], right: NDArray[Any], sign: int
) -> Iterator[tuple[str, str, NDArray[Any], NDArray[Any]]]:
    """Name, check that should find it, faulty images."""
    for size in (0.25, 0.5, 1):
        name = f"right image {size:g} px too low or high"
        yield name, "rows", left, moved(right, 0.0, sign * size)
    yield "right image half a pixel along the rows", "bias", left, moved(right, 0.5 * sign, 0.0)
    width = left.shape[1]
    tilted = moved(right, 0.0, lambda x: sign * (2 * x - width) / width)
    yield "rows tilted, 1 px at the edges", "rows", left, tilted
    yield "images swapped", "convention", right, left


def measured(
    left: NDArray[Any],
    right: NDArray[Any],
    labels: Labels,
    matches: Matches,
    limits: tuple[float, float],
) -> dict[str, Any]:
    """Figures as the audit has them of files."""
    values = label_values(labels, limits)._asdict()
    spikes = [value for value, _ in values["spikes"]]
    found = measure_arrays(left, right, labels, matches, spikes=spikes)
    head = {"same_shape": True, "identical_images": False, "images": {}, "dtype": ["uint16"]}
    return head | {"labels": values} | found


def run_pair(
    dataset: StereoDataset, pair: Pair, other: Pair, truth: Path, out: Path, faults: bool
) -> None:
    """Measure a pair as it is, and with all faults if asked for."""
    left, right = read_image(pair.left), read_image(pair.right)
    labels = dataset.labels(pair)
    sign = 1 if sum(pair.name.encode()) % 2 else -1
    reach = max(abs(v) for v in dataset.disparity_range) + EXTRA_PX
    file = out / f"{pair.name}.json"
    found = json.loads(file.read_text()) if file.is_file() else {}
    matches = match_pair(left, right, reach) if LAST_OF_LABELS not in found else None
    for name, check, faulty in label_faults(labels, pair, dataset.labels(other), truth, sign):
        if matches is not None and name not in found and (faults or name == NONE):
            figures = measured(left, right, faulty, matches, dataset.disparity_range)
            found[name] = {"check": check, "figures": figures}
    for name, check, a, b in image_faults(left, right, sign) if faults else ():
        if name not in found:
            figures = measured(a, b, labels, match_pair(a, b, reach), dataset.disparity_range)
            found[name] = {"check": check, "figures": figures}
    with atomic_file(file) as scratch:
        scratch.write_text(json.dumps(found))


def shared_ground(pairs: list[Pair]) -> dict[str, Any]:
    """Duplicates and overlaps that are found, and unrelated pairs that are taken for such."""
    images = [read_image(pair.left) for pair in pairs]
    looks = [sharing.features(image) for image in images]
    scenes = [(pair.row["scene"], pair.row["row0"], pair.row["col0"]) for pair in pairs]
    counts = [
        sharing._align(looks[i], looks[j])[0]
        for i, j in combinations(range(len(pairs)), 2)
        if scenes[i] != scenes[j]
    ]
    found = {}
    for share in OVERLAPS:
        hits = 0
        for k, image in enumerate(images):
            width = image.shape[1]
            cut = round(width * (1 - share))
            beside = images[(k + 7) % len(images)]
            twin = np.hstack([image[:, cut:], beside[:, :cut]]).astype(float) * 0.8 + 60
            noisy = twin + np.random.default_rng(k).normal(0, 4, twin.shape)
            other = sharing.features(np.clip(noisy, 1, 65535).astype(np.uint16))
            hits += sharing._compare(looks[k], other) is not None
        found[f"{100 * share:g} %"] = [hits, len(images)]
    return {
        "overlaps": found,
        "unrelated": len(counts),
        "alarms": sum(n >= sharing.MIN_INLIERS for n in counts),
        "most_matches_by_chance": max(counts),
        "needed": sharing.MIN_INLIERS,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dataset", type=Path, default=PROJECT / "dataset")
    parser.add_argument("--truth", type=Path, default=PROJECT / "results/truth")
    parser.add_argument("--out", type=Path, default=PROJECT / "bench/out/audit")
    parser.add_argument("--every", type=int, default=1, help="faults go into every so manieth pair")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=1e9, help="start no pair after this time")
    arguments = parser.parse_args()
    dataset = StereoDataset.of("own", DATASETS["synthetic"] | {"root": str(arguments.dataset)})
    limits = Audit()
    pairs = dataset.pairs(labelled=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    end = time.monotonic() + 60 * arguments.minutes

    def one(k: int) -> None:
        if time.monotonic() < end:
            faults = k % arguments.every == 0
            other = pairs[(k + 1) % len(pairs)]
            run_pair(dataset, pairs[k], other, arguments.truth, arguments.out, faults)
            print(pairs[k].name, flush=True)

    with ThreadPoolExecutor(arguments.workers) as pool:
        # from all over the dataset, so that a part of the run says something, too
        list(pool.map(one, sorted(range(len(pairs)), key=lambda k: k * 17 % len(pairs))))
    files = [arguments.out / f"{pair.name}.json" for pair in pairs]
    done = [json.loads(file.read_text()) for file in files if file.is_file()]
    if len(done) < len(pairs):
        print(f"{len(done)} of {len(pairs)} pairs: run it again")
    shared = arguments.out / "shared_ground.json"
    if not shared.is_file() and time.monotonic() < end:
        shared.write_text(json.dumps(shared_ground(pairs)))
    report(done, limits, len(pairs))
    if shared.is_file():
        print(shared.read_text())


def report(done: list[dict[str, Any]], limits: Audit, pairs: int) -> None:
    """A row per fault: pairs, found by its check, found by any, undecided."""
    names = {name: of["check"] for found in done for name, of in found.items()}
    print("\n| fault | pairs | found by its check | by any | undecided |\n|---|---|---|---|---|")
    for name, check in names.items():
        verdicts = [judge(found[name]["figures"], limits, pairs) for found in done if name in found]
        own = [any(f.check == check for f in v.of(FAULT)) for v in verdicts]
        own = "" if check in ("", "any") else f"{sum(own)}"
        words = [v.word for v in verdicts]
        cells = [name, len(verdicts), own, words.count(FAULT), words.count(UNDECIDED)]
        print(f"| {' | '.join(map(str, cells))} |")


if __name__ == "__main__":
    main()
