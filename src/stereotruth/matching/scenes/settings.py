"""Settings of stereo methods over whole scenes, and of the surface models that follow."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ...errors import InputError
from ...settings import Number, Range, Text, Unit, Whole, each_once, settings

CHUNK = 256  # px of the result


@settings
class Settings:
    """How a method goes over a scene.

    ``disparity_range``: px, of one tile; ``offset``: of the right image, px, or "auto"
    (:mod:`offsets`). ``block_px``: a multiple of 256. ``margin_px``: None is the method's own.
    """

    disparity_range: Range | None = None
    """of one block: the smallest disparity, the one after the largest; null: that of the dataset"""

    offset: Annotated[Whole | Literal["auto"], Unit("px")] = "auto"
    """by which the right image is moved before matching. auto: found from the images for each
    block, so that a scene may have more relief than the range holds"""

    block_px: Annotated[Whole, Field(ge=CHUNK, multiple_of=CHUNK), Unit("px")] = 1024
    """side of the blocks; memory grows with its square. With steep relief, smaller blocks keep
    within the range"""

    overlap_px: Annotated[Whole, Field(ge=0), Unit("px")] = 64
    """by which blocks reach into their neighbours, where both are blended; at most half a block"""

    margin_px: Annotated[Annotated[Whole, Field(ge=0)] | None, Unit("px")] = None
    """that a method sees around a block and its overlap; null: as far as anything matters to it. A
    smaller one costs less, and more at the seams"""

    def __post_init__(self) -> None:
        if 2 * self.overlap_px > self.block_px:
            raise InputError(
                f"blocks of {self.block_px} px with an overlap of {self.overlap_px} px",
                remedy=f"take a multiple of {CHUNK}, and an overlap of half of it at most",
            )


@settings
class SurfaceModel:
    """The configuration's section predict.dsm."""

    resolution_m: Annotated[Annotated[Number, Field(gt=0)] | None, Unit("m")] = None
    """side of a cell of the surface model; null: a pixel of the coarser image on the ground, to two
    digits"""


@settings
class Predict(Settings):
    """The configuration's section predict."""

    methods: Annotated[
        tuple[Text, ...], AfterValidator(each_once), Unit("names of `benchmark.methods`")
    ] = ("sgm",)
    """that the target `predict` goes over all scenes with;
    `results/predict/<city>/<scene>/<method>_dsm.tif` asks for any one"""

    dataset: Annotated[Text | None, Unit("name of `benchmark.datasets`")] = None
    """whose disparity range is taken, and the networks trained on which; null: the first"""

    dsm: SurfaceModel = field(default_factory=SurfaceModel)
    """of the surface models:"""
