"""Projection of points on a textured plane with a box: disparity and hidden parts are known."""

from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pyproj
import pytest
import zarr

import stereotruth.labels.recipe as module
from stereotruth.align.label_uncertainty import label_covariance
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import open_grid
from stereotruth.core.status import Reason, Status, is_labelled
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.labels.pair_window import Labels
from stereotruth.labels.pixel_labels import RIDGE, facet_labels
from stereotruth.labels.project import FAR_BEYOND, project_scene
from stereotruth.labels.recipe import label_window
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore, query_points

from ...synthetic.box_scene import (
    ROOF,
    UTM,
    Scene,
    alignment_of,
    dilated,
    hidden_truth,
    image_of,
    project_with,
    seen,
    write_image,
    write_points,
)
from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, METRES
from ...synthetic.las import write_las
from ...synthetic.stores import tree_digest


@pytest.fixture(scope="module")
def plane(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("plane"), box=False)


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("box"), box=True)


@pytest.fixture(scope="module")
def noisy_box(tmp_path_factory) -> Scene:
    return Scene(tmp_path_factory.mktemp("noisy"), box=True, noise=0.1)


@pytest.mark.parametrize("recipe", ["surface", "paper"])
def test_disparity_of_a_plane(plane, recipe) -> None:
    """Within 1e-3 px at every pixel's centre; all labelled but a frame of 2 px, or of half a window
    where whole windows are compared."""
    grid = plane.project(recipe=recipe)
    disparity, status = grid["disparity"].values, grid["status"].values
    labelled = is_labelled(status)
    assert np.array_equal(labelled, np.isfinite(disparity))
    assert np.abs(disparity - plane.truth)[labelled].max() < 1e-3
    has_points = status != Status.NO_POINTS
    inner = has_points & (plane.truth > -np.inf)
    edge = (6 if recipe == "paper" else 2) + int(np.ceil(np.abs(plane.truth).max()))
    inner[:edge] = inner[-edge:] = inner[:, :edge] = inner[:, -edge:] = False
    assert inner.sum() > 30_000
    assert labelled[inner].mean() > 0.999
    correlation = grid["correlation"].values[labelled]
    assert np.nanmedian(correlation) > 0.99
    assert np.isfinite(correlation).mean() > 0.98  # not where the images end


def brute_force(scene: Scene, on_surface: bool) -> dict[tuple[int, int], tuple[float, float, int]]:
    """Disparity, height and count by pixel, point by point in Python from the definition.

    With ``on_surface``, only pixels around which all points are of one surface.
    """
    points = query_points([PointStore(scene.store)], -180, -90, 180, 90)
    xy = scene.model.ground_to_epipolar(points.lon, points.lat, points.height)
    steps = np.rint(xy * 65536) / 65536  # as places are added up
    steps = np.stack([steps[0], steps[1], steps[0] - steps[2]])
    pixels: dict[tuple[int, int], list[int]] = {}
    for k, (x, y) in enumerate(zip(xy[0], xy[1])):
        pixels.setdefault((int(np.floor(y + 0.5)), int(np.floor(x + 0.5))), []).append(k)

    def place(members: list[int], height: float) -> np.ndarray:
        ground = points.lon[members].mean(), points.lat[members].mean(), height
        x, y, x_right, _ = scene.model.ground_to_epipolar(*ground)[:, 0]
        return np.array([x, y, x - x_right])

    found = {}
    for (row, col), members in pixels.items():
        if not 110 < row < 200 or not 90 < col < 220:
            continue
        highest = float(points.height[members].max())
        if not on_surface:
            found[row, col] = float(place(members, highest)[2]), highest, len(members)
            continue
        blocks = [
            pixels.get((r, c), []) for r in range(row - 3, row + 4) for c in range(col - 3, col + 4)
        ]
        if min(len(block) for block in blocks) == 0:
            continue
        around = [k for block in blocks for k in block]
        if np.ptp(xy[0, around] - xy[2, around]) > 0.9:
            continue
        near = [pixels[r, c] for r in range(row - 1, row + 2) for c in range(col - 1, col + 2)]
        places = np.array([steps[:, m].mean(axis=1) for m in near])
        here = places[4]
        centred = places - places.mean(axis=0)
        normal = centred[:, :2].T @ centred[:, :2] + RIDGE * np.eye(2)
        slope = np.linalg.solve(normal, centred[:, :2].T @ centred[:, 2])
        label = here[2] + slope @ (np.array([col, row]) - here[:2])
        found[row, col] = float(label), highest, len(members)
    return found


