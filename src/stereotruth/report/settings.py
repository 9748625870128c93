"""Settings of the page of a city."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..settings import Unit, Whole, settings


@settings
class Settings:
    """The configuration's section report."""

    sliders: Annotated[Whole, Field(ge=0), Unit("tiles")] = 30
    """of a city's page, evenly chosen, that have large pictures: a slider between left and warped
    right image, and their difference; all have thumbnails"""
