"""Settings of the stage export."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ..settings import Flag, Number, Share, Text, Unit, Whole, each_once, settings

NotNegative = Annotated[Number, Field(ge=0)]


@settings
class Tiles:
    """The configuration's section tiles."""

    size: Annotated[Whole, Field(ge=16), Unit("px")] = 1024
    """side of a tile"""

    stride: Annotated[Annotated[Whole, Field(ge=1)] | None, Unit("px")] = None
    """distance between neighbouring tiles; null: the size"""

    min_labelled: Share = 0.5
    """a pair with fewer labelled pixels counts as incomplete and goes to `unlabelled/`"""

    right_offset: Literal["tile", "scene"] = "tile"
    """the right image is shifted by the mean disparity of the tile or of the scene"""

    disparity_dtype: Literal["float32", "float16"] = "float32"
    """type of the disparity files, compressed: 32-bit float, rounded to 1/1024 px (at most
    1/2048 px off), which every program opens, or the paper's 16-bit float, up to 1/128 px off
    below 32 px and 1/16 px from 128 px on, which OpenCV and Pillow cannot read"""

    nodata: Annotated[Number, Unit("px")] = -999
    """value of unlabelled pixels in the disparity files"""

    max_uncertainty_px: Annotated[Number, Field(ge=0), Unit("px")] = 0.5
    """of the labels of rough surfaces (`labelled_crown`, 12), those with a greater `uncertainty`
    are in the disparity store alone: in the tiles they have no disparity and the status
    `too_uncertain` (13). 0: none of them is in the tiles. All other labels are"""

    layers: Annotated[
        tuple[Literal["height", "class", "agl", "uncertainty", "lidar_date"], ...],
        AfterValidator(each_once),
    ] = ()
    """more files of each labelled tile, on the grid of `disp`: `height` (of what the label shows, m
    above the ellipsoid), `class` (LAS class), `agl` (m above the ground, by the LiDAR's class 2, or
    a morphological filter where it has none), `uncertainty` (of the disparity, px), `lidar_date`
    (when the LiDAR measured it, days since 1970-01-01); float32 with nodata -9999, `class` uint8
    and `lidar_date` uint16 with 0. They go into `dataset/` too, and `agl` and `class` into the
    truth of `dataset_us3d/`"""


@settings
class Dataset:
    """The configuration's section dataset."""

    layouts: tuple[Literal["whu", "kitti", "us3d"], ...] = ("whu",)
    """what the target `dataset` writes: `dataset/` in the layout of the published WHU-Stereo
    (always); `dataset_kitti/` with 16-bit PNGs, which cannot hold negative disparities: right
    images are moved by `shift_px` of its manifest, so that the smallest disparity of each pair is 1
    to 2 px; `dataset_us3d/` with RGB images of 8 bits"""

    catalogs: tuple[Literal["stac", "croissant"], ...] = ()
    """descriptions of `dataset/` in it: STAC (`stac/collection.json` and an item for each pair,
    with orientation files and RPCs) and Croissant (`croissant.json`); they need
    the extra `catalog`"""

    acquired: Annotated[dict[str, Text], Unit("scene: date")] = field(default_factory=dict)
    """when scenes were taken, such as `2020-10-25` or `2020-10-25T03:12:45Z`, for STAC; items of
    other scenes say that it is not known"""

    originals: Flag = False
    """true: crops of the original images for each tile with corrected RPCs (tag and `_RPC.TXT`), in
    `originals/<city>/`, for multi-view and neural reconstruction"""

    original_heights: Flag = False
    """true: beside each crop in `originals/<city>/` the height of what each of its pixels shows,
    with its standard uncertainty and status; of images that have a name in the images sheet"""


@settings
class Evaluation:
    """The configuration's section evaluation."""

    building_share: Share = 0.02
    """a tile of which as many of the classified pixels are building is of the class building, any
    other of the class vegetation; where the LiDAR has no classes, flat things that stand above the
    ground count as buildings"""


@settings
class Limits:
    """The configuration's section quality; None switches a gate off."""

    max_gcp_rms_px: Annotated[NotNegative | None, Unit("px of the images")] = 1
    """a scene whose ground control points leave a larger residual (rms of either view) is flagged,
    as is what exceeds the limits below; null: no limit"""

    max_y_parallax_px: Annotated[NotNegative | None, Unit("px")] = 0.5
    """size of the median y-parallax of the SIFT matches of a tile or scene"""

    max_sift_error_px: Annotated[NotNegative | None, Unit("px")] = 0.5
    """size of the median of SIFT disparity less label"""

    max_sift_mean_absolute_error_px: Annotated[NotNegative | None, Unit("px")] = 1
    """mean of its size"""

    min_sift_matches: Annotated[Annotated[Whole, Field(ge=0)] | None, Unit("matches")] = 10
    """fewer are flagged themselves, and the two limits above not applied"""

    min_warp_correlation: Annotated[Number, Field(ge=-1, le=1)] | None = 0.5
    """correlation of the left and the right image warped by the labels"""

    min_agreement: Share | None = 0.01
    """probability that chance alone has the SIFT matches of a scene disagree so with its labels, by
    the standard errors of both: on open ground, on roofs, and of the rows. With less, the scene is
    in doubt, whatever the amount; so many scenes without fault are, too. null: no doubts"""


@settings
class Settings(Evaluation, Tiles):
    """How tiles are cut, checked and split."""

    seed: Whole = field(kw_only=True)
    strict: Flag = False
    quality: Limits = field(default_factory=Limits)
