"""More cities of accuracy.py, which no workflow makes: a wooded suburb, a park, twins of places.

They are drawn by seeds that nothing is tuned on, and made, aligned, refined and labelled once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from synthetic_pairs import label_by
from twin_places import Place, TwinDraw
from wooded_scenes import MIXED, Draw, Scene

from stereotruth.alignment.aligned_pair import Alignment
from stereotruth.alignment.refine import refine
from stereotruth.config.labels import LabelSettings
from stereotruth.evaluation.epipolar_truth import write_grid_truth
from stereotruth.evaluation.labels_against_truth import SceneComparison, compare_scene
from stereotruth.numerics.error_sums import ErrorSum
from stereotruth.products.files import atomic_folder
from stereotruth.products.provenance import source_digest

FOLDER = Path("results/accuracy/drawn")
DENSITIES = (4.0, 1.0)  # points/m²
GCPS = 15
TWIN_SEED = 27
NAMED = {
    "suburb": Draw(
        61803, zones="suburb", ground_m2=110.0, arrangement="single", brightness=0.4,
        ground_look=(1.5, 0.5), buildings=0.9, relief_m=15.0, vehicles=4.0, side_px=1400, **MIXED,
    ),
    "park": Draw(
        41421, zones="park", ground_m2=70.0, arrangement="forest", brightness=0.5,
        ground_look=(1.4, 0.4), buildings=0.8, relief_m=25.0, side_px=1400, **MIXED,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Compared:
    """A drawn city against its truth.

    ``labels``: of the whole grid. ``alignments``: errors of disparity and y-parallax at exact
    places, by the control points alone and as used.
    """

    name: str
    labels: SceneComparison
    alignments: dict[str, tuple[ErrorSum, ErrorSum]]


def compare_drawn(name: str, density: float, settings: LabelSettings, workers: int) -> Compared:
    """Labels and alignment of a city of NAMED at a density of its LiDAR."""
    scene = Scene(replace(NAMED[name], density=density), FOLDER)
    return _compared(
        scene, f"{name}-{density:g}", f"{name}, {density:g} points/m²", settings, workers
    )


def compare_twin(place: Place, density: float, settings: LabelSettings, workers: int) -> Compared:
    """The same of the twin of a place."""
    scene = Scene(TwinDraw(place, TWIN_SEED, density), FOLDER)
    title = f"twin of {place.file.stem}, {density:g} points/m²"
    return _compared(scene, f"{place.key}-{density:g}", title, settings, workers)


def _compared(
    scene: Scene, key: str, title: str, settings: LabelSettings, workers: int
) -> Compared:
    """Labels and alignment of a scene, made once in a folder that has its ``key``."""
    alone = scene.align(GCPS)
    code = source_digest("alignment.refine", "disparity.project")[:8]
    made = FOLDER / f"{key}-{code}"
    if not made.is_dir():
        with atomic_folder(made) as scratch:
            refined, _ = refine(alone, *scene.images, scene.stores, provenance={})
            label_by(refined, scene.images, scene.stores, scratch, settings, workers=workers)
            write_grid_truth(scene.city, scene.spec, scratch / "epipolar.json",
                             scratch / "truth.zarr", workers=workers)  # fmt: skip
    used = Alignment.load(made / "alignment.json")
    labels = compare_scene(
        made / "disparity.zarr", made / "truth.zarr", None, scene=title, workers=workers
    )
    alignments = {}
    for word, alignment in (("GCPs", alone), ("as used", used)):
        errors = scene.errors(alignment)
        alignments[word] = ErrorSum(), ErrorSum()
        for total, values in zip(alignments[word], (errors.disparity, errors.parallax)):
            total.add(values)
    return Compared(title, labels, alignments)