def labels_of_own_points(scene: Scene, monkeypatch) -> tuple[Labels, dict[str, np.ndarray]]:
    """What each pixel's own points give on the surface that its centre sees, before triangles of
    points around it are asked, and the layers of the grid."""
    recorded = []

    def record(visible, own, *rest):
        recorded.append(own.labels)
        return facet_labels(visible, own, *rest)

    monkeypatch.setattr(module, "facet_labels", record)
    inputs = scene.inputs(LabelSettings())
    rows, cols = scene.model.shape
    layers, _ = label_window(inputs, slice(0, rows), slice(0, cols))
    margin = inputs.margin + inputs.image_margin
    inner = (slice(margin, -margin),) * 2
    own = recorded[0]
    return Labels(own.disparity[inner], own.slope[:, *inner], own.variance[inner]), layers


@pytest.mark.parametrize("recipe", ["surface", "paper"])
def test_point_of_a_pixel_is_that_of_its_definition(noisy_box, recipe, monkeypatch) -> None:
    """Points of 0.1 m noise on plane and roof, none dropped, against sums in Python: 2e-5 px, as
    places of points are whole steps of 2**-16 px."""
    if recipe == "surface":
        own, layers = labels_of_own_points(noisy_box, monkeypatch)
        disparity, height, count = own.disparity, layers["height"], layers["point_count"]
    else:
        grid = noisy_box.project(recipe="paper", correlation_threshold=-1)
        disparity, height, count = (
            grid[name].values for name in ("disparity", "height", "point_count")
        )
    expected = brute_force(noisy_box, recipe == "surface")
    assert len(expected) > 4000
    for pixel, (d, h, n) in expected.items():
        if recipe == "surface" and np.isnan(disparity[pixel]):  # these points cannot win
            continue
        assert disparity[pixel] == pytest.approx(d, abs=2e-5)
        if np.isfinite(height[pixel]):  # layers know the pixels that end with a label of their own
            assert height[pixel] == pytest.approx(h, abs=1e-4)
            assert count[pixel] == n
    assert np.mean([np.isfinite(height[pixel]) for pixel in expected]) > 0.85
    assert np.mean([np.isfinite(disparity[pixel]) for pixel in expected]) > 0.85


@pytest.mark.parametrize("only_in", ["lidar", "images"])
def test_building_in_one_world_only_is_masked_as_changed(
    plane, box, only_in, tmp_path, caplog
) -> None:
    """What LiDAR and images do not share has no label; its surroundings keep theirs. The summary
    says how far what the images show lies from what was learned, and the log where it is far."""
    if only_in == "lidar":
        shown, scanned = plane, box
        there = box.surface[2] == ROOF
    else:
        shown, scanned = box, plane
        there = (box.surface[2] > HEIGHT) & (np.abs(box.truth - plane.truth) > 1)
    summary = project_with(*shown.images, [scanned.store], tmp_path / "out.zarr")
    status = open_grid(tmp_path / "out.zarr")["status"].values
    changed = status == Status.CHANGED
    assert changed.sum() <= summary["asked"] < (is_labelled(status) | changed).sum()
    for name, share in summary["beyond_learned"].items():
        assert 0.0 <= share <= 1.0
        assert (f"{name} at" in caplog.text) == (share > FAR_BEYOND)
    labelled = status == Status.LABELLED
    inner = there & ~dilated(~there, 2)
    assert inner.sum() > 1000
    # The ground where a building is missing goes on around it, and votes near the border.
    assert labelled[inner].mean() < (0.02 if only_in == "lidar" else 0.1)
    assert (status == Status.CHANGED)[inner].mean() > 0.9
    reach = int(np.ptp(box.truth[np.isfinite(box.truth)])) + 8
    away = ~dilated(box.surface[2] > HEIGHT, 16)
    away[:, : 2 * reach] = away[:, -reach:] = away[:reach] = away[-reach:] = False
    hidden = hidden_truth(box)
    clear = away & ~dilated(hidden, 16) & (status != Status.NO_POINTS)
    assert labelled[clear].mean() > 0.995
    without = project_and_open(
        scanned,
        tmp_path / "same",
        *(zarr.open_group(path)["image"][:] for path in scanned.images),
    )
    assert not (without["status"].values == Status.CHANGED).any()


