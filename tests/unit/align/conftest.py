"""Two images, whose RPCs are biased, for the tests of this package."""

from __future__ import annotations

from pathlib import Path

import pytest

from ...synthetic.surveyed_pair import RPCS, SIZES, write_image


@pytest.fixture(scope="session")
def images(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("pair")
    return {v: write_image(folder / f"{v}.tif", RPCS[v], SIZES[v]) for v in ("left", "right")}
