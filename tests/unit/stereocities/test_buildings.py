"""Buildings of a city."""

from __future__ import annotations

from dataclasses import replace

from stereocities.world import build_surfaces

from ...synthetic.small_cities import TOWN


def test_buildings_are_as_many_as_the_share_and_flat_where_asked() -> None:
    half = replace(TOWN, character=replace(TOWN.character, buildings=0.5, flat_roofs=True))
    few, all_of_them = build_surfaces(half), build_surfaces(TOWN)
    assert 0.35 < len(few.boxes) / len(all_of_them.boxes) < 0.65
    assert (few.boxes[:, 7] == 0).all() and (all_of_them.boxes[:, 7] > 0).any()