def test_right_view_has_its_own_labels(box) -> None:
    """Against the rays of the right camera; and both views name each other's pixels."""
    east, north, height = seen(box.model, "right", box=True)
    lon, lat = LON + east / METRES[0], LAT + north / METRES[1]
    xy = box.model.ground_to_epipolar(lon, lat, height)
    truth = (xy[0] - xy[2]).reshape(box.model.shape)
    right = box.project("of_right.zarr", view="right")
    left = box.project("of_left.zarr")
    disparity, status = right["disparity"].values, right["status"].values
    labelled = np.isfinite(disparity)
    surface = np.isin(height, (HEIGHT, ROOF))
    assert (np.abs(disparity - truth) < 1e-3)[labelled & surface].mean() > 0.999
    inner = surface.copy()
    edge = 10 + int(np.ceil(np.abs(box.truth).max()))
    inner[:edge] = inner[-edge:] = inner[:, :edge] = inner[:, -edge:] = False
    assert labelled[inner].mean() > 0.9
    assert right["disparity"].attrs["match"].endswith("(x + disparity, y)")
    # Where the left image shows the box at the place of ground that the right one sees:
    x = np.clip(np.rint(np.arange(truth.shape[1]) + truth), 0, truth.shape[1] - 1).astype(int)
    in_left = np.take_along_axis(box.surface[2], x, axis=1)
    hidden = (height == HEIGHT) & (in_left > HEIGHT)
    assert hidden.sum() > 150
    assert labelled[hidden].mean() < 0.1
    wall = (height > HEIGHT) & (height < ROOF)
    assert labelled[wall & ~dilated(~wall)].mean() < 0.01
    assert (status[hidden] == Status.HIDDEN_IN_LEFT).mean() > 0.5
    rows, cols = np.nonzero(labelled)
    there = np.rint(cols + disparity[rows, cols]).astype(int)
    ok = (there >= 0) & (there < left.sizes["x"])
    back = left["disparity"].values[rows[ok], there[ok]]
    both = np.isfinite(back)
    assert both.mean() > 0.9
    assert (np.abs(back - disparity[rows[ok], cols[ok]])[both] < 0.05).mean() > 0.99


def test_water_is_masked_as_changed(plane, tmp_path) -> None:
    to_utm = pyproj.Transformer.from_crs("EPSG:4979", UTM, always_xy=True)
    points = plane.points
    water = (points[:, 0] > LON).astype(np.uint8) * 9
    write_las(
        tmp_path / "water.las",
        xyz=np.column_stack(to_utm.transform(*points.T)),
        classification=water,
    )
    ingest(tmp_path / "water.las", tmp_path / "water.points")
    project_with(*plane.images, [tmp_path / "water.points"], tmp_path / "out.zarr")
    grid = open_grid(tmp_path / "out.zarr")
    status, east = grid["status"].values, plane.surface[0]
    assert not (status == Status.LABELLED)[east > 1.0].any()
    assert not (status == Status.CHANGED)[east < -1.0].any()
    assert (grid["surface_class"].values == 0).all()
    change = np.where(status == Status.CHANGED, Reason.WATER, Reason.NONE)
    assert change.any() and np.array_equal(grid["change"].values, change)


def test_all_bytes_are_the_same_in_any_order(box, tmp_path, monkeypatch) -> None:
    """Workers, windows, order of stores and of points leave no trace."""
    middle = LON + 3.0 / METRES[0]
    west = box.points[box.points[:, 0] < middle]
    east = box.points[box.points[:, 0] >= middle]
    shuffled = np.random.default_rng(3).permutation(west)
    first = [write_points(tmp_path / "first", p, n) for p, n in ((west, "a"), (east, "b"))]
    second = [write_points(tmp_path / "second", p, n) for p, n in ((shuffled, "a"), (east, "b"))]
    digests = set()
    for number, (stores, options) in enumerate(
        [
            (first, {"workers": 1}),
            (first[::-1], {"workers": 2}),
            (second, {"scheduler": "sync"}),
        ]
    ):
        if number == 2:  # in strips of rows
            monkeypatch.setattr("stereotruth.labels.window_points.MOST_POINTS", 20_000)
        box.project(f"{number}.zarr", stores, **options)
        digests.add(tree_digest(box.folder / f"{number}.zarr"))
    assert len(digests) == 1


