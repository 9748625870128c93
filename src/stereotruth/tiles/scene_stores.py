"""What export reads of a scene: opened stores, epipolar model, meaning of the status values."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import zarr

from ..core.errors import InputError
from ..core.products.grids import require_complete
from ..core.products.provenance import digest, file_sha256
from ..epipolar.model import COLOURS, EpipolarModel
from .label_doubts import ALIGNMENT, LIDAR, STRIPS, ToldDoubt
from .orientation import sensor_record
from .sure_labels import Labels, tile_flags, tile_labels


class SceneFiles(NamedTuple):
    """What export reads of one scene: its id and stores, and where it came from the alignment.

    ``disparity_of_right``: the store of the right view's labels, if they are wanted. ``acquired``:
    days (ISO) of the left and right image by the images sheet, empty where their deliveries tell.
    """

    scene: str
    disparity: Path
    left: Path
    right: Path
    alignment: Path | None = None
    disparity_of_right: Path | None = None
    acquired: tuple[str, str] = ("", "")


@dataclass(frozen=True, eq=False)
class SceneStores:
    """Opened stores of a scene, its epipolar model, and the meaning of the status values.

    ``doubts``: warnings of the alignment, a refinement that was refused among them; ``remark``: why
    labels are less sure than the scatter of their tie points, or empty.
    ``disparity``, ``status``, and these of the right view (``of_right``), as the tiles have them.
    ``acquired``: days (ISO) of the left and right image, empty where they are not known. ``light``:
    whether the images share it, and what decided that (:func:`..sensor.site_pairs.pair_light`).
    """

    scene: str
    left: zarr.Array
    right: zarr.Array
    colours: tuple[tuple[zarr.Array, ...], tuple[zarr.Array, ...]] | None  # of left, right
    disparity: Labels
    status: Labels
    height: zarr.Array
    of_right: Mapping[str, Labels] | None
    surface_class: zarr.Array | None
    uncertainty: zarr.Array | None
    lidar_date: zarr.Array | None
    acquired: tuple[str, str]
    gcp_rms: float | None
    model: EpipolarModel
    sensors: Mapping[str, Mapping[str, Any]]
    flags: Mapping[int, str]
    inputs: Mapping[str, str]
    points_per_px: float | None
    points_per_m2: float | None
    lidar: Mapping[str, Any] | None
    light: Mapping[str, Any] | None
    doubts: tuple[str, ...]
    remark: str

    @property
    def told(self) -> list[ToldDoubt]:
        """What alignment and LiDAR say of what the labels are worth."""
        lidar = self.lidar or {}
        found = [ToldDoubt(ALIGNMENT, text) for text in self.doubts]
        found += [ToldDoubt(ALIGNMENT, self.remark, True)] * bool(self.remark)
        found += [ToldDoubt(LIDAR, text) for text in lidar.get("doubts", ())]
        if strips := lidar.get("strips"):
            found += [ToldDoubt(STRIPS, strips["sentence"], True)] * bool(strips["sentence"])
        return found


def open_stores(item: SceneFiles, max_uncertainty_px: float = math.inf) -> SceneStores:
    """Open a scene's stores; InputError if their grids do not fit together.

    ``max_uncertainty_px``: of the labels of rough surfaces that the tiles have.
    """
    disparity = require_complete(item.disparity)
    left, right = require_complete(item.left), require_complete(item.right)
    model = EpipolarModel.from_dict(disparity.attrs["epipolar"])
    for path, group, name in (
        (item.disparity, disparity, "disparity"),
        (item.left, left, "image"),
        (item.right, right, "image"),
    ):
        if group[name].shape != tuple(model.shape):
            raise InputError(
                f"grid of {group[name].shape} px, epipolar model of {tuple(model.shape)} "
                f"(scene {item.scene})",
                file=path,
                remedy="run rectify and project of this scene again",
            )
    status = disparity["status"]
    meanings = status.attrs["flag_meanings"]
    names = meanings.split() if isinstance(meanings, str) else list(meanings)
    flags = dict(zip((int(v) for v in status.attrs["flag_values"]), names))
    sure = tile_labels(disparity, flags, max_uncertainty_px)
    inputs = {
        f"{item.scene}/{name}": digest(dict(group.attrs.get("provenance", {})))
        for name, group in (("left", left), ("right", right), ("disparity", disparity))
    }
    of_right = None
    if item.disparity_of_right is not None:
        store = require_complete(item.disparity_of_right)
        of_right = tile_labels(store, flags, max_uncertainty_px)
        found = digest(dict(store.attrs.get("provenance", {})))
        inputs[f"{item.scene}/disparity_of_right"] = found
    if item.alignment is not None:
        inputs[f"{item.scene}/alignment"] = file_sha256(item.alignment)
    gcp_rms, doubts, remark = (None, (), "") if item.alignment is None else _told_by(item.alignment)
    return SceneStores(
        scene=item.scene,
        left=left["image"],
        right=right["image"],
        colours=_colours(left, right),
        disparity=sure["disparity"],
        status=sure["status"],
        height=disparity["height"],
        of_right=of_right,
        surface_class=disparity.get("surface_class"),
        uncertainty=disparity.get("uncertainty"),
        lidar_date=disparity.get("lidar_date"),
        acquired=tuple(
            day or view.attrs.get("acquired") or ""
            for day, view in zip(item.acquired, (left, right))
        ),
        gcp_rms=gcp_rms,
        model=model,
        sensors={"left": sensor_record(model.left), "right": sensor_record(model.right)},
        flags=tile_flags(flags),
        inputs=inputs,
        points_per_px=disparity.attrs.get("points_per_px"),
        points_per_m2=disparity.attrs.get("points_per_m2"),
        lidar=disparity.attrs.get("lidar"),
        light=disparity.attrs.get("light"),
        doubts=doubts,
        remark=remark,
    )


def _colours(*views: zarr.Group) -> tuple[tuple[zarr.Array, ...], ...] | None:
    """Red, green and blue of both images; None where they are grey."""
    if not all(name in view for view in views for name in COLOURS):
        return None
    return tuple(tuple(view[name] for name in COLOURS) for view in views)


def _told_by(alignment: Path) -> tuple[float | None, tuple[str, ...], str]:
    """The larger of both views' residuals of the GCPs, px of the images (None without GCPs).

    And the warnings of the alignment, and the remark of its refinement.
    """
    record = json.loads(Path(alignment).read_text(encoding="utf-8"))
    found = [record[view]["rms"]["after"] for view in ("left", "right")]
    rms = max((v for v in found if v is not None), default=None)
    return rms, tuple(record["warnings"]), record.get("refinement", {}).get("remark", "")
