"""Settings of the stage ingest."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from ..settings import Number, Unit, Whole, each_once, settings


@settings
class Settings:
    """The configuration's section ingest."""

    drop_classes: Annotated[
        tuple[Annotated[Whole, Field(ge=0, le=255)], ...],
        AfterValidator(each_once),
        Unit("LAS classes"),
    ] = (7, 18)
    """points left out; 7 and 18 are noise, IGN files use 65 for artefacts"""

    margin_m: Annotated[Annotated[Number, Field(ge=0)] | None, Unit("m")] = 200
    """around the ground that a pair shows by its RPCs: points farther away are not read (of COPC),
    or not kept; null: all points of all files"""

    strips: Literal["named", "adjusted"] = "named"
    """strips of the LiDAR that disagree beyond noise where they overlap: `named` names them with
    their offsets and leaves the points where they are; the `uncertainty` of labels has what their
    strip is off, and pixels nearer to an edge than strips are off in plan have no label. `adjusted`
    moves the points by the offsets, which count from the strip with most ground; their
    `uncertainty` has what is left"""

    copies_gb: Annotated[Annotated[Number, Field(ge=0)], Unit("GB")] = 20
    """parts of LiDAR files from web servers and buckets that are kept in `results/copies`, so that
    a run that is made again reads nothing; 0: none"""
