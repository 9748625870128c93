"""Settings of the stage project: how points are judged and condensed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from ..errors import InputError
from ..settings import Flag, Number, Odd, Unit, Whole, settings
from .status import Status


@settings
class Occlusion:
    """The configuration's section occlusion."""

    method: Literal["correlation", "geometric", "both", "none"] = "both"
    """how hidden and changed points are found: by the paper's filter, which compares the images
    around each point; by the rays to both cameras, which run into other points; by the rays, and
    where the images contradict the LiDAR over most of a surface (25 px around a pixel) it counts as
    changed; not at all"""

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

    fill: Literal["none", "surface", "surface_and_images"] = "none"
    """`none`: a pixel has a label if points fall into it. `surface`: also between points, for LiDAR
    from 0.25 points/m² on. The points are triangles over the ground; those that go on the plane of
    their neighbours give labels; those between two surfaces are cut at the outline that the points
    on both sides of it tell; all others are swept vertically as what may hide a pixel in either
    view. Such labels have the status `labelled_between` (9) and an `uncertainty` of their own;
    pixels with points on the surface keep `labelled` (1). Where a step lies between points, pixels
    are `edge_in_pixel`. `surface_and_images`: of these, pixels that only one of the surfaces around
    explains in both images are on that surface, `labelled_by_images` (10): more labels in crowns
    and behind roofs, and more of the hidden pixels. A value is always the LiDAR's. Needs
    `occlusion.method` both (or geometric, without images), and `representative` top"""


@settings
class Project(Representative):
    """The configuration's section project."""

    right_view: Flag = False
    """also the labels of the right images: `results/project/<City>/<scene>_right.zarr`, and
    `disp_right`, `status_right` of the tiles"""


def check_fill(occlusion: Occlusion, project: Representative) -> None:
    """Raises InputError if labels between points cannot be had with the other keys."""
    methods = {
        "none": ("correlation", "geometric", "both", "none"),
        "surface": ("geometric", "both"),
        "surface_and_images": ("both",),
    }[project.fill]
    fits = project.fill == "none" or project.representative == "top"
    if occlusion.method in methods and fits:
        return
    raise InputError(
        f"project.fill: {project.fill!r} with occlusion.method {occlusion.method!r} and "
        f"project.representative {project.representative!r}",
        remedy="what lies between points is hidden by geometry, and judged by the images: take the "
        "method both (geometric does for surface), and the representative top",
    )


@settings
class Settings(Representative, Occlusion):
    """How points are judged and condensed; see config/README.md."""

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Settings:
        """From the configuration."""
        project = {k: v for k, v in config.get("project", {}).items() if k != "right_view"}
        return cls(**config.get("occlusion", {}), **project)

    def __post_init__(self) -> None:
        check_fill(self, self)

    @property
    def fills(self) -> bool:
        """Whether there are labels between points."""
        return self.fill != "none"

    @property
    def asks_images(self) -> bool:
        """Whether images tell the surface of pixels that points leave open."""
        return self.fill == "surface_and_images"

    @property
    def statuses(self) -> list[Status]:
        """Those that occur."""
        return [
            s
            for s in Status
            if s != Status.MASKED
            and (self.fills or s != Status.LABELLED_BETWEEN)
            and (self.asks_images or s != Status.LABELLED_BY_IMAGES)
        ]

    @property
    def uses_seen_surface(self) -> bool:
        """Whether points off the surface that the centre sees count as hidden from the left."""
        return self.uses_geometry or self.representative == "top"

    @property
    def uses_geometry(self) -> bool:
        """Whether rays are tested against the surface of the points."""
        return self.method in ("geometric", "both")

    @property
    def images_window(self) -> int:
        """Side in px of the window that the method compares in both images; 1 for none."""
        return self.window if self.method in ("correlation", "both") else 1

    @property
    def margin(self) -> int:
        """Pixels around a window whose points have a say in it."""
        # here, since these load compiled code and a workflow plans with the settings
        from .image_agreement import VOTE_PX
        from .open_pixels import MARGIN
        from .seen_surface import EDGE

        # one for each ring of neighbours: planes, their pooled noise, support
        reach = EDGE + 3
        if self.method != "both":
            return reach
        # windows, votes about them, and what is asked of the votes nearby
        reach += VOTE_PX + self.window // 2 * (2 if self.fills else 1)
        return reach + (MARGIN if self.asks_images else 0)
