"""Settings of the bands that are taken of images with several."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import Field

from ..errors import InputError
from ..settings import Number, Unit, Whole, settings

Band = Annotated[Whole, Field(ge=1)]
Weight = Annotated[Number, Field(gt=0)]


@settings
class Settings:
    """The configuration's section rectify."""

    colour: Annotated[
        Literal["auto"] | tuple[Band, Band, Band] | None, Unit("[red, green, blue]")
    ] = "auto"
    """the bands of both images, numbered from 1, that make the tiles' images coloured; auto: those
    that both images call red, green and blue, if they do; null: none, tiles are grey"""

    panchromatic: Annotated[Band | dict[Band, Weight] | None, Unit("band, or band: weight")] = None
    """what is matched and correlated, searched for tie points, and shown by grey tiles: a band, or
    a mean of bands by weights, such as `{1: 0.3, 2: 0.6, 3: 0.1}`; null: the mean of the bands of
    `colour`, or band 1 without"""

    def mix(self, colour: tuple[int, ...] | None) -> Mapping[int, float]:
        """Weights, of sum 1, of the bands that are mixed; ``colour``: of a pair."""
        given = self.panchromatic
        if given is None:
            given = dict.fromkeys(colour, 1.0) if colour else 1
        if isinstance(given, int):
            given = {given: 1.0}
        if not given:
            raise InputError(
                "rectify.panchromatic: no band", remedy="name a band, or bands with their weights"
            )
        return {band: weight / sum(given.values()) for band, weight in given.items()}
