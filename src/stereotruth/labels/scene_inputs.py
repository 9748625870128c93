"""What the labels of a scene are made of; how much of its LiDAR was read, and where what both
images show has none."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..align.alignment import Alignment
from ..align.label_uncertainty import LabelUncertainty, with_strips
from ..core.config.configuration import LabelSettings
from ..core.numerics.geometry import corners_of_hull
from ..core.products.grids import require_complete
from ..core.products.provenance import digest
from ..core.status import Status, statuses_of
from ..core.tables import acquisition_time
from ..epipolar.model import EpipolarModel
from ..lidar.lattice import CELL_DEG, LATTICE_DEG, cell_key
from ..lidar.lattice import Footprint as LidarFootprint
from ..lidar.point_statistics import points_per_m2
from ..lidar.point_store import PointStore, open_stores
from ..lidar.strips import StripOffsets
from ..sensor.deliveries import Acquisition, by_sheet
from ..sensor.image_noise import NoiseCurve, pair_noise
from ..sensor.pair_geometry import frame, inside
from ..sensor.rpc import RPC
from ..sensor.site_pairs import PairLight, pair_light
from ..surface.make_surface import make_surface
from ..surface.scale import PART
from ..surface.surface_store import Block, SurfaceStore
from .change_evidence import EVIDENCE_PX
from .change_probability import MEANS_PX
from .change_reasons import REASON_PX
from .crowns import CROWN_REACH_PX
from .pair_window import MaskedImage, PairWindow, read_patch
from .view_geometry import Pair, PixelScale, Rays, seen_from
from .window_points import Footprint, PointWindows, blocks_in_view

log = logging.getLogger("stereotruth")


EDGE = 33  # places along each side of a frame


@dataclass(frozen=True, eq=False)
class SceneInputs:
    """The rectified images and point stores of a scene, and the settings of its labels.

    Plain values, so that it can go to another process; what they stand for is opened when it is
    asked for. ``view``: left, or right for the labels of the right image. ``alignment``: the JSON
    file whose corrections the images were rectified with; without it, it counts as exact.
    ``surface``: the store with the surface of the points; the recipe paper needs none. ``strips``:
    the folder with what the strips of the points are off; without it, they count as exact.
    ``light``: what has decided whether the images share it, None where the settings alone say it.
    """

    left_store: Path
    right_store: Path
    point_stores: tuple[Path, ...]
    settings: LabelSettings
    view: str = "left"
    alignment: Path | None = None
    surface: Path | None = None
    strips: Path | None = None
    light: PairLight | None = None

    @classmethod
    def of(
        cls,
        left_store: str | Path,
        right_store: str | Path,
        point_stores: Sequence[str | Path],
        settings: LabelSettings,
        view: str = "left",
        alignment: str | Path | None = None,
        surface: str | Path | None = None,
        strips: str | Path | None = None,
    ) -> SceneInputs:
        """With absolute paths, since workers of a Dask cluster live in other folders, and the point
        stores in their order by name."""
        left, right = Path(left_store).absolute(), Path(right_store).absolute()
        points = tuple(sorted(Path(path).absolute() for path in point_stores))
        more = (None if p is None else Path(p).absolute() for p in (alignment, surface, strips))
        return cls(left, right, points, settings, view, *more)

    def with_surface(self, folder: str | Path, workers: int = 1) -> SceneInputs:
        """The same with the surface of all its points, which is made in a ``folder`` by the pixel
        of its left image: for a pair that is of no project."""
        if not self.on_surface:
            return self
        names = digest(list(map(str, self.point_stores)))[:12]
        out = Path(folder).absolute() / f"{names}.surface"
        model = EpipolarModel.from_dict(require_complete(self.left_store).attrs["epipolar"])
        make_surface(self.stores, out, cell=Rays.of(model).cell, workers=workers)
        return replace(self, surface=out)

    def in_light(
        self, diachronic: bool | None, cells: Mapping[str, tuple[str, float | None, float | None]]
    ) -> SceneInputs:
        """The same with ``settings.diachronic`` as :func:`.site_pairs.pair_light` decides it: by
        what the scenes sheet says of ``diachronic``, and by date and sun of both images.

        ``cells`` by view: acquired, sun_azimuth and sun_elevation of the images sheet (empty
        and None where it has none), which go before the delivery.
        """
        stores = {"left": self.left_store, "right": self.right_store}
        attrs = {view: require_complete(store).attrs for view, store in stores.items()}
        model = EpipolarModel.from_dict(attrs["left"]["epipolar"])
        taken = [
            _taken(attrs[view], cells[view], getattr(model, view).rpc) for view in ("left", "right")
        ]
        light = pair_light(*taken, Rays.of(model).pixel_m, diachronic, self.settings.diachronic)
        log.info(
            "%s, by the %s", "two lights" if light.diachronic else "one light", light.decided_by
        )
        settings = self.settings.model_copy(update={"diachronic": light.diachronic})
        return replace(self, settings=settings, light=light)

    def __getstate__(self) -> dict[str, Any]:
        return {name: self.__dict__[name] for name in self.__dataclass_fields__}

    @cached_property
    def pair(self) -> Pair:
        """The images with their geometry; its left image is the one that gets labels."""
        return seen_from(self.view, self._pair)

    @cached_property
    def _pair(self) -> Pair:
        """The same, as the images are read."""
        left, right = (require_complete(path) for path in (self.left_store, self.right_store))
        model = EpipolarModel.from_dict(left.attrs["epipolar"])
        uncertainty = LabelUncertainty.none()
        shared_px = 0.0
        if self.alignment is not None:
            alignment = Alignment.read(self.alignment)
            uncertainty = LabelUncertainty.of(alignment, model, self.view)
            shared_px = alignment.shared_px
        if self.lidar_strips is not None:
            how = model, self.view, shared_px
            uncertainty = with_strips(uncertainty, self.lidar_strips, *how)
        images = (
            MaskedImage(group["image"], group["mask"]) if "mask" in group else group["image"]
            for group in (left, right)
        )
        return Pair(tuple(images), model, uncertainty)

    @cached_property
    def lidar_strips(self) -> StripOffsets | None:
        """What the strips of the points are off; None if they count as exact."""
        return None if self.strips is None else StripOffsets.read(self.strips)

    @cached_property
    def edge_margin_px(self) -> float:
        """Distance of a pixel's centre from the edge of its surface below which it has no label:
        that of the settings, or how far the strips of the points are off in plan; a pixel at most,
        beyond which points of the pixels around tell no edge."""
        plan_m = self.lidar_strips.most_in_plan_m if self.lidar_strips else 0.0
        return max(self.settings.edge_margin_px, min(plan_m / self.rays.pixel_m, 1.0))

    @property
    def on_surface(self) -> bool:
        """Whether labels follow from the surface of the points."""
        return self.settings.recipe == "surface"

    @property
    def margin(self) -> int:
        """Pixels around a window whose points have a say in it."""
        if not self.on_surface:
            return 1  # the points' noise is pooled over 3 x 3 pixels
        # what may hide a crown, farther off than the plane and the noise of a pixel's own points
        # reach; and what is uncertain beside a contour
        return max(CROWN_REACH_PX, int(np.ceil(self.scale.spacing_px)) + 1) + 2

    @property
    def image_margin(self) -> int:
        """Pixels around a window whose labels have a say in what its images tell: of a pixel, of
        those around it, and of changes."""
        around = max(EVIDENCE_PX, self.settings.window // 2 + 1)
        return MEANS_PX + around + REASON_PX

    @property
    def has_masks(self) -> bool:
        """Whether a mask hides something of an image."""
        return any(isinstance(image, MaskedImage) for image in self.pair.images)

    @property
    def statuses(self) -> list[Status]:
        """Those that occur."""
        return statuses_of(self.settings.recipe, self.has_masks)

    @cached_property
    def noise(self) -> tuple[NoiseCurve, NoiseCurve]:
        """Of both images of the :attr:`pair`, by brightness."""
        of_images = pair_noise(*self._pair.images, self._pair.model.disparities())
        return of_images if self.view == "left" else of_images[::-1]

    @cached_property
    def rays(self) -> Rays:
        """From the ground to both cameras."""
        return Rays.of(self.pair.model)

    @cached_property
    def stores(self) -> tuple[PointStore, ...]:
        """The points."""
        return open_stores(self.point_stores)

    @cached_property
    def scale(self) -> PixelScale:
        """What a pixel is on the ground and in height."""
        return PixelScale.of(self.ground.scale, self.rays)

    @cached_property
    def points_per_m2(self) -> float:
        """Over the ground that the points cover, as far as the site's images show it."""
        return self.ground.points_per_m2 if self.on_surface else points_per_m2(self.stores)

    @cached_property
    def ground(self) -> SurfaceStore:
        """The surface of the points."""
        return SurfaceStore(self.surface)

    @cached_property
    def windows(self) -> PointWindows:
        """Where the points of windows of the pair's left image are."""
        reach = (0.0, 0.0)
        if self.on_surface:
            scale = self.ground.scale
            reach = tuple(scale.height_reach / PART * side * LATTICE_DEG for side in scale.cell)
        return PointWindows(self.pair.model, self.rays, self.stores, self.margin, reach)

    def surface_blocks(self, rows: slice, cols: slice) -> tuple[Block, ...]:
        """Blocks of the surface that a window shows, or that may hide this."""
        footprint = self.windows.footprint(rows, cols)
        if footprint is None or not self.on_surface:
            return ()
        margin = self.margin
        first = rows.start - margin, cols.start - margin
        shape = rows.stop - rows.start + 2 * margin, cols.stop - cols.start + 2 * margin
        return blocks_in_view(self.ground.blocks(footprint.around), self.pair.model, first, shape)

    def points_window(
        self, rows: slice, cols: slice, footprint: Footprint, around_px: int = 1
    ) -> PairWindow:
        """A window with its margin, and of the right image all that its points can be seen in; both
        hold the square of ``around_px`` (odd) around a label."""
        margin = self.margin
        rows, cols = (slice(edge.start - margin, edge.stop + margin) for edge in (rows, cols))
        x, y, height = (
            grid.reshape(-1)
            for grid in np.meshgrid(
                np.linspace(cols.start - 1.0, cols.stop, 5),
                np.linspace(rows.start - 1.0, rows.stop, 5),
                [footprint.low, footprint.high],
            )
        )
        model, (left, right) = self.pair.model, self.pair.images
        x_right = model.ground_to_epipolar(*model.epipolar_to_ground(x, y, height), height)[2]
        x_right = x_right[np.isfinite(x_right)]
        more = 8  # px, for what is not linear in between
        least, most = (x_right.min(), x_right.max()) if x_right.size else (0.0, 0.0)
        there = slice(int(np.floor(least)) - more, int(np.ceil(most)) + more + 1)
        patches = read_patch(left, rows, cols, around_px), read_patch(right, rows, there, around_px)
        return PairWindow(rows, cols, margin, *patches)


