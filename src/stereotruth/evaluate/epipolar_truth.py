"""The exact truth of a synthetic scene on its left epipolar grid.

A ray goes through the centre of each epipolar pixel: the epipolar model says where in the raw left
image that is, the simulator's rigorous camera and surfaces what is seen there and where in the raw
right image it appears, and the epipolar model brings that place to the grid. No sensor model of
the pipeline takes part, so an error of the alignment is an error of the label, as it is for a
matcher that is trained on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereocities.cities import CitySpec, SceneSpec
from stereocities.render import prepare
from stereocities.truth import CHANGES, SURFACES, truth_at
from stereocities.truth import LAYERS as OF_IMAGES

from ..core.errors import InputError
from ..core.job import progress
from ..core.products.grids import Layer, atomic_store, blocks, create_grid
from ..epipolar.intersection import coarse_place
from ..epipolar.model import EpipolarModel

CHUNK = 256
SHARD = 1024
BUILT = [SURFACES.split().index(kind) for kind in ("roof", "wall")]
EDGE_PX = 1.0  # px of disparity between neighbours: more is a height edge
FLAGS = {"surface": SURFACES, "changed": CHANGES, "edge": "none building other"}
LAYERS = {
    "disparity": ("float32", "px", "exact disparity x_left - x_right of what the pixel shows"),
    "y_parallax": ("float32", "px", "y_right - y_left of what the pixel shows"),
    "visible": ("uint8", "1", "1 where both images show the surface point"),
    "hidden": ("uint8", "1", "1 where the surface point lies in the right frame, behind something"),
    **{name: OF_IMAGES[name] for name in ("changed", "changed_right", "covered", "surface")},
    "edge": (
        "uint8",
        "1",
        f"height edge: the disparity of a pixel within 1 px differs by more than {EDGE_PX:g} px; "
        "building: of the two pixels one shows a roof or wall",
    ),
}


def height_edges(disparity: NDArray[np.float64], built: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Layer ``edge`` of an array [h, w] of disparities (px, NaN unknown).

    ``built``: pixels that show a roof or wall. The outermost ring lacks neighbours.
    """
    other, building_edge = np.zeros(built.shape, np.bool_), np.zeros(built.shape, np.bool_)
    for here, there in (
        (np.s_[:, 1:], np.s_[:, :-1]),
        (np.s_[1:], np.s_[:-1]),
        (np.s_[1:, 1:], np.s_[:-1, :-1]),
        (np.s_[1:, :-1], np.s_[:-1, 1:]),
    ):
        with np.errstate(invalid="ignore"):
            step = np.abs(disparity[here] - disparity[there]) > EDGE_PX
        of_building = step & (built[here] | built[there])
        for side in (here, there):
            other[side] |= step
            building_edge[side] |= of_building
    return np.where(building_edge, 1, np.where(other, 2, 0)).astype(np.uint8)


def truth_window(
    model: EpipolarModel,
    city: CitySpec,
    scene: SceneSpec,
    rows: slice,
    cols: slice,
    view: str = "left",
) -> dict[str, NDArray]:
    """The layers of LAYERS in a window [rows, cols] of the left epipolar grid.

    With the ``view`` "right", the window is of the right grid; ``visible`` and ``hidden`` tell of
    the left image then, signs are the same.
    """
    y, x = np.mgrid[rows.start - 1 : rows.stop + 1, cols.start - 1 : cols.stop + 1].astype(float)
    to_image, to_grid = (
        (model.epipolar_to_left, model.right_to_epipolar)
        if view == "left"
        else (model.epipolar_to_right, model.left_to_epipolar)
    )
    found = truth_at(city, scene, *to_image(x, y), view)
    x_there, y_there = to_grid(found["right_col"], found["right_row"])
    sign = 1.0 if view == "left" else -1.0
    disparity, surface = sign * (x - x_there), found["surface"]
    layers = {
        "disparity": disparity.astype(np.float32),
        "y_parallax": (sign * (y_there - y)).astype(np.float32),
        "visible": found["visible_right"],
        "hidden": found["hidden_right"],
        **{name: found[name] for name in ("changed", "changed_right", "covered", "surface")},
        "edge": height_edges(disparity, np.isin(surface, BUILT)),
    }
    return {name: values[1:-1, 1:-1] for name, values in layers.items()}


def write_grid_truth(
    city: CitySpec,
    scene: SceneSpec,
    epipolar_json: str | Path,
    out_zarr: str | Path,
    *,
    workers: int = 1,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write the layers of LAYERS, [y, x] on the left epipolar grid, in blocks.

    Raises InputError if the epipolar model is missing or of images of another size.
    """
    model = EpipolarModel.load(epipolar_json)
    ready = prepare(city, scene)
    for view, size in (("left", model.left_size), ("right", model.right_size)):
        camera = getattr(ready, view)
        if (camera.cols, camera.rows) != size:
            raise InputError(
                f"epipolar model of a {view} image of {size[0]} x {size[1]} px, the scene's has "
                f"{camera.cols} x {camera.rows}",
                file=epipolar_json,
                remedy="make the synthetic city again, then run the workflow",
            )
    layers = {}
    for name, (dtype, units, long_name) in LAYERS.items():
        attrs: dict[str, Any] = {"units": units, "long_name": long_name}
        if name in FLAGS:
            attrs["flag_values"] = list(range(len(FLAGS[name].split())))
            attrs["flag_meanings"] = FLAGS[name]
        if dtype == "float32":
            attrs["nodata"] = "NaN"
        layers[name] = Layer(dtype, np.nan if dtype == "float32" else 0, attrs)
    attrs = {
        "kind": "truth",
        "scene": scene.name,
        "epipolar": model.to_dict(),
        **coarse_place(model),
        "provenance": dict(provenance or {}),
    }
    with atomic_store(out_zarr) as scratch, ThreadPoolExecutor(workers) as pool:
        arrays = create_grid(scratch, model.shape, layers, chunk=CHUNK, shard=SHARD, attrs=attrs)

        def write(window: tuple[slice, slice]) -> None:
            for name, values in truth_window(model, city, scene, *window).items():
                arrays[name][window] = values

        windows = blocks(model.shape, SHARD)
        for _ in progress(pool.map(write, windows), len(windows), f"{scene.name}: truth"):
            pass
