"""Pictures within a page."""

from __future__ import annotations

import base64
import re

import numpy as np
import pytest

from stereotruth.pages import pictures

from ...synthetic.colour_vision import EYES, lab, nearest, rgb
from ...synthetic.project import ROOT
from ...synthetic.reported_city import picture

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.mark.parametrize("limit", [200, 2000, 20_000, 10**6])
def test_pictures_keep_within_their_bytes(limit):
    noise = np.random.default_rng(0).integers(0, 255, (300, 200, 3)).astype(np.uint8)
    for image in (noise, noise[..., 0]):
        data = base64.b64decode(pictures.encode(image, limit).partition(",")[2])
        assert len(data) <= limit
    shape = picture(pictures.encode(noise, limit)).shape
    assert shape[0] / shape[1] == pytest.approx(1.5, rel=0.2)
    assert (shape == noise.shape) == (limit == 10**6)


def test_colours_of_methods_are_apart_for_all_eyes_and_on_any_page():
    """20: a difference that is seen without looking twice."""
    on_pages = [rgb(colour) for colour in pictures.SERIES]
    for back in ((255, 255, 255), (20, 24, 30)):  # light and dark
        assert nearest([*on_pages, back]) > 20


@pytest.mark.parametrize("name", [pictures.DISPARITIES, pictures.ERRORS])
def test_lightness_alone_tells_in_print_and_to_all_eyes(name):
    steps = np.linspace(0, 1, 24, dtype=np.float32)[None]
    colours = pictures.colours(steps, (0, 1), name)[0]
    for eyes in EYES:
        assert (np.diff(lab(colours, eyes)[:, 0]) > 0).all()


def test_a_pixel_without_a_value_has_a_colour_of_its_own():
    steps = np.linspace(0, 1, 24, dtype=np.float32)[None]
    for name in (pictures.DISPARITIES, pictures.ERRORS):
        colours = pictures.colours(steps, (0, 1), name)[0]
        for colour in colours:
            assert nearest([colour, pictures.NO_VALUE]) > 20


def test_nothing_is_drawn_in_colours_that_some_eyes_confuse():
    """No rainbow, no red against green; names of matplotlib's maps and of its usual colours."""
    unsafe = re.compile(r"turbo|\bjet\b|rainbow|RdYlGn|\"terrain\"|#d62728|#2ca02c|cmap=\"hsv\"")
    files = [*ROOT.glob("src/**/*.py"), *ROOT.glob("src/**/*.jinja"), *ROOT.glob("bench/*.py")]
    assert len(files) > 200
    assert [str(file) for file in files if unsafe.search(file.read_text(encoding="utf-8"))] == []
