"""Labels by density of the points, against exact truth. See README.md beside this file.

A block of a synthetic pair is labelled with its points thinned to several densities, in either
view, under one condition or several; fresh cities are drawn and made once. Labels are not written.
"""

from __future__ import annotations

import argparse
import json
import logging
import time
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from figures import (
    DISTANCES_PX,
    NEAR_PX,
    SURFACES,
    Figures,
    composition,
    percent,
    print_table,
    shares,
    shown,
    spread,
)
from synthetic_pairs import CONDITIONS, Block, Pair, fresh_pair, made_pair

from stereotruth.epipolar.model import EpipolarModel
from stereotruth.pages.pictures import SERIES

TARGETS = {  # points/m²: visible labelled at least, hidden, off by more than 1 px at most, %
    4: (95, 0.2, 0.03),
    2: (94, 0.2, 0.03),
    1: (92.5, 0.2, 0.03),
    0.5: (90.5, 0.2, 0.03),
    0.25: (88, 0.3, 0.05),
}
RECIPES = ("surface", "paper")
TABLES = ("errors", "edges")
Run = tuple[str, str, str]  # scene, condition, recipe


def block_of(pair: Pair, condition: str, options: argparse.Namespace) -> Block:
    """The window of a pair that is asked for; without one, that in the middle."""
    rectified = pair.rectified(condition, options.folder / "rectified")
    shape = EpipolarModel.load(rectified / "epipolar.json").shape
    size = [min(options.size or end, end) for end in shape]
    first = options.first or [(end - side) // 2 for end, side in zip(shape, size)]
    window = (slice(at, min(at + side, end)) for at, side, end in zip(first, size, shape))
    return Block(pair, rectified, *window, options.view)


def looks(block: Block) -> str:
    """What a block shows, in words."""
    visible, crowns, near = composition(block)
    return (
        f"{block.density:.2f} first returns per m²; of the visible pixels {crowns:.0f} % are "
        f"crowns, {near:.0f} % within {NEAR_PX:g} px of an edge; {visible:.2f} Mpx"
    )


def labelled(options: argparse.Namespace) -> dict[Run, dict[float, Figures]]:
    """Labels of every scene under every condition by every recipe, by density, and their truth."""
    found: dict[Run, dict[float, Figures]] = defaultdict(dict)
    fresh = [fresh_pair(number + 1, options.folder) for number in range(options.fresh)]
    for pair in [*(made_pair(scene, options.results) for scene in options.scenes), *fresh]:
        for condition in options.conditions:
            block = block_of(pair, condition, options)
            print(f"{pair.name}, {condition}: {looks(block)}", flush=True)
            for recipe in options.recipe:
                for target in options.densities:
                    job = block.job(target, recipe)
                    block.compile(job)
                    start = time.process_time()
                    layers = block.labels(job)
                    took = (time.process_time() - start) / block.megapixels
                    figures = Figures.of(block, layers)
                    found[pair.name, condition, recipe][target] = figures
                    said = f"{shown(shares(figures.counts))}, {took:.1f} s/Mpx"
                    print(f"  {recipe}, {target:g} points/m²: {said}", flush=True)
    return found


def print_shares(found: dict[Run, dict[float, Figures]], densities: Sequence[float]) -> None:
    """Visible / hidden labelled / off, by scene and density, and over the scenes."""
    columns = ["pair", "condition", "recipe", *(f"{d:g}" for d in densities)]
    rows = []
    for run, by in found.items():
        rows.append([*run, *(shown(shares(by[d].counts)) for d in densities)])
    for condition, recipe in dict.fromkeys(run[1:] for run in found):
        of = [by for run, by in found.items() if run[1:] == (condition, recipe)]
        if len(of) < 2:
            continue
        both = [spread([shares(by[d].counts) for by in of]) for d in densities]
        for name, cells in zip(("median", "range"), zip(*both)):
            rows.append([f"{name} of {len(of)}", condition, recipe, *cells])
    rows.append(["asked for", "", "", *(shown(TARGETS.get(d, ())) for d in densities)])
    title = "Visible labelled / hidden labelled / off by more than 1 px, %, by points/m²"
    print_table(title, columns, rows)
    rows = [
        [*run, *(shown([by[d].hidden_in_both]) for d in densities)] for run, by in found.items()
    ]
    print_table("Hidden labelled, % of those that the LiDAR's world hides, too", columns, rows)


def print_errors(found: dict[Run, dict[float, Figures]]) -> None:
    """Errors and coverage of sigma by kind of label."""
    rows = []
    for run, by in found.items():
        for target, figures in by.items():
            for kind, f in figures.errors.items():
                cover = f"{f['< 1 sigma']:.1f} / {f['< 2 sigma']:.1f}"
                sizes = f"{f['mean absolute']:.4f}", f"{f['median']:+.4f}"
                rows.append([*run, f"{target:g}", kind, f"{f['share']:.1f}", *sizes, cover])
    columns = ["pair", "condition", "recipe", "points/m²", "labels", "of visible, %"]
    columns += ["mean abs, px", "median, px", "< 1 / 2 sigma, %"]
    print_table("Errors of labels on visible pixels, by kind", columns, rows)


def print_edges(found: dict[Run, dict[float, Figures]]) -> None:
    """Shares by distance from the nearest edge and by surface, all pairs together."""
    sums: dict[tuple, dict[tuple[str, str], list]] = defaultdict(lambda: defaultdict(list))
    for (_, condition, recipe), by in found.items():
        for target, figures in by.items():
            for place, counts in figures.rings.items():
                sums[condition, recipe, target][place].append(counts)
    surfaces = list(dict.fromkeys(("all", *SURFACES.values())))
    for (condition, recipe, target), places in sums.items():
        total = {place: sum(counts) for place, counts in places.items()}
        visible = sum(total["all", name][0] for name in rings(total)[: len(DISTANCES_PX)])
        rows = [
            [name, f"{percent(total['all', name][0], visible):.1f}"]
            + [shown(shares(total[of, name])) for of in surfaces]
            for name in rings(total)
        ]
        title = f"By distance from the nearest edge: {condition}, {recipe}, {target:g} points/m²"
        columns = ["px", "of visible, %", *surfaces]
        print_table(f"{title} (visible / hidden / off, %)", columns, rows)


def rings(places: dict[tuple[str, str], object]) -> list[str]:
    """Names of the distances."""
    return list(dict.fromkeys(name for _, name in places))


def draw(path: Path, found: dict[Run, dict[float, Figures]]) -> None:
    """Shares of visible and of hidden pixels with a label by density, for each run."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    titles = ("visible pixels with a label, %", "hidden pixels with a label, %")
    varied = [k for k in range(3) if len({run[k] for run in found}) > 1] or [2]
    for number, (panel, title) in enumerate(zip(panels, titles)):
        for (run, by), colour, shape in zip(found.items(), SERIES, "os^Dv<>p"):
            label = ", ".join(run[k] for k in varied)
            values = [shares(figures.counts)[number] for figures in by.values()]
            panel.plot(list(by), values, f"{shape}-", color=colour, ms=4, label=label)
        panel.set_xscale("log", base=2)
        densities = sorted({d for by in found.values() for d in by})
        panel.set_xticks(densities, [f"{d:.2g}" for d in densities])
        panel.set(title=title, xlabel="LiDAR points per m²", ylim=(0, None))
        panel.grid(alpha=0.3)
    panels[0].legend(frameon=False)
    figure.suptitle(", ".join(dict.fromkeys(run[0] for run in found)), fontsize="medium")
    figure.savefig(path, dpi=110)


def as_json(found: dict[Run, dict[float, Figures]]) -> list[dict]:
    """All figures."""
    names = ("visible labelled, %", "hidden labelled, %", "off, %")
    return [
        {"pair": run[0], "condition": run[1], "recipe": run[2], "points/m2": target}
        | dict(zip(names, shares(figures.counts)))
        | {"hidden in the LiDAR's world, too, labelled, %": figures.hidden_in_both}
        | {"errors": figures.errors}
        for run, by in found.items()
        for target, figures in by.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scenes", nargs="*", help="whose results/rectify and ingest are made")
    parser.add_argument("--fresh", type=int, default=0, metavar="N", help="and N cities drawn anew")
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument(
        "--folder", type=Path, default=Path("results/density"), help="of what is made here, once"
    )
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=["plain"])
    parser.add_argument("--densities", type=float, nargs="+", default=list(TARGETS))
    parser.add_argument("--recipe", nargs="+", choices=RECIPES, default=["surface"])
    parser.add_argument("--first", type=int, nargs=2, help="row, column; default: in the middle")
    parser.add_argument("--size", type=int, default=1024, help="px; 0: to the end of the grid")
    parser.add_argument("--view", choices=("left", "right"), default="left")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=[])
    parser.add_argument("--figure", type=Path, help="PNG of the shares by density")
    parser.add_argument("--json", type=Path, help="file of all figures")
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    found = labelled(options)
    print_shares(found, options.densities)
    for name, table in zip(TABLES, (print_errors, print_edges)):
        if name in options.tables:
            table(found)
    if options.figure:
        draw(options.figure, found)
    if options.json:
        options.json.write_text(json.dumps(as_json(found), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