def _taken(
    attrs: Mapping[str, Any], cells: tuple[str, float | None, float | None], rpc: RPC
) -> Acquisition:
    """When and by which sun a rectified image was taken, by its attributes (see
    :func:`.rectify.rectify`) and the cells of the images sheet."""
    time, sun = attrs.get("taken"), attrs.get("sun")
    delivery = Acquisition(
        datetime.fromisoformat(time) if time else None, tuple(sun) if sun else None
    )
    acquired, azimuth, elevation = cells
    by_row = None if azimuth is None or elevation is None else (azimuth, elevation)
    lon_lat = float(rpc.long_off), float(rpc.lat_off)
    return by_sheet(delivery, acquisition_time(acquired) if acquired else None, by_row, lon_lat)


def lidar_read(inputs: SceneInputs, model: EpipolarModel) -> dict[str, Any]:
    """Record of a scene's LiDAR: what was read of the files, and what is missing.

    ``files`` (with points, all), ``nodes`` (read, all; of octrees), ``points`` and ``bytes`` (read,
    all). ``holes_m2``: ground that both images show in whole cells without a point; ``hole`` (lon,
    lat, degrees): the middle of the largest such place, or None. ``not_read_m2``: ground whose
    points labels may follow from, and which the footprint left out. ``acquired``: first and last
    day of the points, None unless all files tell them; ``doubts`` about the points; ``surfaces``:
    what heights count from, by number of files; ``strips``: what they are off, None of one strip;
    ``frame`` and epoch of the places, and those of the files. What is missing is logged, and files
    of different surfaces.
    """
    attrs = [PointStore(path).attrs for path in inputs.point_stores]
    nodes = [a["nodes"] for a in attrs if a["nodes"]]
    points = [a["points"] for a in attrs]
    holes_m2, hole = _holes(inputs, model)
    if hole is not None:
        log.warning(
            "warning: %.3f km² of what both images show have no LiDAR point, most of it around "
            "longitude %.5f, latitude %.5f",
            holes_m2 / 1e6,
            *hole,
        )
    return {
        "files": [sum(p["kept"] > 0 for p in points), len(points)],
        "nodes": np.sum(nodes, axis=0).tolist() if nodes else None,
        "points": [sum(p[name] for p in points) for name in ("read", "header")],
        "bytes": np.sum([a["bytes"] for a in attrs], axis=0).tolist(),
        "holes_m2": holes_m2,
        "hole": hole,
        "not_read_m2": _not_read(inputs),
        "acquired": _days([a["acquired"] for a in attrs]),
        "doubts": sorted({text for a in attrs for text in a.get("doubts", ())}),
        "surfaces": _surfaces([a["crs"]["heights"] for a in attrs]),
        "strips": inputs.lidar_strips.report() if inputs.lidar_strips else None,
        "frame": _frame([a["crs"].get("frame") for a in attrs]),
    }


