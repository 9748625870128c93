"""A scene, and its tiles, made once."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereotruth.dataset.scene_stores import SceneFiles

from ...synthetic.tiled_scene import make_scene, run


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    return make_scene(tmp_path_factory.mktemp("scenes") / "s1", bare_from=240)


@pytest.fixture(scope="session")
def exported(scene: SceneFiles, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("out")
    looks = {"coverage": folder / "coverage.png", "contact_sheet": folder / "contact.png"}
    return folder / "Town", run([scene], folder / "Town", workers=2, **looks)
