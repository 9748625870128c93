"""The whole workflow on a small synthetic city: products, reruns, and what a user gets wrong."""

from __future__ import annotations

import csv
import json
import shutil

import laspy
import numpy as np
import pytest
import rasterio
import rioxarray
import xarray as xr
import zarr

from stereotruth.core.status import Status
from stereotruth.lidar.point_store import PointStore

from ..synthetic.project import SIZE, TINY, Project, copy_project, hashes, row_of

STAGES = {"align", "refine", "rectify", "project", "export"}
ARGUMENTS = ("tiles/Tiny", "--configfile", "tiny.yaml")


def plan(project: Project, *arguments: str) -> dict[str, int]:
    return project.plan(*ARGUMENTS, *arguments)


def manifest(project: Project) -> list[dict[str, str]]:
    with (project.folder / "tiles/Tiny/manifest.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_tiles_are_made_with_all_their_files(made):
    rows = manifest(made)
    labelled = [row for row in rows if row["complete"] == "yes"]
    assert len(labelled) >= 4
    folder = made.folder / "tiles/Tiny"
    for kind, dtype in (("left", "uint16"), ("right", "uint16"), ("status", "uint8")):
        files = sorted((folder / kind).iterdir())
        assert len(files) == len(labelled)
        with rasterio.open(files[0]) as tile:
            assert (tile.width, tile.height, tile.dtypes[0]) == (128, 128, dtype)
    assert len(list((folder / "disp").iterdir())) == len(labelled)
    disparity = rioxarray.open_rasterio(next((folder / "disp").iterdir()), masked=True)
    assert disparity.isnull().any() and disparity.notnull().any()
    assert abs(disparity).max() < 200
    orientations = sorted((folder / "orientation").iterdir())
    assert len(orientations) >= len(labelled)
    ground = json.loads(orientations[0].read_text())["ground_frame"]  # of LiDAR in a zone of UTM
    assert (ground["frame"], ground["epoch"], ground["by"]) == ("ITRF2020", 2020.0, "")
    assert [one["legs"] for one in ground["source"]] == [[]]


def test_disparity_agrees_with_the_exact_truth(made, tmp_path):
    """Labelled and truly visible pixels: the limits that the project has set itself."""
    from stereotruth.evaluate.epipolar_truth import write_grid_truth
    from stereotruth.evaluate.labels_against_truth import compare_scene

    epipolar = made.folder / "results/rectify/Tiny/Tiny-1/epipolar.json"
    write_grid_truth(TINY, TINY.scenes[0], epipolar, tmp_path / "truth.zarr")
    store = made.folder / "results/project/Tiny/Tiny-1.zarr"
    result = compare_scene(
        store, tmp_path / "truth.zarr", made.folder / "tiles/Tiny", scene="Tiny-1"
    )
    figures = result.whole.figures()
    assert figures["errors"]["count"] > 100_000
    assert figures["errors"]["mean_absolute"] <= 0.25
    assert figures["errors"]["share_over_1_px"] <= 0.005
    assert figures["y_parallax"]["rms"] <= 0.25
    assert figures["share_of_visible_labelled"] >= 0.80  # narrow courts: many edges
    assert figures["share_of_hidden_labelled"] <= 0.1
    assert len(result.tiles) >= 4


def test_an_edited_gcp_runs_what_follows_and_a_reverted_one_nothing(made, tmp_path):
    other = made.copy(tmp_path / "other")
    file = other.folder / "in/gcps.csv"
    before = file.read_text()
    lines = before.splitlines()
    cells = lines[1].split(",")
    cells[4] = f"{float(cells[4]) + 0.1:.3f}"
    file.write_text("\n".join([lines[0], ",".join(cells), *lines[2:]]) + "\n")
    assert set(plan(other)) == STAGES
    file.write_text(before)
    assert plan(other) == {}


EDITED = {  # of which modules each rule's digest holds, test_rules has for all of them
    "stereotruth/tiles/export": {"export"},
    "stereotruth/sensor/images": {"refine", "rectify", "project", "export"},
    "stereotruth/lidar/strip_comparison": {"compare_strips", "project", "export"},
    "stereotruth/core/sheets stereocities/render": set(),
}


@pytest.fixture(scope="module")
def edited(made, tmp_path_factory) -> Project:
    """A project that runs its own source, in which every module of EDITED has one more remark."""
    project = made.copy(tmp_path_factory.mktemp("edited") / "project")
    project.edited = True
    for module in " ".join(EDITED).split():
        with (project.folder / f"src/{module}.py").open("a") as stream:
            stream.write("\n# a remark is no change\n")
    return project


@pytest.mark.parametrize(("modules", "rules"), EDITED.items())
def test_edited_code_runs_its_stage_and_what_follows(edited, modules, rules):
    files = [edited.folder / f"src/{module}.py" for module in modules.split()]
    before = {file: file.read_text() for file in files}
    try:
        for file, text in before.items():
            file.write_text(text + "\nADDED = 1\n")
        assert set(plan(edited)) == rules
    finally:
        for file, text in before.items():
            file.write_text(text)


def test_a_new_lidar_file_is_the_only_one_read(made, tmp_path):
    other = made.copy(tmp_path / "other")
    new = other.folder / "in/lidar/new.laz"
    shutil.copy(next((other.folder / "in/lidar").glob("*_0_1.laz")), new)
    after = dict.fromkeys(["compare_strips", "surface", *STAGES - {"align"}], 1)
    assert plan(other) == {"ingest": 1, **after}


@pytest.fixture(scope="module")
def both_views(made, tmp_path_factory) -> Project:
    """The project in which the right view has been asked for later."""
    other = made.copy(tmp_path_factory.mktemp("both") / "project")
    config = other.folder / "tiny.yaml"
    config.write_text(config.read_text() + "project: {right_view: true}\n")
    run = other.snakemake(*ARGUMENTS)
    assert run.status == 0, run.text[-4000:]
    assert run.jobs == {"project": 1, "export": 1}
    return other


def test_the_store_of_a_scene_opens_by_xarray_alone(made):
    """All layers as Zarr has them, status in whole numbers, days as dates; in them the values of
    the tiles."""
    store = made.folder / "results/project/Tiny/Tiny-1.zarr"
    raw = zarr.open_group(store, mode="r")
    with xr.open_zarr(store) as grid:
        assert {"disparity", "status", "height", "uncertainty"} <= set(grid.data_vars)
        for name, layer in grid.data_vars.items():
            values = raw[name][:]
            if name == "lidar_date":
                days = values.astype("datetime64[D]").astype("datetime64[ns]")
                values = np.where(values == 0, np.datetime64("NaT"), days)
            assert layer.dims == ("y", "x") and layer.dtype == values.dtype
            assert np.array_equal(layer.values, values, equal_nan=layer.dtype.kind in "fM")
        tiles = [row for row in manifest(made) if row["complete"] == "yes"]
        for row in tiles:
            y, x, size = (int(row[key]) for key in ("row0", "col0", "size"))
            here = grid.isel(y=slice(y, y + size), x=slice(x, x + size))
            wanted = here.disparity.values.astype(np.float64) - int(row["right_offset_px"])
            status = here.status.values.copy()
            unsure = (status == Status.LABELLED_CROWN) & (here.uncertainty.values > 0.5)
            wanted[unsure], status[unsure] = np.nan, Status.TOO_UNCERTAIN
            for kind, values in (("disp", wanted), ("status", status)):
                path = made.folder / "tiles/Tiny" / row[kind]
                found = rioxarray.open_rasterio(path, masked=kind == "disp")[0].values
                np.testing.assert_allclose(found, values, rtol=0, atol=1 / 2048)
    assert tiles


@pytest.mark.slow
def test_the_right_view_is_a_second_product(made, both_views):
    """Asked for later, it adds files and leaves the others; both views name each other's pixels."""
    other = both_views
    row = next(row for row in manifest(other) if row["complete"] == "yes")
    folder = other.folder / "tiles/Tiny"
    left, right = (
        rioxarray.open_rasterio(folder / row[kind], masked=True)[0].values
        for kind in ("disp", "disp_right")
    )
    before = hashes(made.folder / "tiles/Tiny/disp")
    assert before == hashes(folder / "disp")
    rows, cols = np.nonzero(np.isfinite(right))
    there = np.rint(cols + right[rows, cols]).astype(int)
    inside = (there >= 0) & (there < left.shape[1])
    back = left[rows[inside], there[inside]]
    miss = np.abs(back - right[rows[inside], cols[inside]])[np.isfinite(back)]
    assert miss.size > 0.3 * left.size
    assert (miss < 0.2).mean() > 0.95


# ------------------------------------------------------------------------ what a user gets wrong


@pytest.mark.slow
def test_a_run_names_all_mistakes_and_leaves_nothing(data, tmp_path):
    """A scene that fails does not stop the other, of which two files fail at the same time."""
    rows = []
    for name in ("two-gcps", "no-crs"):
        shutil.copytree(data, tmp_path / name, ignore=shutil.ignore_patterns("truth.zarr"))
        rows.append(row_of(tmp_path / name, scene=name, city=name))
    gcps = tmp_path / "two-gcps/gcps.csv"
    gcps.write_text("".join(gcps.read_text().splitlines(keepends=True)[:3]))
    for file in (tmp_path / "no-crs/lidar").iterdir():
        las = laspy.read(file)
        bare = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
        bare.header.offsets, bare.header.scales = las.header.offsets, las.header.scales
        bare.x, bare.y, bare.z, bare.classification = las.x, las.y, las.z, las.classification
        bare.write(file)
    project = copy_project(tmp_path / "project")
    project.add_scene("wrong", rows, **SIZE)
    targets = ("tiles/two-gcps", "tiles/no-crs")
    run = project.snakemake("--keep-going", *targets, "--configfile", "wrong.yaml")
    assert run.status != 0 and "Traceback" not in run.text
    lines = [line for line in run.text.strip().splitlines() if "error: " in line]
    for scene, words, most in (("two-gcps", "gcps.csv", 1), ("no-crs", "lidar_crs", 2)):
        said = [line for line in lines if f"{scene}: error: " in line]  # at the time and at the end
        errors = {line.partition("error: ")[2] for line in said}
        assert 1 <= len(errors) <= most and len(said) == 2 * len(errors), run.text[-3000:]
        assert all("Remedy:" in error and words in error for error in errors)
    assert not [f for f in (project.folder / "results").rglob("*") if f.suffix == ".partial"]
    assert not (project.folder / "tiles").exists()


def test_provenance_is_in_every_product(made):
    import zarr

    records = [
        json.loads((made.folder / "results/align/Tiny/Tiny-1/alignment.json").read_text()),
        json.loads((made.folder / "results/rectify/Tiny/Tiny-1/epipolar.json").read_text()),
        json.loads(next((made.folder / "tiles/Tiny/orientation").iterdir()).read_text()),
    ]
    stores = [*(made.folder / "results").rglob("*.zarr")]
    assert len(stores) >= 3
    records += [dict(zarr.open_group(store, mode="r").attrs) for store in stores]
    points = [*(made.folder / "results/ingest").rglob("*.points")]
    assert points
    records += [PointStore(store).attrs for store in points]
    for record in records:
        assert {"code", "inputs", "parameters"} <= set(record["provenance"])
