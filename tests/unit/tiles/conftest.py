"""A scene, and its tiles, made once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from stereotruth.sensor.rpc import RPC, SensorModel
from stereotruth.tiles.scene_stores import SceneFiles

from ...synthetic.tiled_scene import make_scene, run

FITTED: dict[str, tuple[RPC, float]] = {}


@pytest.fixture(scope="session", autouse=True)
def fitted_once() -> Iterator[None]:
    """RPCs are fitted to a corrected sensor once for all exports of it: a third of their time."""
    fit = SensorModel.corrected_rpc

    def fit_once(self: SensorModel) -> tuple[RPC, float]:
        key = repr(self.to_dict())
        if key not in FITTED:
            FITTED[key] = fit(self)
        return FITTED[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SensorModel, "corrected_rpc", fit_once)
        yield


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    return make_scene(tmp_path_factory.mktemp("scenes") / "s1", bare_from=240)


@pytest.fixture(scope="session")
def exported(scene: SceneFiles, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("out")
    looks = {"coverage": folder / "coverage.png", "contact_sheet": folder / "contact.png"}
    return folder / "Town", run([scene], folder / "Town", workers=2, **looks)


@pytest.fixture(scope="session")
def in_colour(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SceneFiles]:
    folder = tmp_path_factory.mktemp("colour")
    scene = make_scene(folder / "Town-1", bare_from=240, colour=True)
    run([scene], folder / "Town", contact_sheet=folder / "contact.png")
    return folder / "Town", scene
