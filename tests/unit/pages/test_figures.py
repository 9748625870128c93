"""Axes of charts."""

from __future__ import annotations

import math

import pytest

from stereotruth.pages.figures import DASHES, SHAPES, Axis, line, look
from stereotruth.pages.pictures import SERIES


def test_a_value_stands_where_its_share_of_the_axis_is():
    assert [Axis(-1, 3, 200).at(v) for v in (-1, 0, 3, 9)] == [0, 50, 200, 200]
    assert Axis(0, 100, 260, turned=True).at(100) == 0
    log = Axis(0.1, 10, 100, log=True)
    assert [log.at(v) for v in (0.1, 1, 10)] == [0, 50, 100]


def test_small_and_large_values_of_either_sign_have_room():
    axis = Axis(-20, 20, 400, linear_to=0.1)
    assert axis.at(0) == 200
    for value in (0.05, 0.3, 2, 20):
        assert axis.at(value) - 200 == pytest.approx(200 - axis.at(-value), abs=0.1)
        expected = 200 * (1 + math.asinh(10 * value) / math.asinh(200))
        assert axis.at(value) == pytest.approx(expected, abs=0.1)
    assert [text for _, text in axis.ticks()] == ["−10", "−1", "−0.1", "0", "0.1", "1", "10"]


def test_ticks_stand_at_their_numbers():
    for axis in (Axis(0, 100, 260), Axis(0.05, 20, 460, log=True), Axis(0.2, 3, 90, log=True)):
        ticks = axis.ticks()
        assert 3 <= len(ticks) <= 8
        for place, text in ticks:
            assert place == axis.at(float(text))


def test_series_differ_in_more_than_colour():
    looks = [look(k) for k in range(len(SERIES))]
    for kind in zip(*looks):
        assert len(set(kind)) == len(SERIES) == len(DASHES) == SHAPES


def test_a_line_goes_through_its_points():
    assert line(Axis(0, 1, 10), Axis(0, 1, 10, turned=True), [(0, 0), (1, 0.5)]) == "M0 10L10 5"
