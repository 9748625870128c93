"""A check finds what a run would fail of, on a good project broken in one way each."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rich.console import Console

from stereotruth.core.errors import InputError
from stereotruth.project import check, check_scene
from stereotruth.project.check import check_project
from stereotruth.project.check_table import show
from stereotruth.project.findings import Level

from ...synthetic.broken_scenes import DOUBTS, FAULTS, Fault, write_settings


def texts(level: Level) -> list[str]:
    every = [finding for findings in check_project() for finding in findings]
    return [f"{f.text}. Remedy: {f.remedy}" for f in every if f.level is level]


def test_a_good_project_has_no_errors(folder):
    assert texts(Level.ERROR) == []
    assert texts(Level.DOUBT) == []
    facts = "\n".join(texts(Level.FACT))
    for words in (
        "15 and 15 of 15 used",
        "convergence 31",
        "0.0 M points",
        "EPSG:32650",
        "on the ",
    ):
        assert words in facts


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_what_a_run_would_fail_of_is_an_error(folder, fault: Fault):
    fault.plant(folder)
    begun = time.perf_counter()
    errors = texts(Level.ERROR)
    assert any(fault.words in text for text in errors), errors
    assert all(len(text.split("Remedy: ")[1]) > 5 for text in errors)
    assert time.perf_counter() - begun < 10


@pytest.mark.parametrize("fault", DOUBTS, ids=lambda fault: fault.name)
def test_what_a_run_gets_through_is_a_doubt(folder, fault: Fault):
    fault.plant(folder)
    assert texts(Level.ERROR) == []
    assert any(fault.words in text for text in texts(Level.DOUBT)), texts(Level.DOUBT)


def test_doubts_end_strict_runs(folder):
    DOUBTS[-1].plant(folder)
    write_settings(folder, strict=True)
    assert any("left out" in text for text in texts(Level.ERROR))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("side", "level", "words"),
    [
        (60_000, Level.DOUBT, "left.tif: nodata at all of 64 places"),
        (1_000_000, Level.ERROR, "1000000 x 1000000 pixels are no image of a satellite"),
    ],
)
def test_a_small_file_of_many_pixels_is_sized_and_not_read(folder, side, level, words):
    """60000 x 60000 took 128 s, 10⁶ x 10⁶ all of the memory."""
    with rasterio.open("left.tif") as image:
        rpcs = image.rpcs
    shape = {"width": side, "height": side, "count": 1, "dtype": "uint16"}
    blocks = {"tiled": True, "blockxsize": 8192, "blockysize": 8192, "sparse_ok": True}
    with rasterio.open(
        "left.tif", "w", driver="GTiff", **shape, **blocks, BIGTIFF="YES", rpcs=rpcs
    ):
        pass
    begun = time.process_time()
    assert any(words in text for text in texts(level))
    assert time.process_time() - begun < 5


def test_files_without_permission_are_findings(folder, monkeypatch):
    """Tests may run as a user who may do everything, so the system's answers are made up."""
    usual = Path.iterdir, Path.read_bytes

    def iterdir(path):
        if path.name == "lidar":
            raise PermissionError(13, "Permission denied", str(path))
        return usual[0](path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert any("lidar: no permission" in text for text in texts(Level.ERROR))
    monkeypatch.undo()

    def read_bytes(path, *arguments, **more):
        if path.name == "scenes.tsv":
            raise PermissionError(13, "Permission denied", str(path))
        return usual[1](path, *arguments, **more)

    monkeypatch.chdir(folder)
    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    assert any("scenes.tsv: no permission" in text for text in texts(Level.ERROR))


def test_the_time_of_many_scenes_is_told_by_the_first(folder, monkeypatch):
    head, row = Path("scenes.tsv").read_text().splitlines()[:2]
    rows = [row.replace("Good-1", f"Good-{k}", 1) for k in range(1, 1201)]
    Path("scenes.tsv").write_text("\n".join([head, *rows]) + "\n")
    said = []

    def tell(text):
        said.append(text)
        raise KeyboardInterrupt

    monkeypatch.setattr(check, "monotonic", iter([100.0, 107.5]).__next__)  # 2.5 s each
    with pytest.raises(KeyboardInterrupt):
        check_project(tell=tell)
    assert said[0].startswith("looking at 1197 more scenes, about 50 min")


def test_one_fault_hides_no_other(folder):
    """A missing RPC and LiDAR without a system are told at once."""
    names = {"no CRS", "GCP column", "RPC cut short"}
    for fault in FAULTS:
        if fault.name in names:
            fault.plant(folder)
    errors = "\n".join(texts(Level.ERROR))
    for fault in FAULTS:
        assert fault.name not in names or fault.words in errors


def test_each_wrong_row_of_a_sheet_is_an_error(folder):
    sheet = folder / "scenes.tsv"
    head, row = sheet.read_text().splitlines()[:2]
    wrong = [row.replace("Good-1", f"Good-{k}").replace("\tGood\t", f"\tGod{k}\t") for k in (2, 3)]
    sheet.write_text("\n".join((head, row, *wrong)) + "\n")
    errors = texts(Level.ERROR)
    assert [f"'God{k}', which is not in" in error for k, error in zip((2, 3), errors)] == 2 * [True]
    assert len(errors) == 2


def test_scenes_and_cities_are_chosen_by_name(folder):
    assert [f.scene for f in check_project(names=["Good"])] == ["project", "Good-1", "run"]
    errors = [f for findings in check_project(names=["Bad"]) for f in findings]
    assert "no scene or city 'Bad'" in errors[-1].text


def test_the_table_has_a_line_a_problem_with_its_remedy(folder, capsys):
    FAULTS[[fault.name for fault in FAULTS].index("no CRS")].plant(folder)
    assert show(check_project(), Console(width=200))
    out = capsys.readouterr().out
    assert "no coordinate reference system" in out
    assert "Remedy: set lidar_crs" in out
    assert "1 error, " in out and "a run would fail" in out


@pytest.mark.parametrize(("colour", "said"), [("auto", False), (None, True)])
def test_one_band_is_named_only_where_it_is_taken(folder, colour, said):
    """By default the mean of red, green and blue is matched."""
    for view in ("left", "right"):
        path = folder / f"{view}.tif"
        with rasterio.open(path) as image:
            pixels, profile, rpcs = image.read(1), image.profile, image.rpcs
        with rasterio.open(path, "w", **profile | {"count": 3, "photometric": "rgb"}) as image:
            image.write(np.stack([pixels] * 3))
            image.rpcs = rpcs
    write_settings(folder, rectify={"colour": colour})
    assert texts(Level.ERROR) == []
    assert [text.split(";")[1] for text in texts(Level.DOUBT)] == said * 2 * [
        " band 1 (red) is used. Remedy: "
    ]


def test_images_of_several_scenes_are_read_once(folder, monkeypatch):
    read: list[Path] = []
    monkeypatch.setattr(check_scene, "_check_pixels", lambda image, bands: read.append(image))
    head, row = (folder / "scenes.tsv").read_text().splitlines()
    rows = (row.replace("Good-1", name, 1) for name in ("Good-1", "Good-2", "Good-3"))
    (folder / "scenes.tsv").write_text("\n".join([head, *rows]) + "\n")
    assert len([findings.scene for findings in check_project()]) == 5
    assert sorted(path.name for path in read) == ["left.tif", "right.tif"]


def test_input_errors_name_the_file():
    with pytest.raises(InputError, match=r"none\.yaml: no such file"):
        from stereotruth.project.project import configured

        configured(["none.yaml"])
