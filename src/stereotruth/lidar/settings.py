"""Settings of the stage ingest."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from ..settings import Unit, Whole, each_once, settings


@settings
class Settings:
    """The configuration's section ingest."""

    drop_classes: Annotated[
        tuple[Annotated[Whole, Field(ge=0, le=255)], ...],
        AfterValidator(each_once),
        Unit("LAS classes"),
    ] = (7, 18)
    """points left out; 7 and 18 are noise, IGN files use 65 for artefacts"""
