"""The surface of a site: the same bytes however it is made, and no more than images show."""

from __future__ import annotations

import numpy as np
import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import Strip
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.lattice import LATTICE_DEG, Footprint
from stereotruth.lidar.point_store import PointStore, open_stores
from stereotruth.surface import make_surface as module
from stereotruth.surface.delaunay import MAX_PARTS
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import PART, SurfaceScale
from stereotruth.surface.surface_store import GROUPS, TRIANGLES, Region, SurfaceStore

from ...synthetic.box_scene import points_on, write_points
from ...synthetic.las import write_las
from ...synthetic.stores import tree_digest

CELL = (3400, 2900)


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch) -> None:
    """So that a small scene has many."""
    monkeypatch.setattr(module, "block_side", lambda scale: 128)


@pytest.fixture(scope="module")
def stores(tmp_path_factory) -> tuple[PointStore, ...]:
    """A plane and a box on it by points 1 m apart with noise, in two files."""
    folder = tmp_path_factory.mktemp("points")
    points = points_on(True, noise=0.03, spacing=1.0)
    east = points[:, 0] > np.median(points[:, 0])
    return open_stores(
        [write_points(folder, points[east], "east"), write_points(folder, points[~east], "west")]
    )


class East:
    """Images that show what lies east of a longitude."""

    def __init__(self, lon: float) -> None:
        self.lon = lon

    def shows(self, lon, lat, height):
        return lon > self.lon

    def may_show(self, boxes):
        return boxes[:, 3] > self.lon

    def box(self, heights):
        return self.lon, 30.0, self.lon + 0.01, 30.01


def positions(store: SurfaceStore, block) -> np.ndarray:
    """Lattice longitude, latitude, height [n, 3] of a block's vertices."""
    own = store.vertices(block)
    lon, lat = (
        own[name] + np.int64(number * store.side * size)
        for name, number, size in zip(("lon", "lat"), (block.col, block.row), store.scale.cell)
    )
    return np.stack([lon, lat, own["height"]], axis=1).astype(np.int64)


def triangles(store: SurfaceStore) -> dict[str, set]:
    """All triangles of a surface by the lattice positions of their vertices, with their values."""
    found = {name: set() for name in TRIANGLES}
    for block in store.every:
        counts = store.vertices(block)["count"].astype(np.int64)
        corners = np.column_stack([positions(store, block), counts])
        for name, columns in store.triangles(block).items():
            corner, *beside = columns.values()
            for k, triangle in enumerate(corner):
                told = tuple(values[k].tobytes() for values in beside)
                found[name].add((corners[triangle].tobytes(), *told))
    return found


@pytest.mark.slow
def test_triangles_are_the_same_for_any_blocks(stores, tmp_path, monkeypatch):
    make_surface(stores, tmp_path / "one", cell=CELL)
    one = SurfaceStore(tmp_path / "one")
    expected = triangles(one)
    assert all(expected.values())
    for side in (64, 1024):
        monkeypatch.setattr(module, "block_side", lambda scale, side=side: side)
        make_surface(stores, tmp_path / f"{side}", cell=CELL)
        other = SurfaceStore(tmp_path / f"{side}")
        assert len(other.every) > 3 * len(one.every) or len(other.every) <= 4
        assert triangles(other) == expected
        total = sum(len(other.triangles(block)["facets"]["corner"]) for block in other.every)
        assert total == len(expected["facets"])  # each triangle once


@pytest.mark.slow
def test_bytes_are_the_same_for_any_groups_workers_and_order(stores, tmp_path):
    ways = {"a": (stores, 1, 1), "b": (stores[::-1], 3, 2), "c": (stores, 2, 16)}
    for name, (made_of, workers, at_once) in ways.items():
        out = tmp_path / name / "s"
        make_surface(made_of, out, cell=CELL, workers=workers, blocks_at_once=at_once)
    one, *others = (SurfaceStore(tmp_path / name / "s").every for name in ways)
    assert len(one) > 16 and all(one == other for other in others)  # with their checksums
    groups = [len(list((tmp_path / name / "s" / GROUPS).iterdir())) for name in ways]
    assert groups[0] == len(one) > groups[1] > groups[2]


@pytest.mark.slow
def test_strips_make_each_group_once_and_change_no_byte(stores, tmp_path, monkeypatch):
    """There is no store before the last job, which joins what strips have made, and makes none."""
    made, whole = [], module._Maker.make
    monkeypatch.setattr(
        module._Maker, "make", lambda self, *of: (made.append(of[0]), whole(self, *of))
    )
    for count in (1, 2, 3):
        out, made_by = tmp_path / f"{count}" / "s", []
        for number in reversed(range(count if count > 1 else 0)):
            make_surface(stores, out, cell=CELL, blocks_at_once=4, strip=Strip(number, count))
            made_by.append(sum(map(len, made)) - sum(made_by))
            assert not out.exists()
        before = len(made)
        make_surface(stores, out, cell=CELL, blocks_at_once=4)
        assert len(made) == (before if count > 1 else len(set(made))) > 3
        assert not made_by or 2 * min(made_by) > max(made_by)  # blocks of each
        made.clear()
    assert len({tree_digest(tmp_path / f"{count}" / "s") for count in (1, 2, 3)}) == 1


