"""Everything that can be known before a run, by the checks of the stages that would refuse it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from ..configuration import Configuration
from ..dataset.windows import cell_step
from ..errors import InputError
from ..project import (
    adjusted_scenes,
    check_fixed,
    configured,
    is_synthetic,
    names_in_pair,
    read_images,
    read_scenes,
    require_scenes,
    sheet,
)
from ..sheets import Scene
from .check_scene import SceneFacts, check_scene
from .findings import Findings, Level
from .resources import check_resources
from .run_workflow import duration
from .site import check_images, check_links, scene_pairs

MANY = 10  # scenes whose check takes more than a moment
SCENE_SECONDS = 2.5  # of one core: images of 100 MB, control points, headers of the LiDAR


def chosen(
    names: Iterable[str], scenes: dict[str, Scene], cities: Iterable[str], rows: str
) -> dict[str, Scene]:
    """The scenes that names of scenes or cities stand for; all without names.

    Raises InputError for a name that neither sheet has.
    """
    names, cities = list(names), set(cities)
    unknown = [name for name in names if name not in scenes and name not in cities]
    if unknown:
        known = ", ".join([*scenes, *sorted(cities)]) or "none, as the sheets are empty"
        raise InputError(
            f"no scene or city {unknown[0]!r}", file=rows, remedy=f"take of these: {known}"
        )
    return {
        name: scene
        for name, scene in scenes.items()
        if not names or name in names or scene.city in names
    }


def check_project(
    configfiles: Sequence[Path] | None = None,
    names: Sequence[str] = (),
    tell: Callable[[str], object] = lambda text: None,
) -> list[Findings]:
    """Findings of the sheets, of each scene, and of what the run will take, in this order.

    ``tell`` is called before scenes are looked at, if that takes more than a moment.
    """
    project = Findings("project")
    settings = scenes = None
    with project.of("configuration"):
        require_scenes(configfiles)
        settings, files = configured(configfiles)
        project.say("configuration", Level.FACT, files)
        tiles = settings.tiles
        cell_step(tiles.size, tiles.stride or tiles.size)
    if settings is None:
        return [project]
    with project.of("sheets"):
        cities, every_scene = read_scenes(settings)
        rows = sheet(settings, "scenes")
        images = read_images(settings, cities)
        check_fixed(settings, every_scene, images)
        found = chosen(names, every_scene, cities, rows)
        if not found:
            raise InputError(
                "no scene in it", file=rows, remedy="stereotruth scene add DELIVERY --lidar FOLDER"
            )
        scenes = found
        project.say("sheets", Level.FACT, _counted(scenes))
    if scenes is None:
        return [project]
    if len(scenes) > MANY:
        tell(
            f"looking at {len(scenes)} scenes, about {duration(SCENE_SECONDS * len(scenes))}; "
            "stereotruth check SCENE … looks at some"
        )
    in_sheet = {name: names_in_pair(scene, images) for name, scene in every_scene.items()}
    adjusted = adjusted_scenes(settings, every_scene, in_sheet)
    every, facts = [project], []
    for name, scene in scenes.items():
        found = Findings(name)
        if is_synthetic(scene):
            found.say("input", Level.FACT, "synthetic: images, LiDAR and truth are made by the run")
        else:
            alone = name not in adjusted
            facts.append(check_scene(scene, settings, found, in_sheet[name], alone=alone))
        every.append(found)
    if settings.images:
        towns = sorted({scene.city for scene in scenes.values()})
        of_images = check_images(settings, images, scenes.values(), towns)
        for town in towns:
            check_links(town, images, scene_pairs(town, every_scene, images), of_images)
        every.insert(1, of_images)
    every.append(_run(facts, settings))
    return every


def _run(facts: Sequence[SceneFacts], settings: Configuration) -> Findings:
    found = Findings("run")
    with found.of("resources"):
        check_resources([fact for fact in facts if fact.pixels], settings, found)
    return found


def _counted(scenes: dict[str, Scene]) -> str:
    cities = len({scene.city for scene in scenes.values()})
    return (
        f"{len(scenes)} scene{'s' * (len(scenes) != 1)} of {cities} "
        f"{'city' if cities == 1 else 'cities'}"
    )
