"""Settings of the stage project: how points become labels."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ..settings import Flag, Number, Odd, Unit, Whole, settings
from .status import Status


@settings
class Settings:
    """What the labels of a grid follow from; see config/README.md."""

    recipe: Literal["surface", "paper"] = "surface"
    """how points become labels. `surface`: the points are triangles over the ground. Those that go
    on the plane of their neighbours, or bulge as crowns do, give labels. Those between two surfaces
    are cut at the breakline that the points on both sides of it determine. All others are swept
    vertically as what may hide a pixel in either view. All pixels on the surface have a label:
    those with points on it the status `labelled` (1), those between points `labelled_between` (9)
    and an `uncertainty` of their own. Rough surfaces, as crowns are, have labels where both views
    must see them, `labelled_crown` (12), with the `uncertainty` that the roughness of their points
    leaves; which of these are in the tiles, `tiles.max_uncertainty_px` says. Where a step lies
    between points, other pixels are `edge_in_pixel`. Where both images tell that what the LiDAR
    shows has probably changed, pixels are `changed`. A value is always the LiDAR's.
    `paper`: as in the WHU-Stereo paper, a pixel's label is that of mean X, mean Y and max Z of its
    points, and points around which the images do not correlate are dropped"""

    window: Annotated[Odd, Field(ge=3, le=31), Unit("px")] = 9
    """side of the correlation window; with `surface` that of the layer `correlation`, and of the
    pixels in it only those of the same surface count"""

    correlation_threshold: Annotated[Number, Field(ge=-1, le=1)] = 0.5
    """with `paper`: a point below is dropped"""

    edge_margin_px: Annotated[Number, Field(ge=0, le=1), Unit("px")] = 0
    """with `surface`: a pixel whose centre lies nearer to the edge between its surface (roof,
    crown) and another stays unlabelled, since noise of the alignment decides which one it meets;
    pixels on an edge itself always do"""

    min_points: Annotated[Whole, Field(ge=1, alias="min_points_per_px"), Unit("points")] = 1
    """a pixel with fewer stays unlabelled with `paper`, and is one between points with `surface`"""

    diachronic: Flag = False
    """with `surface`: whether both images of a pair were taken under different suns or in different
    seasons, where neither the column `diachronic` of the scenes sheet nor dates and suns of the
    images tell it. Shadows and leaves change their brightness then where no height has changed, so
    that the same evidence tells less of a change. The `uncertainty` of such labels has the
    probability of a change that the images do not show"""

    @property
    def on_surface(self) -> bool:
        """Whether labels follow from the surface of the points."""
        return self.recipe == "surface"

    @property
    def statuses(self) -> list[Status]:
        """Those that the recipe's grids name; MASKED comes with masks alone."""
        statuses = [status for status in Status if status <= Status.EDGE_IN_PIXEL]
        if self.on_surface:
            statuses += [Status.LABELLED_BETWEEN, Status.LABELLED_CROWN]
        return statuses

    @property
    def images_window(self) -> int:
        """Side in px of the window that both images must hold around a label; 1: its pixel."""
        return 1 if self.on_surface else self.window

    @property
    def margin(self) -> int:
        """Pixels around a window whose points have a say in it."""
        if not self.on_surface:
            return 1  # the points' noise is pooled over 3 x 3 pixels
        # here, since these load compiled code and a workflow plans with the settings
        from .change_evidence import EVIDENCE_PX
        from .change_probability import MEANS_PX
        from .change_reasons import REASON_PX
        from .crowns import CROWN_REACH_PX

        # what may hide a crown, farther off than the plane and the noise of a pixel's own points
        # reach, and what the images tell of a pixel, and of those around
        reach = CROWN_REACH_PX + MEANS_PX + max(EVIDENCE_PX, self.window // 2 + 1)
        return reach + REASON_PX  # of changes


@settings
class Project(Settings):
    """The configuration's section project."""

    right_view: Flag = False
    """also the labels of the right images: `results/project/<City>/<scene>_right.zarr`, and
    `disp_right`, `status_right` of the tiles"""