def test_blocks_can_go_to_other_processes(plane) -> None:
    """A block's task is made of plain values, whatever has been opened before."""
    scene = plane.inputs(LabelSettings())
    window = slice(100, 140), slice(120, 170)
    first = label_window(scene, *window)
    second = label_window(pickle.loads(pickle.dumps(scene)), *window)
    assert len(pickle.dumps(scene)) < 2000
    for name, layer in first[0].items():
        assert np.array_equal(layer, second[0][name], equal_nan=True)


@pytest.mark.slow
def test_edge_margin_trades_labels_for_certainty(box) -> None:
    """Wider margins leave fewer labels and none of the wrong surface."""
    shares, wrong, edges = [], [], []
    for margin in (0.0, 0.1, 0.25, 0.5):
        grid = box.project(edge_margin_px=margin)
        disparity = grid["disparity"].values
        known = np.isfinite(disparity) & np.isin(box.surface[2], (HEIGHT, ROOF))
        shares.append(known.mean())
        wrong.append(int((np.abs(disparity - box.truth)[known] > 1).sum()))
        edge = grid["status"].values == Status.EDGE_IN_PIXEL
        edges.append(int(edge.sum()))
        assert np.isnan(disparity[edge]).all()
    assert edges == sorted(edges)
    assert shares == sorted(shares, reverse=True)
    assert wrong == sorted(wrong, reverse=True)
    assert wrong[-1] == 0


def test_reasons_and_their_order(plane) -> None:
    """Nodata in either image, constant windows, too few points."""
    model = plane.model
    left = zarr.open_group(plane.images[0])["image"][:]
    right = zarr.open_group(plane.images[1])["image"][:]
    flat = right.copy()
    flat[:] = 700
    folder = plane.folder / "others"
    grid = project_and_open(plane, folder / "flat", left, flat, recipe="paper")
    assert not (grid["status"].values == Status.LABELLED).any()
    assert (grid["status"].values == Status.LOW_CORRELATION).sum() > 30_000

    holed = left.copy()
    holed[100:110, 150:170] = 0
    grid = project_and_open(plane, folder / "holed", holed, right, recipe="paper")
    status = grid["status"].values
    # The window reaches 4 px to all sides, and one more for the interpolation.
    assert (status[96:114, 146:174] == Status.OUT_OF_FRAME).all()
    assert (status[90:120, 140:180] == Status.LABELLED)[[0, -1]].all()
    count = grid["point_count"].values
    assert (count[status == Status.OUT_OF_FRAME] == 0).all()

    paper = {"recipe": "paper", "correlation_threshold": -1}
    grid = project_and_open(plane, folder / "few", left, right, min_points=4, **paper)
    status, count = grid["status"].values, grid["point_count"].values
    assert (count[status == Status.LABELLED] >= 4).all()
    few = status == Status.BELOW_MINIMUM_COUNT
    assert few.any() and ((count[few] > 0) & (count[few] < 4)).all()
    assert np.isnan(grid["disparity"].values[few]).all()
    assert model.shape == status.shape

    grid = project_and_open(plane, folder / "between", left, right, min_points=4)
    status, count = grid["status"].values, grid["point_count"].values
    assert is_labelled(status[few]).mean() > 0.99
    # The recipes differ in the points that they count, at a few edges of pixels alone.
    assert (status[few] == Status.LABELLED_BETWEEN).mean() > 0.99
    assert (count[status == Status.LABELLED] >= 4).all()
    assert (count[status == Status.LABELLED_BETWEEN] == 0).all()


def project_and_open(scene: Scene, folder: Path, left, right, **options):
    folder.mkdir(parents=True)
    images = [
        write_image(folder / f"{name}.zarr", scene.model, pixels)
        for name, pixels in (("left", left), ("right", right))
    ]
    project_with(*images, [scene.store], folder / "out.zarr", **options)
    return open_grid(folder / "out.zarr")


