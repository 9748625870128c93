"""Small cities with crowns, and what a view of one shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from stereocities.cities import Canopy, CitySpec, ViewSpec
from stereocities.render import prepare
from stereocities.truth import truth_at

from .small_cities import TOWN

CANOPY = Canopy(ground_m2=150.0, radius_m=(2.0, 4.0))
WOODED = replace(
    TOWN, name="Wooded", character=replace(TOWN.character, trees=0.0, canopy=CANOPY, river_m=0.0)
)
BARE_RIGHT = replace(WOODED, right=ViewSpec(bare=True))
OPEN = replace(
    WOODED, character=replace(WOODED.character, zones={"fields": 1}, buildings=0.0, relief_m=0.0)
)


def shown_by(city: CitySpec, view: str, step: float = 3.0) -> dict[str, np.ndarray]:
    scene = city.scenes[0]
    ready = prepare(city, scene)
    camera = getattr(ready, view)
    at = np.meshgrid(np.arange(20.0, camera.cols - 20, step), np.arange(20, camera.rows - 20, step))
    col, row = (a.ravel() for a in at)
    return {"col": col, "row": row, **truth_at(city, scene, col, row, view)}
