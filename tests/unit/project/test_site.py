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

from ...synthetic.broken_scenes import with_pixels, write_settings, write_sheet
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


FAULTS = {
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
