"""Strips of a LiDAR: told apart, compared, named and moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.lattice import Footprint
from stereotruth.lidar.point_store import STRIPS, PointStore
from stereotruth.lidar.strip_comparison import compare_strips
from stereotruth.lidar.strips import StripOffsets, move_strips

from ...synthetic.stores import content_of
from ...synthetic.strips import OFFSETS, stores

HEIGHT_M, PLAN_M = 0.01, 0.08  # that offsets are to be right to


def offsets_of(found: StripOffsets) -> dict[str, np.ndarray]:
    return {strip.name: np.array(strip.offset_m) for strip in found.strips}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> list[PointStore]:
    return stores(tmp_path_factory.mktemp("strips"))


@pytest.mark.parametrize("told", ["source", "time", "edges"])
def test_offsets_are_found_whatever_tells_the_strips(tmp_path, told):
    """Strips that run through two files are one strip each; by edges those of one file."""
    found = compare_strips(stores(tmp_path, told=told, halves=told != "edges"))
    assert len(found.strips) == 3 and len(found.named) == 2
    of = offsets_of(found)
    first, *others = sorted(of, key=lambda name: int("".join(filter(str.isdigit, name))))
    for number, name in enumerate(others, 1):
        miss = of[name] - of[first] - (OFFSETS[number] - OFFSETS[0])
        assert np.abs(miss[:2]).max() < PLAN_M and abs(miss[2]) < HEIGHT_M
    for strip in found.named:
        assert str(strip) in found.sentence


def test_order_and_cut_of_the_files_play_no_part(made, tmp_path):
    found = compare_strips(made)
    again = compare_strips(made[::-1])
    assert found.to_dict() == again.to_dict() and np.array_equal(found.shares, again.shares)
    whole = compare_strips(stores(tmp_path, halves=False))
    assert whole.to_dict() == found.to_dict()


def test_strips_that_agree_or_are_one_or_do_not_overlap_are_not_named(tmp_path, monkeypatch):
    found = compare_strips(stores(tmp_path / "agree", np.zeros((3, 3))))
    assert not found.named and not found.sentence
    for strip in found.strips:
        assert abs(strip.offset_m[2]) < HEIGHT_M and strip.chance > 0.01
    found = compare_strips(stores(tmp_path / "one", told="nothing"))
    assert found.report() is None and not found.sentence
    assert not (tmp_path / "one" / "south.points" / STRIPS).exists()
    monkeypatch.setattr("tests.synthetic.strips.STEP", 130.0)
    found = compare_strips(stores(tmp_path / "apart"))
    assert len(found.strips) == 3 and not found.named
    assert {strip.tied_to for strip in found.strips} == {""}


def test_moved_points_agree(made, tmp_path):
    found = compare_strips(made)
    moved = []
    for store in made:
        move_strips(store.path, found, tmp_path / store.path.name)
        moved.append(PointStore(tmp_path / store.path.name))
        assert moved[-1].count == store.count
    again = compare_strips(moved)
    assert not again.named
    for strip in again.strips:
        assert np.hypot(*strip.offset_m[:2]) < PLAN_M and abs(strip.offset_m[2]) < HEIGHT_M


def test_a_record_is_read_as_it_was_written(made, tmp_path):
    found = compare_strips(made)
    found.write(tmp_path / "a.strips")
    read = StripOffsets.read(tmp_path / "a.strips")
    assert read.to_dict() == found.to_dict() and np.array_equal(read.shares, found.shares)
    rows = read.report()["strips"]
    assert sum(row["beyond_noise"] for row in rows) == 2 and rows[0]["off"] == rows[0]["strip"]
    # how far strips are off in plan, from the mean of all by their ground
    ground = np.array([strip.ground_m2 for strip in read.strips])
    plan = OFFSETS[[int(strip.name) - 7320 for strip in read.strips], :2]
    far = np.hypot(*(plan - ground @ plan / ground.sum()).T).max()
    assert abs(read.most_in_plan_m - far) < PLAN_M
    assert replace(read, taken_out=True).most_in_plan_m == 0.0


def test_a_part_of_a_file_has_the_strips_of_the_whole(made, tmp_path):
    """Whatever of a file is read, a point has the code that it has in all of it."""
    west, south, east, north = made[0].bounds[:4]
    corners = np.array([[west, east, east, west], [south, south, north, north]])
    corners[0] = west + (corners[0] - west) / 4
    footprint = Footprint.around([corners], 0.0)
    ingest(made[0].path.with_suffix(".las"), tmp_path / "part.points", footprint=footprint)
    part, whole = PointStore(tmp_path / "part.points"), made[0]
    assert part.count < whole.count
    for cell, (row, col) in enumerate(zip(part.cell_row, part.cell_col)):
        of_whole = np.flatnonzero((whole.cell_row == row) & (whole.cell_col == col))[0]
        assert np.array_equal(part.strips_of(cell), whole.strips_of(int(of_whole)))


def test_damaged_strips_are_refused(made, tmp_path):
    store = PointStore(made[0].path)
    assert content_of(store)
    file = store.path / STRIPS
    data = file.read_bytes()
    try:
        file.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        with pytest.raises(InputError) as error:
            store.strips_of(store.cell_row.size - 1)
        assert error.value.file == str(file)
        file.unlink()
        with pytest.raises(InputError):
            PointStore(store.path).strips_of(0)
    finally:
        file.write_bytes(data)
