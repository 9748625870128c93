"""What SIFT says of labels on drawn scenes with crowns: against the truth, and of planted biases.

Each scene is aligned, rectified and labelled once. Its matches are held against the exact disparity
at the key points (what SIFT itself is off), and against the labels, with and without a bias along
the rows. Scenes are drawn anew from the cells of each by bootstrap, which adds its scatter to that
of the scene: what is named where nothing is planted is no less than in scenes. See README.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from synthetic_pairs import VIEWS
from wooded_scenes import Draw, Scene

from stereotruth.alignment.adjustment import epipolar_model
from stereotruth.alignment.label_uncertainty import LabelUncertainty
from stereotruth.alignment.refine import refine
from stereotruth.config.labels import LabelSettings, Limits
from stereotruth.dataset.label_doubts import PARALLAX, Bias, SceneMatches, doubts
from stereotruth.dataset.scene_stores import SceneFiles, SceneStores, open_stores
from stereotruth.dataset.sift_matches import TileMatches, match_tile
from stereotruth.dataset.tile_files import LabelsKnown
from stereotruth.dataset.windows import cell_step, choose_windows, scan_scene
from stereotruth.disparity.project import project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.epipolar.image_reader import open_pair
from stereotruth.epipolar.rectify import rectify
from stereotruth.products.files import atomic_folder
from stereotruth.simulate.truth import truth_at

SIDE_PX = 1400
TILE_PX = 400  # small scenes hold few larger ones that are whole
MIN_LABELLED = 0.3
PLANTED_PX = 0.15
RESAMPLED = 100
CONDITIONS = {
    "open": {"ground_m2": None, "density": 2.0},
    "open, noise, gain": {"ground_m2": None, "density": 2.0, "noise": True, "gain": True},
    "crowns, 4/m²": {"density": 4.0},
    "crowns, 1/m²": {"density": 1.0},
    "crowns, 0.25/m²": {"density": 0.25},
    "dense crowns": {"ground_m2": 60.0, "roofs": "flat"},
    "rows, shadows, cars": {
        "ground_m2": 120.0, "arrangement": "rows", "density": 1.0, "later": True, "vehicles": 10.0,
        "relief_m": 30.0,
    },
    "forest, bare": {
        "ground_m2": 60.0, "arrangement": "forest", "density": 1.0, "bare": "right",
    },
}  # fmt: skip

Place = tuple[int, int, int]  # of a tile: row, column, offset of the right image, px


def labelled(scene: Scene, gcps: int, refined: bool) -> SceneStores:
    """The scene's stores, made once; labelled by its points."""
    name = f"{scene.draw.key()}-{gcps}-{'refined' if refined else 'gcps'}"
    folder = scene.folder / "labels" / name
    if not folder.is_dir():
        alignment = scene.align(gcps)
        if refined:
            alignment, _ = refine(alignment, *scene.images, scene.stores)
        model = epipolar_model(alignment)
        with atomic_folder(folder) as made:
            stores = [made / f"{view}.zarr" for view in VIEWS]
            attrs = LabelUncertainty.of(alignment, model).to_attrs()
            with open_pair(*scene.images) as opened:
                rectify(
                    *opened, model, made / "epipolar.json", *stores, workers=1, left_attrs=attrs
                )
            inputs = SceneInputs.of(*stores, scene.stores, LabelSettings())
            inputs = inputs.with_surface(made)
            project_scene(inputs, made / "disparity.zarr", code="", workers=1)
    files = [folder / f"{kind}.zarr" for kind in ("disparity", *VIEWS)]
    return open_stores(SceneFiles("Wooded", *files))


def tiles(stores: SceneStores) -> Iterator[tuple[TileMatches, LabelsKnown, Place]]:
    """Matches of each labelled tile, what is known of its labels; its row, column and offset."""
    cells = scan_scene(stores, cell_step(TILE_PX, TILE_PX), 1)
    windows, _, _ = choose_windows(cells, TILE_PX, TILE_PX, MIN_LABELLED, "tile")
    for window in windows:
        if not window.labelled:
            continue
        rows = slice(window.row0, window.row0 + TILE_PX)
        here = rows, slice(window.col0, window.col0 + TILE_PX)
        start = window.col0 - window.offset
        disparity = stores.disparity[here].astype(np.float64) - window.offset
        known = LabelsKnown.of(stores, here, disparity, 0.02)
        right = stores.right[rows, start : start + TILE_PX]
        found = match_tile(stores.left[here], right, disparity, known.surface_class)
        yield found, known, (window.row0, window.col0, window.offset)