def _frame(frames: Sequence[Mapping[str, Any] | None]) -> dict[str, Any] | None:
    """Frame and epoch of the places, and the frames and epochs that files have them in."""
    known = [frame for frame in frames if frame is not None]
    if len(known) < len(frames) or not known:
        return None
    sources = {tuple((k, str(v)) for k, v in f["source"].items()): f["source"] for f in known}
    return {**known[0], "source": [sources[key] for key in sorted(sources)]}


def _days(acquired: Sequence[Mapping[str, str] | None]) -> list[str] | None:
    days = [(one["start"], one["end"]) for one in acquired if one is not None]
    if len(days) < len(acquired) or not days:
        return None
    return [min(first for first, _ in days), max(last for _, last in days)]


def _surfaces(heights: Sequence[str]) -> dict[str, int]:
    """What heights count from, without their units, which are metres by now."""
    counts = Counter(text.rpartition(", in ")[0] for text in heights)
    if len(counts) > 1:
        log.warning(
            "warning: heights of the LiDAR's files count from different surfaces (%s): check them, "
            "or declare them by lidar_crs",
            "; ".join(f"{count}: {text}" for text, count in counts.most_common()),
        )
    return dict(sorted(counts.items()))


def _not_read(inputs: SceneInputs) -> float:
    rows, cols = inputs.pair.model.shape
    area = inputs.windows.beyond_stores(slice(0, rows), inputs.pair.cols(slice(0, cols)))
    if area:
        log.warning(
            "warning: labels may follow from points on %.2f km² around the images that were not "
            "read: the aligned images lie elsewhere than their RPCs say, or points lie far above "
            "the ground. Set ingest.margin_m to more, or to null, to read them",
            area / 1e6,
        )
    return round(area, 1)


