"""The method of docs/how-to/own_method.md runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "own_method.md"


def test_the_method_of_the_page_finds_a_shift_up_to_the_borders():
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    names: dict = {}
    exec(code, names)
    texture = np.random.default_rng(3).integers(200, 2000, (96, 160)).astype(np.uint16)
    left, right = texture[:, :128], texture[:, 5 : 5 + 128]  # x_left - x_right = 5
    found = names["match"](left, right, [-64, 128])
    assert found.dtype == np.float32 and found.shape == left.shape
    assert np.isfinite(found).mean() > 0.8
    assert np.nanmean(np.abs(found - 5) < 0.5) > 0.9
