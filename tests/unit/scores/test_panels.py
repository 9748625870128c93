"""Pictures of disparities and errors."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from stereobench.scores import panels
from stereobench.scores.panels import Column, draw_columns, error_picture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_errors_have_one_scale_and_holes_a_colour():
    truth = np.array([[0, 0, 0, np.nan]], np.float32)
    found = np.array([[0, 6, np.nan, 1]], np.float32)
    none, full, hole, unlabelled = error_picture(found, truth)[0].tolist()
    assert sum(none) < 20 and sum(full) > 600
    assert tuple(hole) == panels.INVALID
    assert tuple(unlabelled) == panels.NO_VALUE


def test_pictures_without_truth_have_no_errors(tmp_path):
    image = np.arange(64, dtype=np.uint16).reshape(8, 8)
    flat = np.full((8, 8), 3.0, np.float32)
    columns = [Column(name, image, image, None, {"M": flat}) for name in ("a", "b")]
    draw_columns(tmp_path / "a.png", columns)
    draw_columns(tmp_path / "b.png", columns, across=True)
    tall, wide = (cv2.imread(str(tmp_path / f"{n}.png")).shape for n in "ab")
    assert wide[1] / wide[0] > 1.2 * tall[1] / tall[0]


@pytest.mark.parametrize("name", [r"$\frac$", "$a_{", "a$b"])
def test_names_are_no_formulas(tmp_path, name):
    """Of pairs and of methods; Matplotlib would end with an error."""
    image = np.arange(64, dtype=np.uint16).reshape(8, 8)
    flat = np.full((8, 8), 3.0, np.float32)
    for across in (False, True):
        column = Column(name, image, image, flat, {name: flat})
        draw_columns(tmp_path / "a.png", [column], across=across)
        assert cv2.imread(str(tmp_path / "a.png")) is not None
