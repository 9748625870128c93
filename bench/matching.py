"""What the methods cost beside the bare calls that they are made of. See README.md beside this.

python bench/matching.py                              # a random texture, 1024 × 1024, 16 bit
python bench/matching.py --dataset dataset --layout stereotruth

Networks are timed where PyTorch is installed, with random weights: time does not depend on them.
Pandora is where its extra is; its calls take half a minute each.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np

from stereotruth.dataset.stereo_dataset import find_pairs
from stereotruth.matching.networks import inference, weights
from stereotruth.matching.sgm import MODES, STEP, SemiGlobalMatcher, pad, to_8_bits
from stereotruth.products.rasters import read_image

RANGE = (-128, 64)  # the paper's
PRECISIONS = ("float32", "bfloat16")
PAPER_MS = {"stereonet": 238, "psmnet": 614, "hmsmnet": 511}  # on a GTX 1080 Ti


def texture(size: int, shift: int = 9) -> list[np.ndarray]:
    """A pair of 16-bit images of one plane."""
    rng = np.random.default_rng(0)
    wide = cv2.GaussianBlur(
        rng.normal(600, 200, (size, size + shift)).astype(np.float32), (0, 0), 1
    )
    wide = np.clip(wide, 1, 65535).astype(np.uint16)
    return [np.ascontiguousarray(wide[:, start : start + size]) for start in (0, shift)]


def compare(calls: Mapping[str, Callable[[], Any]], times: int) -> dict[str, dict[str, float]]:
    """Median milliseconds, by clock and of the CPU, of calls taken in turns after one of each."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in calls}
    for turn in range(times + 1):
        for name, call in calls.items():
            clock, cpu = time.perf_counter(), time.process_time()
            call()
            if turn:
                taken[name].append((time.perf_counter() - clock, time.process_time() - cpu))
    return {
        name: {
            kind: round(1000 * median(of[k] for of in values), 1)
            for k, kind in enumerate(("clock_ms", "cpu_ms"))
        }
        for name, values in taken.items()
    }


def sgm(left: np.ndarray, right: np.ndarray, mode: str, times: int) -> dict[str, Any]:
    """SGM as a method, and the bare calls: of the same pixels, and without padding."""
    matcher = SemiGlobalMatcher(mode=mode)
    mapping = matcher.scaling(left, right)
    bare = matcher.opencv(RANGE)
    eight = [to_8_bits(image, mapping) for image in (left, right)]
    before, after = max(RANGE[1], 0), max(-RANGE[0], 0)
    padded = [pad(image, before, after) for image in eight]
    found = matcher(left, right, RANGE)
    raw = bare.compute(*padded)[:, before : before + left.shape[1]] / np.float32(STEP)
    known = np.isfinite(found)
    assert np.array_equal(found[known], raw[known])
    return compare(
        {
            "method": lambda: matcher(left, right, RANGE),
            "bare": lambda: bare.compute(*padded),
            "bare_unpadded": lambda: bare.compute(*eight),
        },
        times,
    )


def pandora(left: np.ndarray, right: np.ndarray, times: int) -> dict[str, Any]:
    """Pandora as a method, and the bare run on datasets and a pipeline that are ready."""
    try:
        import pandora as bare
        from pandora.state_machine import PandoraMachine

        from stereotruth.matching import pandora_pipeline
    except ImportError:
        print("\nPandora is not installed")
        return {}

    low, high = RANGE
    method = pandora_pipeline.PandoraMethod(name="pandora")
    both = [
        pandora_pipeline.dataset(image.astype(np.float32), searched)
        for image, searched in ((left, (1 - high, -low)), (right, (low, high - 1)))
    ]
    _, pipeline = method.checked(*both)

    def run() -> Any:
        return bare.run(PandoraMachine(), *both, pipeline)[0]

    found, raw = method(left, right, RANGE), -run()["disparity_map"].data
    known = np.isfinite(found)
    assert np.array_equal(found[known], raw[known])
    return compare({"method": lambda: method(left, right, RANGE), "bare": run}, times)