def exact(scene: Scene, stores: SceneStores, found: TileMatches, place: Place) -> TileMatches:
    """The matches with the exact disparity at each key point in place of the label."""
    row0, col0, offset = place
    x, y = found.x + col0, found.y + row0
    truth = truth_at(scene.city, scene.spec, *stores.model.epipolar_to_left(x, y))
    x_right, _ = stores.model.right_to_epipolar(truth["right_col"], truth["right_row"])
    return replace(found, label=x - x_right - offset)


def resampled(of: SceneMatches, rng: np.random.Generator) -> SceneMatches:
    """A scene whose cells are drawn from those of another, with replacement."""
    columns = np.hstack(of.parts)
    cells = np.unique(columns[-1])
    parts = []
    for number, cell in enumerate(rng.choice(cells, cells.size)):
        part = columns[:, columns[-1] == cell].copy()
        part[-1] = number
        parts.append(part)
    return SceneMatches(parts)


def shifted(of: SceneMatches, planted: float) -> SceneMatches:
    """The same matches with labels that are off by ``−planted`` px."""
    return SceneMatches([part + planted * np.eye(len(part))[0][:, None] for part in of.parts])


def named(of: SceneMatches) -> bool:
    """Whether images and labels are said to disagree, rows left out."""
    found = doubts(of.biases, Limits().min_agreement)
    return any(doubt.bias.surface != PARALLAX for doubt in found)


def said(bias: Bias | None) -> str:
    if bias is None:
        return "–"
    return f"{bias.value:+.3f} ± {bias.error:.3f} ({bias.matches})"


def examine(name: str, scene: Scene, gcps: int, refined: bool) -> NDArray[np.float64]:
    """Print a scene's line; shares named without a bias and with one."""
    stores = labelled(scene, gcps, refined)
    of_labels, of_truth = SceneMatches(), SceneMatches()
    for found, known, place in tiles(stores):
        at = known.surface[found.pixel], known.sigma[found.pixel], *place[:2]
        of_labels.add(found, *at)
        of_truth.add(exact(scene, stores, found, place), *at)
    rng = np.random.default_rng(scene.draw.seed)
    draws = [resampled(of_labels, rng) for _ in range(RESAMPLED)]
    shares = [
        np.mean([named(shifted(draw, planted)) for draw in draws])
        for planted in (0.0, PLANTED_PX, -PLANTED_PX)
    ]
    labels, sift = ({b.surface: b for b in of.biases} for of in (of_labels, of_truth))
    surfaces = ("open ground", "roofs", "crowns")
    stated = labels["open ground"].stated if "open ground" in labels else float("nan")
    print(
        f"| {name} | {scene.draw.seed} | {' | '.join(said(sift.get(s)) for s in surfaces)} | "
        f"{' | '.join(said(labels.get(s)) for s in (*surfaces[:2], PARALLAX))} | {stated:.3f} | "
        f"{100 * shares[0]:.0f} | {100 * shares[1]:.0f}, {100 * shares[2]:.0f} |",
        flush=True,
    )
    return np.array(shares)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--conditions", nargs="+", choices=CONDITIONS, default=list(CONDITIONS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[301])
    parser.add_argument("--gcps", type=int, default=15)
    parser.add_argument("--unrefined", action="store_true")
    parser.add_argument("--folder", type=Path, default=Path("results/doubts"))
    options = parser.parse_args()
    print(f"Bias ± standard error (matches), px; named of {RESAMPLED} resampled scenes, %:")
    print("| scene | seed | SIFT less truth: ground | roofs | crowns | less labels: ground | roofs "
          f"| y-parallax | stated | named, none planted | ±{PLANTED_PX} px |")  # fmt: skip
    shares = [
        examine(name, Scene(Draw(seed=seed, side_px=SIDE_PX, **CONDITIONS[name]), options.folder),
                options.gcps, not options.unrefined)
        for name in options.conditions
        for seed in options.seeds
    ]  # fmt: skip
    none, *planted = 100 * np.mean(shares, axis=0)
    print(f"Named where nothing is planted {none:.1f} %, where a bias is {np.mean(planted):.1f} %")


if __name__ == "__main__":
    main()
