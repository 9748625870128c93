"""Edges of roofs tell where level ground lies; without them its uncertainty admits it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from stereotruth.align.alignment import Alignment, rpc_prior
from stereotruth.align.records import PlanObservation, read_equations, write_equations
from stereotruth.align.refine import refine
from stereotruth.align.roof_edges import RoofEdges, find_roof_edges, plan_offset
from stereotruth.align.shared_errors import COMMON_M, PlanFrame, plan_slopes, with_offsets
from stereotruth.sensor.images import open_pair
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.box_scene import write_points
from ...synthetic.cameras import HEIGHT, LAT, LON, METRES
from ...synthetic.images import write_image
from ...synthetic.roofs_on_level_ground import ROOF_M, beyond, points, render, roofs
from ...synthetic.textured_pair import NONE, SIZE, TRUE, start

OFF_M = np.array([1.9, -1.3])  # by which both RPCs place the ground wrongly, east and north


def misplaced(sensor: SensorModel, metres: np.ndarray) -> np.ndarray:
    """[2, 3] of :func:`.textured_pair.start`: the error in px of a camera that is off by ``metres``
    in plan."""
    shift = plan_slopes(sensor, LON, LAT, HEIGHT) @ metres
    return np.column_stack([np.zeros((2, 2)), shift])


def error_m(sensor: SensorModel, true: SensorModel) -> np.ndarray:
    """By how much a camera puts its middle elsewhere on the ground, m to the east and north."""
    col, row = (n / 2 for n in SIZE)
    here, there = (np.array(s.localize(col, row, HEIGHT)) for s in (sensor, true))
    return (here - there) * METRES


def by_rpcs() -> Alignment:
    """RPCs that both place the ground OFF_M wrongly, and are known as RPCs are."""
    planted = start(*(misplaced(s, OFF_M) for s in TRUE), 0.0)
    fits = [replace(fit, covariance=rpc_prior(fit)) for fit in planted.fits]
    return replace(planted, left_fit=fits[0], right_fit=fits[1])


def edges_of(cloud: np.ndarray, most: int = 300) -> RoofEdges:
    found = find_roof_edges(*cloud.T, 0, most)
    return replace(found, site=np.arange(len(found)) // 4)


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("roofs")
    return [write_image(folder / f"{n}.tif", None, render(s, roofs())) for n, s in zip("lr", TRUE)]


def test_edges_stand_where_roofs_end():
    houses = roofs(3)
    found = edges_of(points(houses))
    middle, outward = ((at - (LON, LAT)) * METRES for at in (found.middle, found.outward))
    away = np.min([np.abs(beyond(roof, *middle.T)) for roof in houses], axis=0)
    assert len(found) > 25
    assert np.median(away) < 0.1 and away.max() < 0.7
    assert np.abs(found.height - HEIGHT - ROOF_M).max() < 0.1
    outside = np.min([beyond(roof, *outward.T) for roof in houses], axis=0)
    assert (outside > 0.5).all()


def test_crowns_and_hills_have_no_edges():
    cloud = points(np.zeros((0, 5)))
    rng = np.random.default_rng(1)
    east, north = (cloud[:, :2] - (LON, LAT)).T * METRES[:, None]
    for e, n in rng.uniform(-200, 200, (40, 2)):
        rise = 9.0 - 0.4 * ((east - e) ** 2 + (north - n) ** 2)
        cloud[:, 2] += np.where(rise > 2.0, rise + rng.normal(0, 1.0, east.size), 0.0)
    cloud[:, 2] += 20.0 * np.sin(east / 40.0)
    assert len(edges_of(cloud)) == 0


@pytest.mark.slow
def test_an_image_tells_how_far_its_sensor_model_is_off(images):
    edges = edges_of(points(roofs()))
    with open_pair(*images) as sources:
        for source, true in zip(sources, TRUE):
            affine = np.array(true.affine)
            affine[:, 2:] += plan_slopes(true, LON, LAT, HEIGHT) @ OFF_M[:, None]
            found = plan_offset(source, SensorModel(true.rpc, affine), edges, 4.0)
            # bright rims are drawn to neither side, as opposite edges have them alike
            assert np.abs(found.offset + OFF_M).max() < 0.15
            assert np.abs(found.halves + OFF_M).max() < 0.3
            assert found.edges > 60


def test_offsets_move_all_images_and_leave_what_binds_them():
    fits = start(NONE, NONE, 1.0).fits
    slopes = [plan_slopes(true, LON, LAT, HEIGHT) for true in TRUE]
    frame = PlanFrame.of(fits, slopes)
    bound = np.eye(12) * 1e-6 + frame.shift @ frame.shift.T * 4.0  # 2 m in common, else nothing
    assert frame.sigma(bound) == pytest.approx([2.0, 2.0], rel=1e-3)
    assert frame.sigma(frame.widened(bound, bound)) == pytest.approx([2.0 * 2**0.5] * 2, rel=1e-3)
    seen = []
    for k, (fit, px) in enumerate(zip(fits, slopes)):
        design = fit.design(SIZE[0] / 2, SIZE[1] / 2)
        seen.append((k, PlanObservation(design, px @ OFF_M, 1e-6 * np.eye(2), px)))
    moved, covariance = with_offsets(np.zeros(12), bound, seen)
    gain = 4.0 / (4.0 + COMMON_M**2)
    assert frame.mean @ moved == pytest.approx(gain * OFF_M, rel=1e-3)
    assert moved == pytest.approx(frame.shift @ (gain * OFF_M), abs=1e-2)
    assert frame.sigma(covariance) == pytest.approx([COMMON_M * gain**0.5] * 2, rel=1e-2)


@pytest.mark.slow
def test_the_place_of_level_ground_is_that_of_its_roofs(images, tmp_path):
    store = write_points(tmp_path, points(roofs()))
    refined, observations = refine(by_rpcs(), *images, [store])
    figures = refined.refinement["place_in_plan"]
    assert figures["roof_edges_used"]
    assert max(figures["sigma_m"]) < 1.5 * COMMON_M
    for sensor, true in zip((refined.left, refined.right), TRUE):
        assert np.abs(error_m(sensor, true)).max() < 0.3
    write_equations(tmp_path / "equations.json", observations.of_images, "")
    again, _ = read_equations(tmp_path / "equations.json")
    for one, other in zip(again.in_plan, observations.of_images.in_plan):
        assert all((getattr(one, name) == value).all() for name, value in vars(other).items())


@pytest.mark.slow
def test_level_ground_without_roofs_admits_what_it_cannot_tell(tmp_path):
    bare = np.zeros((0, 5))
    images = [write_image(tmp_path / f"{n}.tif", None, render(s, bare)) for n, s in zip("lr", TRUE)]
    store = write_points(tmp_path, points(bare))
    refined, _ = refine(by_rpcs(), *images, [store])
    figures = refined.refinement["place_in_plan"]
    assert not figures["roof_edges_used"] and "edges" in figures["reason"]
    sigma = np.array(figures["sigma_m"])
    assert (np.abs(error_m(refined.left, TRUE[0])) < 2.0 * sigma).all()
    assert sigma.min() > 1.0
