"""Four small pairs of known disparity, made once."""

from __future__ import annotations

import pytest

from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.small_pairs import small_dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> StereoDataset:
    return small_dataset(tmp_path_factory.mktemp("pairs"))