def networks(
    left: np.ndarray,
    right: np.ndarray,
    times: int,
    threads: int,
    kinds: Sequence[str],
    precisions: Sequence[str],
) -> dict[str, Any]:
    """Each network as a method on raw pixels, and bare PyTorch on tensors that are ready."""
    try:
        import torch
    except ImportError:
        print("\nPyTorch is not installed: no networks")
        return {}

    torch.set_num_threads(threads)
    device = inference.choose_device(None)
    figures = {}
    print(f"\nPyTorch {torch.__version__}, {device}, {threads} thread(s)")
    print(f"{'network':<22}{'method':>18}{'bare':>18}{'ratio':>8}{'paper':>8}")
    for kind in kinds:
        for precision in precisions:
            if inference.precision_of(precision, device) != precision:
                continue
            model = weights.SavedNetwork(kind, RANGE, 3 if left.ndim == 3 else 1)
            method = inference.NetworkMethod(model, model.build(), device, precision)
            ready = [
                torch.from_numpy(weights.scaled(image, model, None))[None].to(device)
                for image in (left, right)
            ]

            def bare(method: Any = method, ready: Any = ready, precision: str = precision) -> None:
                with torch.inference_mode(), inference.mixed(precision, device):
                    method.network(*ready)
                if device.type == "cuda":
                    torch.cuda.synchronize()

            calls = {"method": lambda m=method: m(left, right, RANGE), "bare": bare}
            figures[f"{kind} {precision}"] = of = compare(calls, times)
            cells = [f"{of[k]['clock_ms']:.0f} / {of[k]['cpu_ms']:.0f}" for k in of]
            # on a GPU the processor waits
            clock = "clock_ms" if device.type == "cuda" else "cpu_ms"
            ratio = of["method"][clock] / of["bare"][clock]
            name = f"{kind} {precision}"
            print(
                f"{name:<22}{cells[0]:>18}{cells[1]:>18}{ratio:>8.3f}{PAPER_MS[kind]:>8}",
                flush=True,
            )
    return figures


def main() -> None:
    """Print tables; ``--json`` keeps the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dataset", type=Path, help="take the first pair of this folder")
    parser.add_argument("--layout", default="whu", help="stereotruth, whu or us3d")
    parser.add_argument("--times", type=int, default=7, help="calls of each")
    parser.add_argument("--threads", type=int, default=1, help="of each call")
    parser.add_argument("--network", action="append", choices=list(PAPER_MS), help="default: all")
    parser.add_argument("--precision", action="append", choices=PRECISIONS, help="default: both")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    cv2.setNumThreads(given.threads)
    if given.dataset is None:
        left, right = texture(1024)
    else:
        pair = find_pairs(given.dataset, given.layout)[0]
        left, right = read_image(pair.left), read_image(pair.right)
    print(f"{platform.machine()}, OpenCV {cv2.__version__}, {given.threads} thread(s); ", end="")
    print(f"{left.shape} {left.dtype}, disparities [{RANGE[0]}, {RANGE[1]}); ms, clock / CPU\n")
    print(f"{'SGM':<6}{'method':>16}{'bare, padded':>16}{'ratio (CPU)':>13}{'bare, unpadded':>18}")
    figures = {}
    for mode in MODES:
        figures[mode] = of = sgm(left, right, mode, given.times)
        cells = [f"{of[k]['clock_ms']:.0f} / {of[k]['cpu_ms']:.0f}" for k in of]
        ratio = of["method"]["cpu_ms"] / of["bare"]["cpu_ms"]
        print(f"{mode:<6}{cells[0]:>16}{cells[1]:>16}{ratio:>13.3f}{cells[2]:>18}", flush=True)
    of_pandora = pandora(left, right, given.times)
    if of_pandora:
        cells = [
            f"{of_pandora[k]['clock_ms']:.0f} / {of_pandora[k]['cpu_ms']:.0f}" for k in of_pandora
        ]
        ratio = of_pandora["method"]["cpu_ms"] / of_pandora["bare"]["cpu_ms"]
        print(f"\nPandora: {cells[0]} as a method, {cells[1]} bare, ratio (CPU) {ratio:.3f}")
    chosen = given.network or list(PAPER_MS), given.precision or PRECISIONS
    of_networks = networks(left, right, given.times, given.threads, *chosen)
    if given.json:
        record = {"sgm": figures, "pandora": of_pandora, "networks": of_networks}
        given.json.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
