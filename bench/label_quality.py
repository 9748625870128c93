"""Do better labels train better networks? One StereoNet, one set of scenes.

Each kind trains the network anew, by several seeds, for the same number of steps on the same
windows; unseen scenes judge it by their exact truth. See README.md beside this file.

python bench/label_quality.py --minutes 3 --seeds 3 --figure docs/label_quality.png

Whatever is finished is kept under ``--folder``: a run that was stopped is carried on.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from label_kinds import KINDS, Labelled, Unseen, digest_of, training_pairs, unseen_pair
from label_tables import print_table
from numpy.typing import NDArray
from torch import Tensor, nn

from stereotruth.matching.networks.inference import load_network, mixed, precision_of
from stereotruth.matching.networks.training_state import make_optimiser
from stereotruth.matching.networks.weights import SavedNetwork, scaled
from stereotruth.products.files import write_json

RANGE = (-64, 128)
WINDOW_PX = 192, 384
BATCH = 2
RATE = 1e-3  # of Adam; half of it after each third of the steps
TIMED_STEPS = 4
SETTLING_STEPS = 30
TIMES = 2000  # that seeds and scenes are drawn anew for an interval
MEASURES = {
    "epe_px": "EPE, px",
    "d1_1_px": "> 1 px, %",
    "d1_3_px": "> 3 px, %",
    "edges_epe_px": "EPE within 3 px of edges, px",
    "crowns_bias_px": "bias on crowns, px",
    "hidden_epe_px": "EPE of hidden pixels, px",
}
RATIOS = {name for name in MEASURES if name != "crowns_bias_px"}  # of what has no sign
CPU = torch.device("cpu")


@dataclass(frozen=True, eq=False)
class Ready:
    """A pair as the network takes it: float32 [1, h, w], [1, h, w], labels [h, w], σ [h, w]."""

    left: Tensor
    right: Tensor
    disparity: Tensor
    sigma: Tensor

    @classmethod
    def of(cls, pair: Labelled, model: SavedNetwork) -> Ready:
        """A pair with the labels inside the range, images by their own mean and spread."""
        low, high = model.disparity_range
        with np.errstate(invalid="ignore"):
            inside = (pair.disparity >= low) & (pair.disparity < high)
        images = (torch.from_numpy(scaled(i, model, None)) for i in (pair.left, pair.right))
        labels = np.where(inside, pair.disparity, np.nan).astype(np.float32)
        return cls(*images, torch.from_numpy(labels), torch.from_numpy(pair.sigma))


def windows(shapes: Sequence[tuple[int, int]], steps: int, seed: int) -> NDArray[np.int64]:
    """Scene, first row, first column of each window [steps, BATCH, 3]: the same for all kinds."""
    rng = np.random.default_rng([seed, 77])
    out = np.empty((steps, BATCH, 3), np.int64)
    for place in out.reshape(-1, 3):
        place[0] = rng.integers(len(shapes))
        for k in (0, 1):
            place[1 + k] = rng.integers(shapes[place[0]][k] - WINDOW_PX[k] + 1)
    return out


def batch_of(pairs: Sequence[Ready], places: NDArray[np.int64]) -> list[Tensor]:
    """left, right [N, 1, h, w]; labels, σ [N, h, w] of windows.

    A label whose match the window cuts off is taken out.
    """
    parts: list[list[Tensor]] = [[], [], [], []]
    for scene, row, col in places:
        pair = pairs[scene]
        at = np.s_[..., row : row + WINDOW_PX[0], col : col + WINDOW_PX[1]]
        labels = pair.disparity[at].clone()
        match = torch.arange(WINDOW_PX[1]) - labels
        labels[(match < 0) | (match > WINDOW_PX[1] - 1)] = torch.nan
        for part, array in zip(parts, (pair.left[at], pair.right[at], labels, pair.sigma[at])):
            part.append(array)
    return [torch.stack(part) for part in parts]


def loss_by_sigma(outputs: Sequence[Tensor], disparity: Tensor, sigma: Tensor) -> Tensor:
    """Smooth L1 over the labels [N, h, w], weighted by 1/(1 + σ²), summed over the outputs.

    Smooth L1 takes an error below 1 px for normal with a spread of 1 px; a label with σ adds its
    variance to that. Without σ all weights are 1, and the loss is that of training.
    """
    valid = torch.isfinite(disparity)
    if not valid.any():
        return disparity.new_zeros(())
    weight = 1.0 / (1.0 + sigma[valid] ** 2)
    weight = weight / weight.mean()
    target = disparity[valid]
    return sum(
        (weight * F.smooth_l1_loss(output.float()[valid], target, reduction="none")).mean()
        for output in outputs
    )


def start(model: SavedNetwork, seed: int, initial: Path | None) -> nn.Module:
    """The network that each kind starts from."""
    torch.manual_seed(seed)
    network = model.build()
    if initial is not None:
        network.load_state_dict(load_network(initial, model.kind)[1].state_dict())
    return network


def train(
    network: nn.Module, pairs: Sequence[Ready], steps: int, seed: int, only: int | None = None
) -> float:
    """Train in place; returns seconds per step. ``only``: stop after so many steps."""
    optimiser = make_optimiser(network, RATE)
    precision = precision_of("bfloat16", CPU)
    network.train()
    places = windows([tuple(pair.disparity.shape) for pair in pairs], steps, seed)
    taken: list[float] = []
    shown = time.monotonic()
    for step, at in enumerate(places[:only]):
        begin = time.monotonic()
        for group in optimiser.param_groups:
            group["lr"] = RATE * 0.5 ** (3 * step // steps)
        left, right, disparity, sigma = batch_of(pairs, at)
        with mixed(precision, CPU):
            outputs = network(left, right)
        loss = loss_by_sigma(outputs, disparity, sigma)
        if loss.requires_grad:
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        taken.append(time.monotonic() - begin)
        if time.monotonic() - shown > 30:
            print(f"    step {step + 1} of {steps}, loss {float(loss):.3f}", flush=True)
            shown = time.monotonic()
    if only is None:
        settle(network, pairs, seed)
    return float(np.median(taken))


@torch.no_grad()
def settle(network: nn.Module, pairs: Sequence[Ready], seed: int) -> None:
    """Batch statistics of the final weights: of a short training they lag behind."""
    for part in network.modules():
        if isinstance(part, nn.modules.batchnorm._BatchNorm):
            part.reset_running_stats()
            part.momentum = None  # the mean of all batches
    shapes = [tuple(pair.disparity.shape) for pair in pairs]
    for at in windows(shapes, SETTLING_STEPS, seed):
        network(*batch_of(pairs, at)[:2])


@torch.inference_mode()
def judge(network: nn.Module, pair: Unseen, model: SavedNetwork) -> dict[str, float]:
    """The measures of one unseen scene; disparities outside the network's range do not count."""
    network.eval()
    rows, cols = (side // 8 * 8 for side in pair.left.shape)
    low, high = model.disparity_range
    images = [
        torch.from_numpy(scaled(image, model, None))[None, :, :rows, :cols]
        for image in (pair.left, pair.right)
    ]
    with mixed(precision_of("float32", CPU), CPU):
        found = network(*images)[-1][0].float().numpy()
    truth = pair.disparity[:rows, :cols]
    match = np.arange(cols) - truth
    inside = (truth >= low) & (truth < high) & (match >= 0) & (match < cols)
    parts = {name: part[:rows, :cols] & inside for name, part in pair.parts.items()}
    error = found - truth
    size = np.abs(error)
    seen = size[parts["visible"]]

    def mean(values: NDArray) -> float:
        return float(values.mean()) if values.size else float("nan")

    return {
        "epe_px": mean(seen),
        "d1_1_px": 100 * mean(seen > 1),
        "d1_3_px": 100 * mean(seen > 3),
        "edges_epe_px": mean(size[parts["edges"]]),
        "crowns_bias_px": mean(error[parts["crowns"]]),
        "hidden_epe_px": mean(size[parts["hidden"]]),
    }


def interval(values: NDArray, against: NDArray | None = None) -> list[float]:
    """Mean (or ratio of means) of figures [seeds, scenes], and its 95 % interval.

    Seeds and scenes are drawn anew, each with replacement; those of both kinds together.
    """
    rng = np.random.default_rng(5)

    def value(seeds: NDArray, scenes: NDArray) -> float:
        top = np.nanmean(values[np.ix_(seeds, scenes)])
        return float(
            top / np.nanmean(against[np.ix_(seeds, scenes)]) if against is not None else top
        )

    n, m = values.shape
    drawn = [value(rng.integers(n, size=n), rng.integers(m, size=m)) for _ in range(TIMES)]
    return [value(np.arange(n), np.arange(m)), *np.quantile(drawn, [0.025, 0.975]).tolist()]


def summary(runs: Mapping[str, Sequence[Sequence[Mapping[str, float]]]]) -> dict[str, Any]:
    """Figures of each kind and their ratio to those of exact labels, with intervals.

    ``runs``: measures by kind, seed and scene; the seeds that all kinds have are compared.
    """
    seeds = min(len(of) for of in runs.values())
    table = {
        kind: {
            name: np.array([[scene[name] for scene in seed] for seed in of[:seeds]])
            for name in MEASURES
        }
        for kind, of in runs.items()
    }
    return {
        kind: {
            name: {"value": interval(values)}
            | (
                {"ratio_to_exact": interval(values, table["exact"][name])}
                if name in RATIOS and "exact" in table
                else {}
            )
            for name, values in of.items()
        }
        for kind, of in table.items()
    }


def show(figures: Mapping[str, Any]) -> None:
    """The tables."""
    for title, key, names in (
        ("By exact truth: mean (95 % interval)", "value", list(MEASURES)),
        ("Divided by the figure of exact labels", "ratio_to_exact", sorted(RATIOS)),
    ):
        rows = [
            [kind, *("{:.3f} ({:.3f}–{:.3f})".format(*of[name][key]) for name in names)]
            for kind, of in figures.items()
            if key in of[names[0]]
        ]
        print_table(title, ["labels", *(MEASURES[name] for name in names)], rows)


def draw_figure(figures: Mapping[str, Any], path: Path) -> None:
    """Each measure divided by that of exact labels, where it has no sign, by kind of label."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, axes = plt.subplots(2, 3, figsize=(10, 5), layout="constrained", sharey=True)
    kinds = list(figures)
    for axis, (name, title) in zip(axes.flat, MEASURES.items()):
        for y, kind in enumerate(kinds):
            key = "ratio_to_exact" if "ratio_to_exact" in figures[kind][name] else "value"
            value, low, high = figures[kind][name][key]
            axis.plot([low, high], [y, y], color="0.4", lw=2, zorder=1)
            axis.plot(value, y, "o", color="#b5482a" if kind == "raster" else "#1f5f8b", zorder=2)
        first = figures[kinds[0]][name]
        is_ratio = "ratio_to_exact" in first
        shown = f"{title.rpartition(',')[0]} / that of exact labels" if is_ratio else title
        axis.set_title(shown, fontsize=9)
        axis.grid(axis="x", alpha=0.3)
        axis.axvline(1 if is_ratio else first["value"][0], color="0.7", lw=0.8, ls="--")
        axis.set_yticks(range(len(kinds)), kinds)
    axes[0, 0].invert_yaxis()
    fig.savefig(path, dpi=110)
    plt.close(fig)


def show_labels(scenes: Sequence[Mapping[str, Labelled]]) -> None:
    """Table of the labels of the kinds that have errors: means of the scenes, by the exact ones."""
    rows = []
    for kind in ("ours-4", "ours-1", "raster"):
        figures = [_label_figures(of[kind].disparity, of["exact"].disparity) for of in scenes]
        rows.append([kind, *(f"{value:.3f}" for value in np.mean(figures, axis=0))])
    columns = "labels", "labelled, %", "mean absolute error, px", "over 1 px, %", "over 3 px, %"
    print_table("Labels", [*columns, "on pixels not seen by both, % of all labels"], rows)


def _label_figures(disparity: NDArray, exact: NDArray) -> list[float]:
    """The columns of :func:`show_labels` of one scene; ``exact`` is NaN where not both see."""
    labelled, seen = np.isfinite(disparity), np.isfinite(exact)
    error = np.abs(disparity - exact)[labelled & seen]
    return [
        100.0 * error.size / seen.sum(),
        error.mean(),
        *(100.0 * (error > limit).mean() for limit in (1.0, 3.0)),
        100.0 * (labelled & ~seen).sum() / labelled.sum(),
    ]


def run(given: argparse.Namespace, scenes: Sequence[Mapping[str, Labelled]]) -> dict[str, Any]:
    """Train on scenes and judge what is not kept already; returns all figures."""
    folder: Path = given.folder
    model = SavedNetwork("stereonet", RANGE)
    unseen = [unseen_pair(k, given.side, folder) for k in range(given.unseen)]
    print(f"{len(scenes)} training scenes, {len(unseen)} unseen ones", flush=True)
    kinds = [kind for kind in KINDS if kind in given.kind]
    ready = {kind: [Ready.of(of[kind], model) for of in scenes] for kind in kinds}
    steps = given.steps
    if steps is None:
        seconds = train(start(model, 0, given.initial), ready[kinds[0]], 100, 0, TIMED_STEPS)
        steps = max(round(60 * given.minutes / seconds / 10) * 10, 10)
        print(f"{seconds:.2f} s a step: {steps} steps of {BATCH} windows each")
    runs: dict[str, list[list[dict[str, float]]]] = {kind: [] for kind in kinds}
    initial = given.initial.name if given.initial else "random"
    for seed in range(given.seeds):
        for kind in kinds:
            data = digest_of([of[kind] for of in scenes])
            name = f"{kind}-{seed}-{steps}-{initial}-{given.side}-{len(unseen)}-{data}.json"
            kept = folder / "runs" / name
            if not kept.is_file():
                begin = time.monotonic()
                network = start(model, seed, given.initial)
                train(network, ready[kind], steps, seed)
                write_json(kept, [judge(network, pair, model) for pair in unseen])
                print(f"  seed {seed}, {kind}: {time.monotonic() - begin:.0f} s", flush=True)
            runs[kind].append(json.loads(kept.read_text()))
            epe = np.mean([scene["epe_px"] for scene in runs[kind][-1]])
            print(f"seed {seed}, {kind}: EPE {epe:.3f} px", flush=True)
    return {
        "steps": steps,
        "batch": BATCH,
        "window_px": list(WINDOW_PX),
        "initial_weights": initial,
        "seeds": given.seeds,
        "training_scenes": given.scenes,
        "unseen_scenes": given.unseen,
        "side_px": given.side,
        "figures": summary(runs),
        "runs": runs,
    }


def main() -> None:
    """Print tables; ``--json`` and ``--figure`` keep them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="of each training")
    parser.add_argument("--steps", type=int, help="of each training, in the place of --minutes")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--scenes", type=int, default=6, help="to train on")
    parser.add_argument("--unseen", type=int, default=6, help="scenes that judge")
    parser.add_argument("--side", type=int, default=1000, help="of each image, px")
    parser.add_argument("--labels", action="store_true", help="what they are like, no training")
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--initial", type=Path, help="weights to start from; default: random")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=Path("results/label_quality"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    scenes = [training_pairs(k, given.side, given.folder) for k in range(given.scenes)]
    show_labels(scenes)
    if given.labels:
        return
    record = run(given, scenes)
    show(record["figures"])
    if given.json:
        write_json(given.json, record)
    if given.figure:
        draw_figure(record["figures"], given.figure)


if __name__ == "__main__":
    main()