def _holes(inputs: SceneInputs, model: EpipolarModel) -> tuple[float, list[float] | None]:
    """Ground (m²) of cells without a point whose middle both images show, and the largest place."""
    ground = np.stack(model.left.localize(*frame(model.left_size, EDGE), model.reference_height))
    ground = ground[:, np.isfinite(ground).all(axis=0)]
    cells = LidarFootprint.around([ground[:, corners_of_hull(*ground)]], 0.0)
    row, col = (at + first for at, first in zip(np.nonzero(cells.held), (cells.row, cells.col)))
    lon, lat = (col + 0.5) * CELL_DEG, (row + 0.5) * CELL_DEG
    missing = np.ones(row.size, np.bool_)
    for sensor, size in ((model.left, model.left_size), (model.right, model.right_size)):
        missing &= inside(np.stack(sensor.project(lon, lat, model.reference_height)), size)
    for store in inputs.stores:
        missing &= ~np.isin(cell_key(row, col), cell_key(store.cell_row, store.cell_col))
    if not missing.any():
        return 0.0, None
    area = cells.cell_m2[row[missing] - cells.row].sum()
    empty = np.zeros(cells.held.shape, np.uint8)
    empty[row[missing] - cells.row, col[missing] - cells.col] = 1
    import cv2  # few scenes have holes

    _, _, sizes, middles = cv2.connectedComponentsWithStats(empty, connectivity=8)
    x, y = middles[1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA]))]
    hole = (np.array([x + cells.col, y + cells.row]) + 0.5) * CELL_DEG
    return round(float(area), 1), np.round(hole, 5).tolist()
