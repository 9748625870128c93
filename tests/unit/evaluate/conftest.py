"""A scene with its exact truth, made once."""

from __future__ import annotations

import pytest

from ...synthetic.truth_scene import Scene, make_scene


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Scene:
    return make_scene(tmp_path_factory.mktemp("scene"))
