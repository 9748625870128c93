"""What both images tell of labels, on small made fields whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.epipolar.window_sums import BLOCK
from stereotruth.labels.change_evidence import (
    EVIDENCE_PX,
    FAR_PX,
    OFF_SHARE,
    Evidence,
    LabelledWindow,
    change_evidence,
)
from stereotruth.labels.pair_window import Labels, PairWindow, read_patch

from ...synthetic.textured_fields import (
    ALL,
    COLS,
    FIELD,
    GROUND,
    LEVEL,
    ROWS,
    SHAPE,
    built,
    pair,
    texture,
)

INNER = np.s_[20:-20, 20:-20]


def evidence_of(
    window: PairWindow, labels: Labels = LEVEL, classes: np.ndarray = GROUND
) -> tuple[np.ndarray, Evidence]:
    """Of images without noise."""
    return change_evidence(LabelledWindow(window, labels, ALL, classes, (0.0, 0.0)))


def test_evidence_is_of_the_pixels_that_do_not_agree_fully() -> None:
    doubtful, evidence = evidence_of(built())
    assert doubtful[FIELD].mean() > 0.95
    assert not doubtful[20:25, 20:120].any()
    assert all(values.shape == (doubtful.sum(),) for values in evidence)
    inside = np.zeros(SHAPE, np.bool_)
    inside[48:72, 58:92] = True  # no window reaches beyond the roof
    of_roof = Evidence(*(values[inside[doubtful]] for values in evidence))
    assert np.abs(of_roof.agreement).max() < 0.2
    assert (of_roof.from_step == FAR_PX).all() and (of_roof.slope == 0.0).all()
    # uniform of half a width of 50 DN, in units of the rounding; three times as bright
    expected = 50.0 / np.sqrt(3.0) * np.sqrt(12.0)
    assert np.median(of_roof.contrast_left) == pytest.approx(expected, rel=0.1)
    assert np.median(of_roof.contrast_right) == pytest.approx(3.0 * expected, rel=0.1)


def test_evidence_is_the_same_in_any_window() -> None:
    """Labels with gaps, which the runs of a wide window end in or bridge as it begins."""
    rng, shape = np.random.default_rng(6), (60, 3 * BLOCK)
    left, other = rng.uniform(450.0, 550.0, (2, shape[0], shape[1] + 160)).round()
    right = np.roll(left, -4, axis=1)
    right[20:40] = other[20:40]
    labelled, every = rng.uniform(size=shape) < 0.7, slice(0, left.shape[1])

    def within(rows: slice, cols: slice) -> np.ndarray:
        """All evidence [k, h, w] of a part, NaN for none."""
        level = np.full((rows.stop - rows.start, cols.stop - cols.start), 4.0)
        there = slice(cols.start + 80, cols.stop + 80)
        patches = read_patch(left, rows, there, 1), read_patch(right, rows, every, 1)
        labels = Labels(level, np.zeros((2, *level.shape)), np.zeros_like(level))
        doubtful, evidence = change_evidence(
            LabelledWindow(
                PairWindow(rows, there, 0, *patches),
                labels,
                labelled[rows, cols],
                np.full(level.shape, 2, np.uint8),
                (0.0, 0.0),
            )
        )
        out = np.full((len(evidence), *doubtful.shape), np.nan, np.float32)
        out[:, doubtful] = evidence
        return out

    inner = slice(EVIDENCE_PX, -EVIDENCE_PX)
    whole = within(slice(0, shape[0]), slice(0, shape[1]))
    for first in range(1, 40, 9):
        part = slice(0, shape[0]), slice(first, shape[1])
        found = within(*part)[:, inner, inner]
        assert np.isfinite(found).any()
        assert np.array_equal(found, whole[:, *part][:, inner, inner], equal_nan=True)


def test_steps_of_the_surface_are_told_by_their_distance() -> None:
    level = np.full(SHAPE, 4.0)
    level[:, 80:] = 9.0
    images = pair(texture(0), texture(1))
    labels = Labels(level, np.zeros((2, *SHAPE)), np.zeros(SHAPE))
    doubtful, evidence = evidence_of(images, labels)
    at = np.full(SHAPE, np.nan)
    at[doubtful] = evidence.from_step
    found = [at[60, x] for x in (80, 81, 84, 88, 95)]
    assert found == [0, 1, 4, 8, 8]


def test_difference_is_counted_in_standard_deviations() -> None:
    """A pixel of twice the brightness on even ground, where the right image is twice as bright."""
    left, right = np.full((160, 260), 500.0), np.full((160, 260), 1000.0)
    left[ROWS, COLS][60, 70] = 1000.0
    doubtful, evidence = evidence_of(pair(left, right))
    at = np.full((3, *SHAPE), np.nan)
    at[:, doubtful] = evidence[4:7]
    # the ratio of the means up to 16 px off: one pixel in 81 every 4 px is twice as bright
    ratio, variance = 500.0 * 82 / 81 / 1000.0, (OFF_SHARE * 1000.0) ** 2 + 1 / 6
    expected = (1000.0 - 1000.0 * ratio) / np.sqrt(variance)
    assert at[0, 60, 70] == pytest.approx(expected, rel=1e-3)
    others = [(500.0 - 1000.0 * ratio), (500.0 - 500.0)]
    assert at[0, 60, 72] == pytest.approx(others[1], abs=1e-3)
    assert at[1, 60, 70] == pytest.approx(expected / 9, rel=0.15)
    assert at[2, 60, 70] == pytest.approx(expected / 25, rel=0.25)


def test_what_the_lidar_shows_is_evidence() -> None:
    """A small crown: vegetation there, young ground up to 3 px around; a wood is not young."""
    classes = GROUND.copy()
    classes[60:63, 70:73] = classes[20:40, 20:40] = 5
    doubtful, evidence = evidence_of(pair(texture(0), texture(1)), classes=classes)
    vegetation, young = np.zeros((2, *SHAPE))
    vegetation[doubtful], young[doubtful] = evidence.vegetation, evidence.young
    assert np.array_equal(vegetation[INNER] == 1, (classes == 5)[INNER] & doubtful[INNER])
    assert young[57:66, 67:76].mean() > 0.9
    young[57:66, 67:76] = 0
    assert not young.any()
