"""A check finds what a run would fail of, on a good project broken in one way each."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
from rich.console import Console

from stereotruth.project import check
from stereotruth.project.check import check_project
from stereotruth.project.findings import Level, show

from ...synthetic.broken_scenes import (
    DOUBTS,
    FAULTS,
    Fault,
    geoid_of_other_sign,
    write_settings,
    write_sheet,
)
from ...synthetic.las import write_gtx
from ...synthetic.rpc_texts import rpb_text
from ...synthetic.surveyed_pair import RPCS, make_gcps, write_gcps


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
    if fault is DOUBTS[-1]:
        write_settings(folder, strict=True)
        assert any("left out" in text for text in texts(Level.ERROR))


@pytest.mark.parametrize("undulation_m", [-3.0, 30.0])
def test_a_geoid_that_is_small_or_right_is_no_error(folder, undulation_m):
    geoid_of_other_sign(folder, undulation_m)
    if undulation_m > 5.0:
        write_gtx(folder / "geoid.gtx", np.full((5, 5), undulation_m), 113.0, 28.0, 1.0)
    assert texts(Level.ERROR) == []


@pytest.mark.parametrize("are_wrong", [True, False])
def test_a_geoid_of_the_other_sign_for_lidar_and_control_points_is_a_doubt(folder, are_wrong):
    """The LiDAR agrees with the control points, but both are 2 N too low for the RPCs."""
    geoid_of_other_sign(folder, 60.0)
    if are_wrong:
        lowered = [row | {"height": row["height"] - 120.0} for row in make_gcps()]
        write_gcps(folder / "gcps.csv", lowered)
    else:
        write_gtx(folder / "geoid.gtx", np.full((5, 5), 60.0), 113.0, 28.0, 1.0)
    assert not any("geoid.gtx" in text for text in texts(Level.ERROR))
    said = [text for text in texts(Level.DOUBT) if "twice the undulation" in text]
    assert len(said) == are_wrong, said
    assert all(90 < float(re.search(r"lie (\d+)", text)[1]) < 150 for text in said)  # biased RPCs


def test_without_control_points_the_rpcs_tell_a_geoid_of_the_other_sign(folder):
    geoid_of_other_sign(folder, 100.0)
    assert not any("with this geoid" in text for text in _without_gcps(height_scale=500.0))
    assert any("RPCs' heights of 15 to 105 m" in text for text in _without_gcps(height_scale=45.0))


def test_a_protected_city_is_no_error_of_another(folder, monkeypatch):
    with Path("cities.tsv").open("a") as sheet:
        sheet.write("Done\tDO\t1\t1\t1\n")
    locked = Path("results/align/Done")
    locked.mkdir(parents=True)
    monkeypatch.setattr("os.access", lambda path, mode: Path(path) != locked)
    assert texts(Level.ERROR) == []
    locked = Path("results/align/Good")
    locked.mkdir()
    assert len(texts(Level.ERROR)) == 1


def test_a_bird_high_above_the_ground_is_no_geoid_of_the_other_sign(folder):
    geoid_of_other_sign(folder, 100.0)
    write_gtx(folder / "geoid.gtx", np.full((5, 5), 100.0), 113.0, 28.0, 1.0)
    points = laspy.read(folder / "lidar" / "points.laz")
    points.z = [300.0, *points.z[1:]]
    points.write(folder / "lidar" / "points.laz")
    assert _without_gcps(height_scale=45.0) == []


def _without_gcps(height_scale: float) -> list[str]:
    for view in ("left", "right"):
        rpc = RPCS[view]
        line = rpc.line_num_coeff.copy()
        line[3] *= height_scale / rpc.height_scale
        rpc = replace(rpc, height_scale=height_scale, line_num_coeff=line)
        Path(f"{view}.rpb").write_text(rpb_text(rpc.to_dict()))
    write_sheet(Path(), geoid="geoid.gtx", gcps="")
    return texts(Level.ERROR)


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
