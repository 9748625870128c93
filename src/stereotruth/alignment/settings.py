"""Settings of the stages align and refine."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal

from ..settings import FilePath, Flag, Unit, settings


@settings
class Settings:
    """The configuration's section alignment."""

    model: Literal["affine", "similarity", "shift"] = "affine"
    """transformation from the RPC's projection to the image; needs 4, 3, 2 ground control points at
    least"""

    refine: Flag = True
    """true: tie points between LiDAR and both images are matched and what is left between them
    (disparity, y-parallax) is taken out of both corrections, with the ground control points'
    covariance as prior; if the tie points do not contradict the alignment it stays as it is.
    `results/refine/<city>/<scene>/` says what was seen and changed, and doubts heights of the LiDAR
    that do not fit the control points, the images or the RPCs; with false nothing checks them"""

    fixed: Annotated[dict[str, FilePath], Unit("scene or image: path")] = field(
        default_factory=dict
    )
    """an `alignment.json` that a scene is made with as it is (a published one, or
    `results/refine/<city>/<scene>/alignment.json` put aside): neither control points nor LiDAR have
    a say any more, so that one more LiDAR file leaves all labels that it does not touch as they
    are, to the bit. Or an image of the images sheet and a copy of `results/adjust/<city>.json`: its
    correction stays as it is there, and images that came later are adjusted to it"""
