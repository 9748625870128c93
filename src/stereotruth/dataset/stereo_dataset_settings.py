"""How the configuration names a stereo dataset."""

from __future__ import annotations

from typing import Annotated, Literal

from ..settings import FilePath, Flag, Number, Range, Text, Unit, settings


@settings
class Settings:
    """An entry of the configuration's benchmark.datasets."""

    root: Annotated[FilePath, Unit("path")]
    """its folder"""

    layout: Literal["stereotruth", "whu", "kitti", "us3d"]
    """where its files lie and what they are called"""

    disparity_range: Range
    """disparities that methods look for and labels that count, the second excluded"""

    nodata: Annotated[Number, Unit("px")] = -999
    """value of unlabelled pixels, −999 if it is not given"""

    grows_with_height: Flag = True
    """whether the larger of two disparities is the higher place (true if it is not given): holes of
    a disparity map are filled with the lower one"""

    protocol: Literal["whu-2023", "us3d-track2", "exact-2026"] | None = None
    """frozen definition of its scores, see [below](#protocols); null or not given: what the section
    says"""

    methods: Annotated[tuple[Text, ...] | None, Unit("names")] = None
    """methods that the target `benchmark` compares; null or not given: all that need no training
    (no networks without `weights`)"""