def test_attributes_and_summary(plane) -> None:
    grid = plane.project(recipe="paper", code="abc", scene="plane-1")
    names = "disparity", "status", "height", "point_count", "correlation", "uncertainty", "change"
    for name in names:
        assert grid[name].dims == ("y", "x")
        assert grid[name].attrs["units"] and grid[name].attrs["long_name"]
    status = grid["status"]
    assert status.attrs["flag_values"] == list(range(9))  # none between points, by this recipe
    assert status.attrs["flag_meanings"].split() == [s.name.lower() for s in Status][:9]
    assert grid.attrs["provenance"]["code"] == "abc"
    assert set(grid.attrs["provenance"]["inputs"]) == {"left", "right", "points/points.points"}
    assert EpipolarModel.from_dict(grid.attrs["epipolar"]).shape == plane.model.shape
    pixels = plane.summary["pixels"]
    assert pixels == grid.attrs["summary"]["pixels"]
    for meaning, value in zip(status.attrs["flag_meanings"].split(), status.attrs["flag_values"]):
        assert pixels[meaning] == int((status.values == value).sum())
    assert plane.summary["points"]["used"] == int(grid["point_count"].values.sum())
    json.dumps(dict(grid.attrs))


@pytest.mark.parametrize(
    ("left_cell", "diachronic", "by"),
    [
        ("", False, "configuration"),
        ("2020-06-01T01:00:00Z", True, "suns"),
    ],
)
def test_the_store_says_what_decided_on_its_light(
    plane, tmp_path, left_cell, diachronic, by
) -> None:
    """The left image has no time but that of the sheet, the right one that of its delivery."""
    images = [plane.images[0], tmp_path / "right.zarr"]
    told = {"taken": "2020-06-01T04:00:00+00:00", "sun": [150.0, 75.0]}
    write_image(images[1], plane.model, image_of(plane.surface), **told)
    inputs = SceneInputs.of(*images, [plane.store], LabelSettings(recipe="paper"))
    cells = {"left": (left_cell, None, None), "right": ("", None, None)}
    project_scene(inputs.in_light(None, cells), tmp_path / "out.zarr", code="test")
    attrs = open_grid(tmp_path / "out.zarr").attrs
    assert (attrs["light"]["diachronic"], attrs["light"]["decided_by"]) == (diachronic, by)
    assert attrs["settings"]["diachronic"] == diachronic
    assert inputs.in_light(not diachronic, cells).settings.diachronic != diachronic


def test_uncertainty_is_the_standard_error_of_the_mean(noisy_box, monkeypatch) -> None:
    """Noise of 0.1 m is 0.09 px: uncertainty of the labels of own points as known from it, and as
    the errors are."""
    own, layers = labels_of_own_points(noisy_box, monkeypatch)
    measured = layers["status"] == Status.LABELLED
    sigma, count = np.where(measured, np.sqrt(own.variance), np.nan), layers["point_count"]
    roof = noisy_box.surface[2] == ROOF
    clear = np.isfinite(sigma) & ~dilated(roof | (noisy_box.surface[2] > HEIGHT), 30)
    known = 0.1 * (FORWARD[1] - BACKWARD[1]) / 0.65  # px, of one point
    assert np.median((sigma * np.sqrt(count))[clear]) == pytest.approx(abs(known), rel=0.05)
    ratio = np.abs(own.disparity - noisy_box.truth)[clear] / sigma[clear]
    assert (ratio < 1).mean() == pytest.approx(0.68, abs=0.04)
    assert (ratio < 2).mean() == pytest.approx(0.95, abs=0.03)


def test_uncertainty_carries_that_of_the_alignment(plane, tmp_path) -> None:
    """Added in squares to that of the points; nothing else of the labels follows from it."""
    view = "right"
    alignment = alignment_of(plane.model, 1.0, view)
    alignment.save(tmp_path / "alignment.json")
    plain, grid = (
        plane.project(f"{view}-{k}.zarr", view=view, **options)
        for k, options in enumerate([{}, {"alignment": tmp_path / "alignment.json"}])
    )
    none, sigma = (g["uncertainty"].values.astype(float) for g in (plain, grid))
    y, x = np.nonzero(np.isfinite(none))
    assert x.size > 30_000
    variance = label_covariance(alignment, plane.model, x, y, view)[:, 0, 0]  # the plane is level
    assert np.allclose(sigma[y, x] ** 2, none[y, x] ** 2 + variance, rtol=0.01)
    for name in set(grid) - {"uncertainty"}:
        assert np.array_equal(grid[name].values, plain[name].values, equal_nan=True), name
    assert plain.attrs["alignment_sigma_px"] == {"disparity": 0.0, "x": 0.0, "y": 0.0}
    assert grid.attrs["alignment_sigma_px"]["x"] > 0.01


