"""Settings of the stage project: how points are judged and condensed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from ..settings import Flag, Number, Odd, Unit, Whole, settings
from .status import Status


@settings
class Occlusion:
    """The configuration's section occlusion."""

    method: Literal["correlation", "geometric", "both", "none"] = "both"
    """how hidden and changed points are found: by the paper's filter, which compares the images
    around each point; by the surface of the points, drawn into both views; by that, and where the
    images contradict the LiDAR over most of a surface (25 px around a pixel) it counts as changed;
    not at all"""

    window: Annotated[Odd, Field(ge=3, le=31), Unit("px")] = 9
    """side of the correlation window; with `both`, of the pixels in it only those of the same
    surface count"""

    correlation_threshold: Annotated[Number, Field(ge=-1, le=1)] = 0.5
    """with `correlation` a point below is dropped; with `both` a pixel below votes for change"""


@settings
class Representative:
    """Of the configuration's section project, what disparities follow from."""

    representative: Literal["top", "paper"] = "top"
    """the point that stands for a pixel: the mean of its points on the surface that its centre
    meets, or mean X, mean Y and max Z of all its points, as in the paper"""

    edge_margin_px: Annotated[Number, Field(ge=0, le=1), Unit("px")] = 0
    """with `top`: a pixel whose centre lies nearer to the edge between its surface (roof, crown)
    and another stays unlabelled, since noise of the alignment decides which one it meets; pixels on
    an edge itself always do"""

    min_points: Annotated[Whole, Field(ge=1, alias="min_points_per_px"), Unit("points")] = 1
    """a pixel with fewer stays unlabelled"""

    fill: Literal["none", "surface", "surface_and_images"] = "surface"
    """where labels are, with `occlusion.method` both or geometric and the representative top. The
    points are triangles over the ground: those that go on the plane of their neighbours, or bulge
    as crowns do, give labels; those between two surfaces are cut at the outline that the points on
    both sides of it tell; all others are swept vertically as what may hide a pixel in either view.
    `surface`: all pixels on it have a label, those with points on it the status `labelled` (1),
    those between points `labelled_between` (9) and an `uncertainty` of their own. Rough surfaces,
    as crowns are, have labels where both views must see them, `labelled_crown` (12), with the
    `uncertainty` that the roughness of their points leaves; which of these are in the tiles,
    `tiles.max_uncertainty_px` says. Where a step lies between points, other pixels are
    `edge_in_pixel`. `none`: pixels with points alone.
    `surface_and_images`: of the pixels that the surface leaves open, those that only one of the
    surfaces around explains in both images are on that surface, `labelled_by_images` (10): more
    labels in crowns and behind roofs, and more of the hidden pixels (with the method both alone). A
    value is always the LiDAR's"""


@settings
class Project(Representative):
    """The configuration's section project."""

    right_view: Flag = False
    """also the labels of the right images: `results/project/<City>/<scene>_right.zarr`, and
    `disp_right`, `status_right` of the tiles"""


@settings
class Settings(Representative, Occlusion):
    """How points are judged and condensed; see config/README.md."""

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Settings:
        """From the configuration."""
        project = {k: v for k, v in config.get("project", {}).items() if k != "right_view"}
        return cls(**config.get("occlusion", {}), **project)

    @property
    def fills(self) -> bool:
        """Whether there are labels between points."""
        return self.fill != "none" and self.uses_geometry and self.representative == "top"

    @property
    def asks_images(self) -> bool:
        """Whether images tell the surface of pixels that points leave open."""
        return self.fill == "surface_and_images" and self.fills and self.method == "both"

    @property
    def statuses(self) -> list[Status]:
        """Those that occur."""
        return [
            s
            for s in Status
            if s not in (Status.MASKED, Status.TOO_UNCERTAIN)
            and (self.fills or s not in (Status.LABELLED_BETWEEN, Status.LABELLED_CROWN))
            and (self.asks_images or s != Status.LABELLED_BY_IMAGES)
        ]

    @property
    def uses_geometry(self) -> bool:
        """Whether the surface of the points tells what is seen."""
        return self.method in ("geometric", "both")

    @property
    def images_window(self) -> int:
        """Side in px of the window that both images must hold around a label; 1: its pixel."""
        return self.window if self.method == "correlation" else 1

    @property
    def margin(self) -> int:
        """Pixels around a window whose points have a say in it."""
        # here, since these load compiled code and a workflow plans with the settings
        from .image_agreement import NEARBY_PX, VOTE_PX
        from .open_pixels import MARGIN
        from .seen_surface import EDGE

        # one for each ring of neighbours: planes, their pooled noise, support
        reach = EDGE + 3
        if self.method != "both":
            return reach
        # steps beside pixels, windows, votes about them, and what is asked of the votes nearby; in
        # the rim of a change, by the mean of what is not voted against
        reach += VOTE_PX + max(VOTE_PX, NEARBY_PX) + self.window // 2 + 1
        return reach + (MARGIN if self.asks_images else 0)
