"""What a check says of the images of a site, before anything runs."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.project.check import check_project
from stereotruth.project.findings import Level
from stereotruth.project.project import configured, read_images, read_scenes
from stereotruth.project.site import images_of

from ...synthetic.broken_scenes import ROW, with_pixels, write_settings, write_sheet
from ...synthetic.surveyed_pair import RPCS, SIZES, make_gcps, write_image

HEADER = "image\tcity\tfile\tacquired\tsun_azimuth\tsun_elevation\tmask\n"
ROWS = ("L\tGood\tleft.tif\t2020-10-25T03:12:45Z", "R\tGood\tright.tif\t2020-10-25T03:13:40Z")
PAIR_APART = re.compile("do not overlap|no ground")
IMD = "firstLineTime = {}T03:12:45Z;\nmeanSunAz = {};\nmeanSunEl = 40;\n"


def write_images(*rows: str) -> None:
    Path("images.tsv").write_text(HEADER + "\n".join(rows) + "\n")


def write_long_gcps(names: tuple[str, str] = ("L", "R")) -> None:
    lines = ["id,lon,lat,height,image,col,row"]
    for row in make_gcps(15):
        for name, view in zip(names, ("left", "right")):
            cells = (row["id"], row["lon"], row["lat"], row["height"], name)
            lines.append(",".join(map(str, (*cells, row[f"{view}_col"], row[f"{view}_row"]))))
    Path("gcps.csv").write_text("\n".join(lines) + "\n")


@pytest.fixture
def site(folder):
    write_settings(folder, images="images.tsv")
    write_sheet(folder, left_image="L", right_image="R")
    write_images(*ROWS)
    write_long_gcps()
    return folder


def said(level: Level) -> list[str]:
    every = [finding for findings in check_project() for finding in findings]
    return [f"{f.text}. Remedy: {f.remedy}" for f in every if f.level is level]


def test_a_good_site_has_nothing_said_against_it(site):
    assert said(Level.ERROR) == said(Level.DOUBT) == []
    facts = "\n".join(said(Level.FACT))
    assert "2 of images.tsv, 2 with a date" in facts
    assert "15 and 15 of 15 used" in facts


def copy_of_left(folder: Path) -> None:
    shutil.copy(folder / "left.tif", folder / "copy.tif")
    write_images(*ROWS, "Again\tGood\tcopy.tif\t2020-10-25")


def image_from_elsewhere(folder: Path) -> None:
    rpc = replace(RPCS["left"], long_off=RPCS["left"].long_off + 1.0)
    with_pixels(write_image(folder / "far.tif", rpc, SIZES["left"]))
    write_images(*ROWS, "Far\tGood\tfar.tif\t2020-10-25")


def images_of_two_sites(folder: Path) -> None:
    with Path("cities.tsv").open("a", encoding="utf-8") as sheet:
        sheet.write("Other\tOT\t1\t1\t1\n")
    write_images(ROWS[0], ROWS[1].replace("Good", "Other"))


FAULTS = {
    "one file under two names": (
        lambda folder: write_images(*ROWS, "Again\tGood\t./left.tif"),
        "images.tsv: line 4: image 'Again': its file is that of image 'L' in line 2",
    ),
    "images of two sites": (
        images_of_two_sites,
        "scenes.tsv: line 2: scene 'Good-1': right_image 'R' is an image of Other, the scene is of",
    ),
    "a date of another form": (
        lambda folder: write_images(ROWS[0], ROWS[1].replace("2020-10-25", "25.10.2020")),
        "images.tsv: line 3: image 'R': acquired '25.10.2020T03:13:40Z' is not of the form",
    ),
    "same bytes": (copy_of_left, "images 'L' and 'Again' are one image"),
    "not of the site": (image_from_elsewhere, "image 'Far' shares no ground with any other"),
    "no file": (
        lambda folder: write_images(*ROWS, "X\tGood\tx.tif"),
        "image 'X': file 'x.tif' does not exist",
    ),
    "no mask": (
        lambda folder: write_images(ROWS[0], ROWS[1] + "\t\t\tm.tif"),
        "m.tif' does not exist",
    ),
    "points of an unknown image": (
        lambda folder: write_long_gcps(("L", "Q")),
        "line 3: control points of image 'Q', which is not in the images sheet (images.tsv)",
    ),
    "a pair with itself": (
        lambda folder: write_sheet(folder, left_image="L", right_image="L"),
        "scenes.tsv: line 2: scene 'Good-1' names one image twice",
    ),
    "time without zone": (
        lambda folder: write_images(ROWS[0].rstrip("Z"), ROWS[1]),
        "images.tsv: line 2: image 'L': acquired '2020-10-25T03:12:45' has no time zone",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_of_a_site_are_errors_with_a_remedy(site, fault):
    plant, words = FAULTS[fault]
    plant(site)
    errors = said(Level.ERROR)
    assert any(words in text for text in errors), errors
    assert all(len(text.split("Remedy: ")[1]) > 5 for text in errors)


def test_a_pair_without_shared_ground_is_an_error(site):
    """The pair by its scene, and the image by its row."""
    image_from_elsewhere(site)
    write_sheet(site, left_image="L", right_image="Far", gcps="")
    errors = said(Level.ERROR)
    assert sum("image 'Far' shares no ground" in text for text in errors) == 1
    assert any("Far" not in text and PAIR_APART.search(text) for text in errors), errors


@pytest.mark.parametrize(
    "times",
    [
        ("2020-10-25T03:12:45Z", "2020-10-25T03:13:40Z"),
        ("2020-10-25 11:12:45+08:00", "2020-10-25T03:13:40Z"),
        ("2020-10-24T22:12:45-05:00", "2020-10-25T03:13:40+00:00"),
    ],
)
def test_times_of_any_zone_are_one_moment(site, times):
    write_images(*(f"{row.rpartition(chr(9))[0]}\t{time}" for row, time in zip(ROWS, times)))
    assert said(Level.ERROR) == said(Level.DOUBT) == []
    settings, _ = configured()
    cities, _ = read_scenes(settings)
    left, right = (one.image for one in images_of("Good", read_images(settings, cities), settings))
    assert (right.time - left.time).total_seconds() == 55


def test_long_control_points_without_an_images_sheet_are_an_error(site):
    write_settings(site)
    write_sheet(site)
    assert any("scene's images have no names" in text for text in said(Level.ERROR))


DOUBTS = {
    "no date": (lambda: write_images("L\tGood\tleft.tif", ROWS[1]), "nothing says when"),
    "another date": (
        lambda: Path("left.IMD").write_text(IMD.format("2019-01-01", 160)),
        "acquired is 2020-10-25T03:12:45Z, and left.IMD says 2019-01-01T03:12:45Z",
    ),
    "another sun": (
        lambda: (
            write_images(ROWS[0] + "\t90\t40", ROWS[1]),
            Path("left.IMD").write_text(IMD.format("2020-10-25", 160)),
        ),
        "the sun is at 90, 40 degrees",
    ),
}


@pytest.mark.parametrize("doubt", DOUBTS)
def test_what_the_delivery_contradicts_is_a_doubt(site, doubt):
    plant, words = DOUBTS[doubt]
    plant()
    assert said(Level.ERROR) == []
    assert any(words in text for text in said(Level.DOUBT))


def test_the_sheet_goes_before_the_delivery_and_that_before_a_formula(site):
    Path("left.IMD").write_text(IMD.format("2020-10-25", 160))
    write_images("L\tGood\tleft.tif", ROWS[1] + "\t150\t41")
    settings, _ = configured()
    cities, _ = read_scenes(settings)
    left, right = (one.image for one in images_of("Good", read_images(settings, cities), settings))
    assert left.time.isoformat() == "2020-10-25T03:12:45+00:00" and left.sun == (160.0, 40.0)
    assert right.sun == (150.0, 41.0)


def test_a_site_has_two_images(site):
    settings, _ = configured()
    with pytest.raises(InputError, match="0 images of city 'Nowhere'"):
        images_of("Nowhere", read_images(settings, read_scenes(settings)[0]), settings)
    write_settings(site)
    settings, _ = configured()
    with pytest.raises(InputError, match="no images sheet"):
        images_of("Good", {}, settings)


def test_scenes_may_name_the_files_of_the_sheet(site):
    write_sheet(site, **{key: ROW[key] for key in ("left_image", "right_image")})
    assert said(Level.ERROR) == []