def refused(scene: Scene, store: Path, match: str) -> None:
    out = scene.folder / "refused.zarr"
    with pytest.raises(InputError, match=match):
        project_with(*scene.images, [store], out)
    assert not list(scene.folder.glob("refused*"))


def test_no_point_store_is_refused(plane) -> None:
    with pytest.raises(InputError, match="no point store"):
        project_with(*plane.images, [], plane.folder / "x.zarr")


def test_points_elsewhere_are_refused(plane, tmp_path) -> None:
    """The message tells a survey of another place from a wrong coordinate system."""
    near = plane.points[:2000] + np.array([0.1, 0, 0])
    refused(plane, write_points(tmp_path / "near", near), "no overlap between LiDAR and images")
    far = plane.points[:2000] + np.array([1.5, 3.0, 0])
    refused(plane, write_points(tmp_path / "far", far), "wrong coordinate system.*degrees away")
    with pytest.raises(InputError, match=r"114\.3.*30\.6"):
        project_with(*plane.images, [tmp_path / "far" / "points.points"], tmp_path / "x.zarr")


def test_surfaces_are_not_mixed_at_the_edge_of_a_roof(box) -> None:
    """Each label is that of the roof or of the ground, and the wrong one less often."""
    levels = [box.truth[box.surface[2] == h].mean() for h in (HEIGHT, ROOF)]
    off = {}
    for recipe in ("surface", "paper"):
        grid = box.project(recipe=recipe, correlation_threshold=-1)
        d = grid["disparity"].values
        d = d[np.isfinite(d)]
        off[recipe] = (np.minimum(abs(d - levels[0]), abs(d - levels[1])) > 0.05).sum()
        right = abs(grid["disparity"].values - box.truth) < 1
        seen_by_both = (box.surface[2] == HEIGHT) | (box.surface[2] == ROOF)
        known = np.isfinite(grid["disparity"].values) & seen_by_both
        off[recipe + " wrong"] = (known & ~right).sum()
    assert off["surface"] == 0
    assert off["surface wrong"] < 0.5 * off["paper wrong"]


def test_box_hides_a_run_of_the_ground(box) -> None:
    """Hidden ground beside the box, walls without points included, to 2 px at its border."""
    grid = box.project()
    status = grid["status"].values
    hidden = hidden_truth(box)
    assert 800 < hidden.sum() < 20_000
    sure = hidden & ~dilated(~hidden, 2)
    labelled = is_labelled(status)
    assert not labelled[sure].any()
    with_points = status[sure & (status != Status.NO_POINTS)]
    assert np.isin(with_points, (Status.HIDDEN_IN_RIGHT, Status.EDGE_IN_PIXEL)).all()
    assert (with_points == Status.HIDDEN_IN_RIGHT).mean() > 0.85  # others: behind the wall's strip
    wall = (box.surface[2] > HEIGHT) & (box.surface[2] < ROOF)
    clear = ~dilated(hidden | wall) & (status != Status.NO_POINTS)
    assert (status == Status.HIDDEN_IN_RIGHT)[clear].mean() < 1e-3
    roof = box.surface[2] == ROOF
    inner = roof & ~dilated(~roof, 5) & (status != Status.NO_POINTS)
    assert labelled[inner].mean() > 0.999
    # Along a row: as many px without a label, wall included, as the roof has more disparity.
    cols = np.flatnonzero((hidden | wall).any(axis=0))
    run = (~labelled[:, cols[0] - 3 : cols[-1] + 3]).sum(axis=1)
    rise = box.truth[roof].mean() - box.truth[box.surface[2] == HEIGHT].mean()
    assert np.median(run[run > 0.8 * rise]) == pytest.approx(rise, abs=1.5)


def test_correlation_removes_most_of_what_is_hidden(box) -> None:
    grid = box.project(recipe="paper")
    labelled = grid["status"].values == Status.LABELLED
    hidden = hidden_truth(box)
    assert labelled[hidden].mean() < 0.25
    every = box.project(recipe="paper", correlation_threshold=-1)
    none = every["status"].values == Status.LABELLED
    assert none[hidden & (box.surface[2] == HEIGHT)].mean() > 0.95