@pytest.mark.slow
def test_finished_blocks_are_taken_over(stores, tmp_path, monkeypatch):
    def make(out, most):
        made, whole = [], module._Maker.make

        def one(self, group, parts, key, done):
            if len(made) == most:
                raise KeyboardInterrupt
            made.append(group)
            whole(self, group, parts, key, done)

        monkeypatch.setattr(module._Maker, "make", one)
        try:
            make_surface(stores, out, cell=CELL, blocks_at_once=1)
        finally:
            monkeypatch.setattr(module._Maker, "make", whole)
        return len(made)

    every = make(tmp_path / "fresh/s", 1000)
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "killed/s", 3)
    assert not (tmp_path / "killed/s").exists()
    assert make(tmp_path / "killed/s", 1000) == every - 3
    assert tree_digest(tmp_path / "killed/s") == tree_digest(tmp_path / "fresh/s")


def test_points_that_no_image_shows_count_for_nothing(stores, tmp_path):
    """A dense survey a kilometre off changes neither scale nor a byte of what is shown."""
    west = min(store.bounds[0] for store in stores)
    far = points_on(False, spacing=0.4) - [0.011, 0.0, 0.0]
    more = (*stores, *open_stores([write_points(tmp_path, far, "far")]))
    shown = East(west - 1e-4)
    for name, made_of in (("alone", stores), ("beside", more)):
        make_surface(made_of, tmp_path / name, cell=CELL, ground=shown)
    alone, beside = (SurfaceStore(tmp_path / name) for name in ("alone", "beside"))
    assert alone.scale == beside.scale and alone.every == beside.every
    make_surface(more, tmp_path / "all", cell=CELL)
    assert SurfaceStore(tmp_path / "all").scale.spacing < alone.scale.spacing


def test_half_of_the_ground_has_the_triangles_of_all_there(stores, tmp_path):
    """Blocks on the edge of what is shown have a part of their triangles, the others all."""
    middle = max(store.bounds[2] for store in stores) - 3e-4
    for name, ground in (("all", None), ("half", East(middle))):
        make_surface(stores, tmp_path / name, cell=CELL, ground=ground)
    every, half = (SurfaceStore(tmp_path / name) for name in ("all", "half"))
    assert every.scale == half.scale
    whole, cut = set(half.every) & set(every.every), set(half.every) - set(every.every)
    assert whole and cut and len(half.every) < len(every.every)
    assert {block[:2] for block in cut} < {block[:2] for block in every.every}
    assert min(b.box[2] for b in half.every) * LATTICE_DEG > middle - 0.002
    reach = half.scale.height_reach / PART * CELL[0] * LATTICE_DEG
    of_all, of_half = (
        {facet for facet in facets_of(store) if facet[0][0] > middle + reach}
        for store in (every, half)
    )
    assert of_all == of_half and of_all


def facets_of(store: SurfaceStore) -> set[tuple]:
    """Each facet as its vertices (lon, lat, degrees; height, steps), with its figures."""
    found = set()
    for block in store.every:
        vertices = (positions(store, block) * [LATTICE_DEG, LATTICE_DEG, 1]).tolist()
        corner, *figures = (values.tolist() for values in store.triangles(block)["facets"].values())
        for three, *beside in zip(corner, *figures):
            found.add((*(tuple(vertices[k]) for k in three), *beside))
    return found


def test_a_damaged_block_is_named(stores, tmp_path):
    make_surface(stores, tmp_path / "s", cell=CELL)
    store = SurfaceStore(tmp_path / "s")
    file = min((tmp_path / "s" / GROUPS).iterdir())
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.unlink()
    file.write_bytes(data)
    with pytest.raises(InputError, match=file.name):
        for block in store.every:
            store.window([block]).surface(Region(np.ones((99, 99), np.bool_)))


@pytest.mark.parametrize("density", [0.01, 0.25, 1.0, 15.0])
def test_groups_are_wide_against_their_halo(density, monkeypatch):
    monkeypatch.undo()
    scale = SurfaceScale.of(density, CELL)
    side = module.block_side(scale)
    group = side * module.group_blocks(scale, side)
    assert side & (side - 1) == group & (group - 1) == 0
    assert group >= 12 * scale.halo_cells or group == 4096
    assert group + 2 * scale.halo_cells < MAX_PARTS // PART


def test_points_that_no_image_shows_are_refused(stores, tmp_path):
    """As of a file of another place, of which ingest has kept none: where it lies is known."""
    write_las(tmp_path / "a.las")
    elsewhere = Footprint.around([np.array([[10.0, 10.01, 10.0], [50.0, 50.0, 50.01]])], 50.0)
    ingest(tmp_path / "a.las", tmp_path / "a", footprint=elsewhere)
    empty = PointStore(tmp_path / "a")
    assert not empty.attrs["points"]["kept"]
    for found in (stores, (empty,)):
        words = r"the LiDAR covers longitude .* the images longitude .*Remedy"
        with pytest.raises(InputError, match=words):
            make_surface(found, tmp_path / "s", cell=CELL, ground=East(170.0))
    assert not (tmp_path / "s").exists()
