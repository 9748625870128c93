"""A new project whose city is the twin of a place."""

from __future__ import annotations

import pytest

from stereocities.cities import city_of, file_of
from stereocities.twin_world import twin_city
from stereotruth.core.errors import InputError
from stereotruth.project.check import check_project
from stereotruth.project.findings import Level
from stereotruth.project.main import init
from stereotruth.project.project import configured, is_synthetic, lidar_of, read_scenes
from stereotruth.project.simulated_project import Options, with_twin

from ...synthetic import house_points as place


def test_its_scene_is_made_by_the_run(tmp_path, monkeypatch):
    """Sheets and city.json name one and the same twin, wherever the project was begun."""
    file = place.write_place(tmp_path / "house.laz", colours=False)
    monkeypatch.chdir(tmp_path)
    options = Options(density=4.0, sun_deg=(200.0, 40.0), size_px=(280, 260))
    assert "tiles/Twin" in with_twin(tmp_path / "twin", file.relative_to(tmp_path), options)
    monkeypatch.chdir(tmp_path / "twin")
    settings, _ = configured()
    assert settings.simulate.lidar_spacing_m == 0.5
    _, scenes = read_scenes(settings)
    scene = scenes["Twin-1"]
    assert is_synthetic(scene)
    assert [path.name for path in lidar_of(scene, settings).values()] == ["Twin-1_0_0.laz"]
    sun, size = options.sun_deg, options.size_px
    assert city_of("Twin") == twin_city("Twin", file, sun_deg=sun, size_px=size)
    assert not any(findings.failed for findings in check_project())
    file.rename(tmp_path / "away.laz")
    (missing,) = (of for findings in check_project() for of in findings if of.level is Level.ERROR)
    assert "no such file, of which the city is the twin" in missing.text
    (tmp_path / "away.laz").rename(file)
    file_of("Twin").unlink()
    assert not is_synthetic(scene)


def test_what_cannot_be_is_refused_before_anything_is_written(tmp_path):
    file = place.write_place(tmp_path / "house.laz", crs=False, colours=False)
    new = tmp_path / "twin"
    of = {"crs": "EPSG:32631"}
    for options, words in (
        (Options(), "declares no coordinate system"),
        (Options(**of, density=1e4), "10000 points per m²"),
        (Options(**of, sun_deg=(100.0, 3.0)), "a sun 3 degrees high"),
        (Options(**of, size_px=(100, 300)), "100 x 300 px"),
        (Options(**of, rpcs=(file, file)), "has no RPCs"),
    ):
        with pytest.raises(InputError, match=words):
            with_twin(new, file, options)
    with pytest.raises(InputError, match="add --twin FILE"):
        init(new, crs="EPSG:32631")
    assert not new.exists()
