"""Rows from deliveries."""

from __future__ import annotations

import csv
import shlex
import shutil
from pathlib import Path

import pytest
import rasterio
from typer.testing import CliRunner

from stereotruth.core.errors import InputError
from stereotruth.core.sheets import read_cities, read_scenes
from stereotruth.project.add_scene import add_scene
from stereotruth.project.check import check_project
from stereotruth.project.main import app
from stereotruth.project.new_project import begin
from stereotruth.project.project import configured, read_rows

from ...synthetic.broken_scenes import with_pixels, write_lidar
from ...synthetic.rpc_texts import dimap_text, rpb_text
from ...synthetic.surveyed_pair import RPCS, SIZES

GF7 = "GF7_DLC_E115.4_N30.2_20200909_L1A0000137600"


def plain(path, view, count=1):
    """An image without RPC in it."""
    path.parent.mkdir(exist_ok=True, parents=True)
    cols, rows = SIZES[view]
    shape = {"width": cols, "height": rows, "count": count, "dtype": "uint16"}
    with rasterio.open(path, "w", driver="GTiff", **shape, sparse_ok=True, tiled=True):
        pass
    return with_pixels(path)


def row():
    with Path("scenes.tsv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream, delimiter="\t"))[-1]


def gaofen(folder):
    for view, word in (("right", "FWD"), ("left", "BWD")):
        image = plain(folder / f"{GF7}-{word}-PAN.tiff", view)
        image.with_suffix(".rpb").write_text(rpb_text(RPCS[view].to_dict()))
    plain(folder / f"{GF7}-BWD-MUX.tiff", "left", 4)
    (folder / f"{GF7}-BWD-PAN.jpg").touch()
    return folder


def pleiades(folder):
    for k, view in enumerate(("right", "left")):
        image = plain(folder / f"view{k}" / f"IMG_PHR1A_P_00{k}_R1C1.TIF", view)
        image.with_name(f"DIM_PHR1A_P_00{k}.XML").write_text("<Dimap_Document/>")
        text = dimap_text(RPCS[view].to_dict())
        image.with_name(f"RPC_PHR1A_P_00{k}.XML").write_text(text)
    return folder


def worldview(folder, parts=1):
    for k, view in enumerate(("right", "left")):
        stem = f"16FEB12-P1BS-50064_0{k}_P001"
        plain(folder / f"{stem}.TIF", view)
        (folder / f"{stem}.RPB").write_text(rpb_text(RPCS[view].to_dict()))
        tiles = "".join(
            f'filename = "{stem}{"" if parts == 1 else n}.TIF";\n' for n in range(parts)
        )
        (folder / f"{stem}.TIL").write_text(tiles)
    return folder


@pytest.mark.parametrize(
    ("make", "left", "right"),
    [(gaofen, f"{GF7}-BWD-PAN.tiff", f"{GF7}-FWD-PAN.tiff"),
     (pleiades, "view1/IMG_PHR1A_P_001_R1C1.TIF", "view0/IMG_PHR1A_P_000_R1C1.TIF"),
     (worldview, "16FEB12-P1BS-50064_01_P001.TIF", "16FEB12-P1BS-50064_00_P001.TIF")],
    ids=["GaoFen-7", "DIMAP", "WorldView"],
)  # fmt: skip
def test_views_of_a_delivery(folder, make, left, right):
    delivery = folder / "delivery"
    delivery.mkdir()
    make(delivery)
    lines = "\n".join(add_scene([delivery], lidar="lidar", gcps="gcps.csv", city="Qichun"))
    assert row()["left_image"] == str(delivery / left)
    assert row()["right_image"] == str(delivery / right)
    assert row()["scene"] == "Qichun-1" and row()["gcps"] == "gcps.csv"
    assert "left looks backward" in lines and "EPSG:32650" in lines
    cities = read_cities("cities.tsv")
    assert cities["Qichun"].prefix == "QI"
    assert list(read_scenes("scenes.tsv", cities)) == ["Good-1", "Qichun-1"]
    assert not any(findings.failed for findings in check_project(names=["Qichun"]))


def test_a_sites_images_are_listed_and_the_command_said_last_chooses_a_pair(folder, monkeypatch):
    images = [*copied(folder, "a", "b"), folder / "named/c.1.tif"]
    shutil.copy(images[0], images[2])
    begin(folder / "site")
    monkeypatch.chdir(folder / "site")
    lines = add_scene([Path("../named")], lidar="../lidar", gcps="../gcps.csv", city="Site")
    assert list(read_rows(configured()[0])[2]) == ["a", "b", "c-1"]
    before = Path("images.tsv").read_text()
    add_scene(images, lidar="../lidar", city="Site")  # once only
    assert Path("images.tsv").read_text() == before
    choose = shlex.split(lines[-1].partition("Next: stereotruth ")[2])
    assert CliRunner().invoke(app, choose).exit_code == 0
    assert (row()["city"], row()["gcps"]) == ("Site", "../gcps.csv")
    assert list(read_rows(configured()[0])[1]) == [row()["scene"]]


def test_images_of_a_site_get_names_that_no_other_has(folder, monkeypatch):
    images = [*copied(folder, "a", "c-1"), folder / "named/c.1.tif"]
    shutil.copy(images[0], images[2])
    shutil.copytree(folder / "named", folder / "other")
    begin(folder / "site")
    monkeypatch.chdir(folder / "site")
    for k, name in enumerate(("named", "other"), 1):
        add_scene([Path("..", name)], lidar="../lidar", city=f"Site{k}")
    names = ["a", "c-1", "c-1-2", "a-2", "c-1-3", "c-1-4"]
    assert list(read_rows(configured()[0])[2]) == names


def test_images_that_are_named_keep_their_order(folder):
    first, second = copied(folder, "a", "b")
    lines = add_scene([second, first], lidar="lidar", city="Good")
    assert row()["left_image"].endswith("b.tif")
    assert any("left looks forward" in line for line in lines)
    assert row()["scene"] == "Good-2"


def copied(folder, left, right):
    """Copies of the good scene's images under other names, in a folder of their own."""
    (folder / "named").mkdir()
    return [
        Path(shutil.copy(folder / f"{view}.tif", folder / "named" / f"{name}.tif"))
        for view, name in (("left", left), ("right", right))
    ]


def test_control_points_say_which_image_is_left(folder):
    """Their columns belong to one image each, whatever the view angle says."""
    with (folder / "gcps.csv").open(newline="") as stream:
        points = list(csv.DictReader(stream))
    other = {"left": "right", "right": "left"}
    with (folder / "exchanged.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, points[0])
        writer.writeheader()
        for point in points:
            sides = {
                f"{view}_{axis}": point[f"{other[view]}_{axis}"]
                for view in other for axis in ("col", "row")
            }  # fmt: skip
            writer.writerow(point | sides)
    copied(folder, "a", "b")
    lines = add_scene([folder / "named"], lidar="lidar", gcps="exchanged.csv", city="Good")
    assert row()["left_image"].endswith("b.tif")
    assert any("sides by the control points" in line for line in lines)
    (folder / "named").rename(folder / "plain")
    copied(folder, "left", "right")
    with pytest.raises(InputError, match=r"control points miss by .* with left\.tif as left"):
        add_scene([folder / "named"], lidar="lidar", gcps="exchanged.csv", city="Good")


def test_a_pair_is_added_once(folder):
    with pytest.raises(InputError, match="scene 'Good-1' has these two images already"):
        add_scene([folder / "left.tif", folder / "right.tif"], lidar="lidar", city="Good")


@pytest.mark.parametrize(
    ("break_it", "options", "words"),
    [(lambda f: worldview(f / "d", 4), {}, "an image in 4 files"),
     (lambda f: shutil.copy(f / "left.tif", f / "d" / "one.tif"), {}, "1 images that may be"),
     (lambda f: plain(f / "d" / "a.tif", "left") and plain(f / "d" / "b.tif", "left"), {},
      "no RPC metadata"),
     (lambda f: gaofen(f / "d") and write_lidar(f, system=None), {}, "set --lidar-crs"),
     (lambda f: gaofen(f / "d") and write_lidar(f, system=None), {"lidar_crs": "EPSG:32639"},
      "degrees away from the images"),  # the good LiDAR lies in zone 50
     (lambda f: gaofen(f / "d"), {"lidar": "none"}, "no LiDAR file"),
     (lambda f: gaofen(f / "d"), {"gcps": "none.csv"}, "none.csv"),
     (lambda f: gaofen(f / "d"), {"name": "Good-1"}, "is there already")],
)  # fmt: skip
def test_nothing_is_written_of_what_cannot_be_used(folder, break_it, options, words):
    before = (folder / "scenes.tsv").read_text(), (folder / "cities.tsv").read_text()
    (folder / "d").mkdir()
    break_it(folder)
    with pytest.raises(InputError, match=words):
        add_scene([folder / "d"], **({"lidar": "lidar", "city": "New"} | options))
    assert ((folder / "scenes.tsv").read_text(), (folder / "cities.tsv").read_text()) == before
