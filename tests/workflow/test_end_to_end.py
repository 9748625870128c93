"""The whole workflow on a small synthetic city: products, reruns, and what a user gets wrong."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
import rioxarray
import xarray as xr
import zarr

from stereotruth.align.align import align
from stereotruth.align.refine import refine
from stereotruth.core.config.labels import LabelSettings
from stereotruth.core.errors import InputError
from stereotruth.core.status import Status
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rectify import rectify
from stereotruth.labels.project import project_scene
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.point_store import PointStore
from stereotruth.project.check import check_project
from stereotruth.project.findings import Level
from stereotruth.sensor.image_reader import open_pair

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


EDITED = {
    "stereotruth/tiles/export": {"export"},
    "stereotruth/labels/project": {"project", "export"},
    "stereotruth/epipolar/rectify": {"rectify", "project", "export"},
    "stereotruth/sensor/image_reader": {"refine", "rectify", "project", "export"},
    "stereotruth/align/align": STAGES,
    "stereotruth/surface/facets": {"surface", "project", "export"},
    "stereotruth/lidar/ingest": STAGES - {"align"} | {"ingest", "compare_strips", "surface"},
    "stereotruth/lidar/strip_planes": {"compare_strips", "project", "export"},
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


@pytest.mark.slow
def test_remarks_in_the_code_run_nothing(edited):
    assert plan(edited) == {}


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


def test_the_right_view_asked_for_later_is_made_and_cut(made):
    (made.folder / "both.yaml").write_text("project: {right_view: true}\n")
    assert plan(made, "both.yaml") == {"project_right": 1, "export": 1}


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


@pytest.mark.slow
def test_verify_finds_an_edited_tile(made, tmp_path):
    """That one alone; of a city whose tiles are whole, the stages after the tiles verify them."""
    other = made.copy(tmp_path / "other")
    tile = next((other.folder / "tiles/Tiny/left").iterdir())
    tile.write_bytes(tile.read_bytes()[:-1] + b"x")
    run = other.snakemake("verify", "--configfile", "tiny.yaml")
    assert run.status != 0
    assert "1 files differ" in run.text and tile.name in run.text


def test_the_dataset_has_the_published_layout(later):
    root = later.folder / "dataset"
    labelled = [row for row in manifest(later) if row["split"] in ("train", "val", "test")]
    for kind in ("left", "right", "disp"):
        files = list(root.glob(f"with ground truth/*/{kind}/*.tiff"))
        assert len(files) == len(labelled)
    assert (root / "without ground truth/left").is_dir()


# ------------------------------------------------------------------------ what a user gets wrong


def image_without_rpc(folder: Path) -> dict[str, str]:
    with rasterio.open(folder / "left.tif") as source:
        profile, pixels = source.profile, source.read()
    with rasterio.open(folder / "plain.tif", "w", **profile) as target:
        target.write(pixels)
    return {"left_image": str(folder / "plain.tif")}


def nodata_only_image(folder: Path) -> dict[str, str]:
    with rasterio.open(folder / "left.tif") as source:
        profile, pixels, rpcs = source.profile, source.read(), source.rpcs
    with rasterio.open(folder / "empty.tif", "w", **profile) as target:
        target.write(np.zeros_like(pixels))
        target.rpcs = rpcs
    return {"left_image": str(folder / "empty.tif")}


def edited_gcps(folder: Path, edit) -> dict[str, str]:
    with (folder / "gcps.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    rows = edit(rows)
    with (folder / "edited.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return {"gcps": str(folder / "edited.csv")}


def gcp_outside(folder: Path) -> dict[str, str]:
    def edit(rows):
        rows[3]["left_col"] = "5000.0"
        return rows

    return edited_gcps(folder, edit)


def two_gcps(folder: Path) -> dict[str, str]:
    return edited_gcps(folder, lambda rows: rows[:2])


def swapped_images(folder: Path) -> dict[str, str]:
    return {
        "left_image": str(folder / "right.tif"),
        "right_image": str(folder / "left.tif"),
    }


def other_lidar(folder: Path, epsg: int | None, east: float) -> dict[str, str]:
    """The LiDAR under another CRS, or moved by ``east`` metres."""
    import laspy
    import pyproj

    target = folder / "other"
    target.mkdir()
    for file in (folder / "lidar").iterdir():
        las = laspy.read(file)
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.offsets, header.scales = las.header.offsets, las.header.scales
        if epsg is not None:
            header.add_crs(pyproj.CRS.from_epsg(epsg))
        moved = laspy.LasData(header)
        moved.x, moved.y, moved.z = las.x + east, las.y, las.z
        moved.classification = las.classification
        moved.write(target / file.name)
    return {"lidar": str(target)}


def lidar_without_crs(folder: Path) -> dict[str, str]:
    return other_lidar(folder, None, 0.0)


def lidar_of_another_zone(folder: Path) -> dict[str, str]:
    return other_lidar(folder, 32648, 0.0)


def lidar_elsewhere(folder: Path) -> dict[str, str]:
    return other_lidar(folder, 32650, 20_000.0)


MISTAKES = {
    image_without_rpc: ["plain.tif", "RPC"],
    nodata_only_image: ["empty.tif", "nodata"],
    gcp_outside: ["edited.csv", "outside", "left.tif"],
    two_gcps: ["edited.csv", "affine", "shift"],
    swapped_images: ["swapped"],
    lidar_without_crs: ["other", "lidar_crs"],
    lidar_of_another_zone: ["CRS"],
    lidar_elsewhere: ["overlap"],
}
OF_LIDAR = (lidar_without_crs, lidar_of_another_zone, lidar_elsewhere)


def scenes_of(project: Project) -> list[dict[str, str]]:
    """The rows of the sheet of wrong scenes."""
    with (project.folder / "wrong_scenes.tsv").open(newline="") as stream:
        return list(csv.DictReader(stream, delimiter="\t"))


def name_of(mistake) -> str:
    """The scene, and its city, in which it is made."""
    return mistake.__name__.replace("_", "-")


@pytest.fixture(scope="module")
def wrong(data, tmp_path_factory):
    """A project with a scene, and a city, for each mistake; config in wrong.yaml."""
    top = tmp_path_factory.mktemp("mistaken")
    rows = []
    for mistake in MISTAKES:
        folder = top / name_of(mistake)
        shutil.copytree(data, folder, ignore=shutil.ignore_patterns("truth.zarr"))
        if mistake not in OF_LIDAR:  # one file will do
            next((folder / "lidar").glob("*_0_1.laz")).unlink()
        name = name_of(mistake)
        rows.append(row_of(folder, scene=name, city=name, **mistake(folder)))
    project = copy_project(top / "project")
    project.add_scene("wrong", rows, **SIZE)
    return project


@pytest.mark.parametrize("mistake", MISTAKES, ids=name_of)
def test_a_mistake_is_found_before_a_run(wrong, mistake, monkeypatch):
    monkeypatch.chdir(wrong.folder)
    *_, found, run = check_project([Path("wrong.yaml")], [name_of(mistake)])
    errors = [finding.text + finding.remedy for finding in found if finding.level is Level.ERROR]
    assert len(errors) == 1, errors
    for word in MISTAKES[mistake]:
        assert word in errors[0]
    assert not run.failed


def run_stages(row: dict[str, str], good: Project, folder: Path) -> None:
    """The stages of a scene one after the other, as the rules call them, in this process.

    Images that can be rectified are those of the ``good`` project, and so is what becomes of them.
    """
    stores = [folder / f"{file.stem}.points" for file in Path(row["lidar"]).iterdir()]
    for file, store in zip(Path(row["lidar"]).iterdir(), stores):
        ingest(file, store, provenance={})
    images = row["left_image"], row["right_image"]
    alignment = align(*images, row["gcps"], scene=row["scene"])
    alignment, _ = refine(alignment, *images, stores)
    rectified = good.folder / "results/rectify/Tiny/Tiny-1"
    with open_pair(*images) as (left, right):
        if "empty" in row["left_image"]:
            model = EpipolarModel.load(rectified / "epipolar.json")
            outputs = [folder / name for name in ("epipolar.json", "left.zarr", "right.zarr")]
            rectify(left, right, model, *outputs, provenance={})
    sides = (rectified / "left.zarr", rectified / "right.zarr")
    inputs = SceneInputs.of(*sides, stores, LabelSettings()).with_surface(folder)
    project_scene(inputs, folder / "labels.zarr", code="")


@pytest.mark.parametrize("mistake", MISTAKES, ids=name_of)
def test_a_mistake_ends_in_one_clear_message(wrong, made, mistake, tmp_path):
    (row,) = (row for row in scenes_of(wrong) if row["scene"] == name_of(mistake))
    with pytest.raises(InputError) as caught:
        run_stages(row, made, tmp_path)
    for word in ["Remedy:", *MISTAKES[mistake]]:
        assert word in str(caught.value)
    assert [*tmp_path.rglob("*.partial")] == []


@pytest.mark.slow
def test_a_run_names_all_mistakes_and_leaves_nothing(wrong):
    """A scene that fails does not stop the other, of which two files fail at the same time."""
    mistakes = (two_gcps, lidar_without_crs)
    targets = [f"tiles/{name_of(mistake)}" for mistake in mistakes]
    run = wrong.snakemake("--keep-going", *targets, "--configfile", "wrong.yaml")
    assert run.status != 0
    lines = [line for line in run.text.strip().splitlines() if "error: " in line]
    scenes = {mistake: f"{name_of(mistake)}: error: " for mistake in mistakes}
    assert all(any(scene in line for scene in scenes.values()) for line in lines)
    for mistake, scene in scenes.items():
        said = [line for line in lines if scene in line]  # at the time and at the end
        errors = {line.partition("error: ")[2] for line in said}
        assert 1 <= len(errors) <= (2 if mistake is lidar_without_crs else 1), run.text[-3000:]
        assert len(said) == 2 * len(errors)
        for error in errors:
            for word in ["Remedy:", *MISTAKES[mistake]]:
                assert word in error, error
    assert "Traceback" not in run.text
    assert [f for f in (wrong.folder / "results").rglob("*") if f.suffix == ".partial"] == []
    assert not (wrong.folder / "tiles").exists()


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
