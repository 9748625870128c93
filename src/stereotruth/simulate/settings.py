"""Settings of the synthetic cities."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ..settings import Number, Unit, settings


@settings
class Settings:
    """The configuration's section simulate."""

    lidar_spacing_m: Annotated[Number, Field(ge=0.1, le=5), Unit("m")] = 0.4
    """distance between neighbouring pulses of the synthetic LiDAR"""
