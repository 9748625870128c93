"""Everything that can be known before a run, by the checks of the stages that would refuse it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from time import monotonic

from stereocities.cities import city_of, file_of

from ..core.errors import InputError, in_number
from ..core.sheets import Scene
from ..lidar.frames import Epoch
from ..tiles.scene_stores import cell_step
from .check_scene import Looked, check_scene
from .expected import check_resources, duration
from .findings import Findings
from .project import (
    adjusted_scenes,
    check_fixed,
    configured,
    epoch_of_city,
    is_synthetic,
    names_in_pair,
    read_images,
    read_scenes,
    require_scenes,
    sheet,
)
from .site import check_images, check_links, scene_pairs

TIMED = 3  # scenes by which the time of the others is known
MOMENT_S = 10.0  # that needs no word


def chosen(
    names: Iterable[str], scenes: dict[str, Scene], cities: Iterable[str], rows: str
) -> dict[str, Scene]:
    """The scenes that names of scenes or cities stand for; all without names.

    Raises InputError for a name that neither sheet has, and if there is none.
    """
    names, cities = list(names), set(cities)
    unknown = [name for name in names if name not in scenes and name not in cities]
    if unknown:
        known = ", ".join([*scenes, *sorted(cities)]) or "none, as the sheets are empty"
        raise InputError(
            f"no scene or city {unknown[0]!r}", file=rows, remedy=f"take of these: {known}"
        )
    found = {
        name: scene
        for name, scene in scenes.items()
        if not names or name in names or scene.city in names
    }
    if not found:
        raise InputError(
            "no scene in it", file=rows, remedy="stereotruth scene add DELIVERY --lidar FOLDER"
        )
    return found


def check_project(
    configfiles: Sequence[Path] | None = None,
    names: Sequence[str] = (),
    tell: Callable[[str], object] = lambda text: None,
) -> list[Findings]:
    """Findings of the sheets, of each scene, and of what the run will take, in this order.

    ``tell`` is called after the first scenes, if all others take more than a moment.
    """
    project = Findings("project")
    settings = scenes = None
    with project.of("configuration"):
        require_scenes(configfiles)
        settings, files = configured(configfiles)
        project.fact("configuration", files)
        tiles = settings.tiles
        cell_step(tiles.size, tiles.stride or tiles.size)
    if settings is None:
        return [project]
    with project.of("sheets"):
        cities, every_scene = read_scenes(settings)
        images = read_images(settings, cities)
        check_fixed(settings, every_scene, images)
        scenes = chosen(names, every_scene, cities, sheet(settings, "scenes"))
        towns = len({scene.city for scene in scenes.values()})
        count = f"{in_number(len(scenes), 'scene')} of {towns} {'city' if towns == 1 else 'cities'}"
        project.fact("sheets", count)
    if scenes is None:
        return [project]
    in_sheet = {name: names_in_pair(scene, images) for name, scene in every_scene.items()}
    adjusted = adjusted_scenes(settings, every_scene, in_sheet)
    every, facts = [project], []
    looked: Looked = {}
    epochs: dict[str, Epoch] = {}
    began = monotonic()
    for k, (name, scene) in enumerate(scenes.items()):
        if k == TIMED:
            left = len(scenes) - TIMED
            left_s = (monotonic() - began) / TIMED * left
            if left_s > MOMENT_S:
                tell(
                    f"looking at {left} more scenes, about {duration(left_s)}; "
                    "stereotruth check SCENE … looks at some"
                )
        found = Findings(name)
        if is_synthetic(scene):
            _check_synthetic(scene, found)
        else:
            alone = name not in adjusted
            epoch = epochs.get(scene.city)
            if epoch is None:
                epoch = epochs[scene.city] = epoch_of_city(cities[scene.city], every_scene, images)
            names = in_sheet[name]
            facts.append(
                check_scene(scene, settings, found, names, alone=alone, looked=looked, epoch=epoch)
            )
        every.append(found)
    if settings.images:
        towns = sorted({scene.city for scene in scenes.values()})
        of_images = check_images(settings, images, scenes.values(), towns)
        for town in towns:
            check_links(town, images, scene_pairs(town, every_scene, images), of_images)
        every.insert(1, of_images)
    run = Findings("run")
    with run.of("resources"):
        others = cities.keys() - {scene.city for scene in scenes.values()}
        check_resources([fact for fact in facts if fact.pixels], run, others)
    return [*every, run]


def _check_synthetic(scene: Scene, found: Findings) -> None:
    """What a run makes needs nothing but the files of the place that a city is the twin of."""
    with found.of("input"):
        city = city_of(scene.city)
        words = "images, LiDAR and truth are made by the run"
        if city.twin is None:
            found.fact("input", f"synthetic: {words}")
            return
        for file in city.twin.files:
            if not Path(file).is_file():
                raise InputError(
                    "there is no such file, of which the city is the twin",
                    file=file,
                    remedy=f"put it back, or correct its path in {file_of(city.name)}",
                )
        found.fact("input", f"twin of {city.twin.file}: {words}")
