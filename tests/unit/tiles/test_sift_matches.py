"""SIFT matches on rendered pairs of known disparity: a plane with a raised block."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from stereotruth.tiles import sift_matches

SIZE = 320
BLOCK = (140, 230)  # columns of the raised block in the left image
RAISED = 9.0  # px


class Pair(NamedTuple):
    left: np.ndarray
    right: np.ndarray
    disparity: np.ndarray


def plane(x, y):
    return 2.3 + 0.02 * x - 0.01 * y


@pytest.fixture(scope="module")
def texture():
    """A band-limited texture at any (x, y)."""
    noise = gaussian_filter(np.random.default_rng(5).normal(size=(SIZE + 80, SIZE + 80)), 1.6)
    noise = 600 + 900 * noise / noise.std() * 0.2
    return lambda x, y: map_coordinates(noise, [y + 40, x + 40], order=5, mode="nearest")


def render(texture, row_shift: float = 0.0) -> Pair:
    """Left image, right image moved down by ``row_shift``, disparity with NaN where hidden.

    The ground shows the texture mirrored, so that no place is seen twice.
    """
    y, x = np.mgrid[:SIZE, :SIZE].astype(float)
    raised = (x >= BLOCK[0]) & (x < BLOCK[1])
    disparity = plane(x, y) + np.where(raised, RAISED, 0.0)
    v = y - row_shift
    # x_r = x − (2.3 + 0.02 x − 0.01 v + lift) solved for x, the block in front
    front, back = ((x + 2.3 + lift - 0.01 * v) / 0.98 for lift in (RAISED, 0.0))
    seen = (front >= BLOCK[0] - 0.5) & (front < BLOCK[1] - 0.5)
    right = np.where(seen, texture(front, v), texture(SIZE - back, v))
    hidden = (~raised) & (x > BLOCK[0] - RAISED - 2) & (x < BLOCK[0])
    return Pair(
        np.rint(np.where(raised, texture(x, y), texture(SIZE - x, y))).astype(np.uint16),
        np.rint(right).astype(np.uint16),
        np.where(hidden, np.nan, disparity),
    )


@pytest.fixture(scope="module")
def pair(texture) -> Pair:
    return render(texture)


def test_disparities_are_right_in_sign_and_without_bias(pair):
    found = sift_matches.match_tile(*pair)
    figures = found.figures()
    assert figures["sift_matches"] > 300
    assert abs(figures["sift_median_error_px"]) < 0.01  # a quarter of a pixel without upscaling
    assert abs(figures["sift_mean_error_px"]) < 0.02
    assert figures["sift_mean_absolute_error_px"] < 0.08
    assert figures["sift_gross_share"] < 0.01
    assert abs(figures["y_parallax_median_px"]) < 0.01
    assert figures["y_parallax_rms_px"] < 0.15
    on_block = (found.x > BLOCK[0] - 0.5) & (found.x < BLOCK[1] - 0.5)
    assert 50 < on_block.sum() < found.x.size - 50  # both levels take part
    bilinear = found.x - found.x_right - found.label_bilinear
    assert abs(np.median(bilinear[found.in_row])) < 0.01
    assert np.allclose(found.label_bilinear, plane(found.x, found.y) + RAISED * on_block, atol=1e-6)
    for edge in (BLOCK[0] - 0.5, BLOCK[1] - 0.5, BLOCK[0] - RAISED - 1.5):  # none on steps
        assert np.abs(np.rint(found.x) - edge).min() > sift_matches.WINDOW // 2


def test_a_sample_of_bands_has_the_matches_of_all_of_them_there(pair, monkeypatch):
    monkeypatch.setattr(sift_matches, "ENOUGH", 10**6)
    everything = sift_matches.match_tile(*pair)
    monkeypatch.setattr(sift_matches, "ENOUGH", 1)
    sample = sift_matches.match_tile(*pair)
    band = np.floor(everything.y + 0.5) // sift_matches.BAND
    here = band % sift_matches.EVERY == 0
    assert 0.3 < here.mean() < 0.5  # two of five bands
    for name in ("x", "y", "x_right", "y_right", "label"):
        assert np.array_equal(getattr(sample, name), getattr(everything, name)[here]), name
    assert sample.figures()["sift_mean_absolute_error_px"] == pytest.approx(
        everything.figures()["sift_mean_absolute_error_px"], rel=0.2
    )


def test_a_planted_offset_of_the_labels_is_found(pair):
    offset = -0.4
    wrong = pair._replace(disparity=pair.disparity + offset)
    figures = sift_matches.match_tile(*wrong).figures()
    assert figures["sift_matches"] > 300
    for name in ("sift_mean_error_px", "sift_median_error_px"):
        assert figures[name] == pytest.approx(-offset, abs=0.05)
    assert figures["sift_mean_absolute_error_px"] == pytest.approx(abs(offset), abs=0.05)
    assert abs(figures["y_parallax_median_px"]) < 0.01


@pytest.mark.parametrize("shift", [0.4, -2.5])
def test_a_planted_row_shift_is_found(texture, shift):
    figures = sift_matches.match_tile(*render(texture, shift)).figures()
    assert figures["y_parallax_median_px"] == pytest.approx(shift, abs=0.03)
    assert figures["y_parallax_rms_px"] == pytest.approx(abs(shift), abs=0.1)
    if abs(shift) > 1:  # rows do not correspond: nearly nothing is left for table 4
        assert figures["sift_matches"] < 30


def test_images_without_texture_and_tiles_without_labels_give_no_matches(pair):
    flat = np.full((SIZE, SIZE), 500, np.uint16)
    nothing = np.full((SIZE, SIZE), np.nan)
    for tile in ((flat, flat, pair.disparity), (pair.left, pair.right, nothing)):
        found = sift_matches.match_tile(*tile)
        assert found.x.size == 0
        figures = found.figures()
        assert figures.pop("sift_matches") == 0
        assert set(figures.values()) == {None}
        assert sift_matches.match_rows({}, found) == []
