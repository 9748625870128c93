"""Pairs of a site: listed, chosen, written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from stereocities.sites import simulate_site_image
from stereotruth.core.errors import InputError
from stereotruth.lidar.ingest import ingest
from stereotruth.project.check import check_project
from stereotruth.project.main import app
from stereotruth.project.pairs import Choice, list_pairs, rated_pairs, table
from stereotruth.project.project import configured, names_in_pair, read_images, read_scenes
from stereotruth.project.simulated_project import SITE
from stereotruth.sensor.site_pairs import RatedPair, SitePair, quality_of

from ...synthetic.las import write_las

HEADER = "scene\tcity\tleft_image\tright_image\tlidar\tlidar_crs\tgeoid\tgcps\n"


@pytest.fixture(scope="session")
def images(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    for image in SITE.images[:4]:
        small = replace(image, cols=96, rows=96)
        simulate_site_image(SITE, small, folder / f"{image.name}.tif", seed=1)
    return folder


def write_images(rows: list[str]) -> None:
    text = "\n".join(["image\tcity\tfile\tacquired", *rows]) + "\n"
    Path("images.tsv").write_text(text)


@pytest.fixture
def rows(images, tmp_path, monkeypatch) -> list[str]:
    """A project of a site of four images and no scene; the rows of its images sheet."""
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text("scenes: s.tsv\ncities: c.tsv\nimages: images.tsv\n")
    Path("s.tsv").write_text(HEADER)
    Path("c.tsv").write_text("city\tprefix\ttraining\tvalidation\ttesting\nStack\tST\t1\t1\t1\n")
    found = [
        f"{image.name}\tStack\t{images}/{image.name}.tif\t{image.acquired.isoformat()}"
        for image in SITE.images[:4]
    ]
    write_images(found)
    return found


def written() -> list[tuple[str, str]]:
    settings, _ = configured()
    cities, scenes = read_scenes(settings)
    return [names_in_pair(scene, read_images(settings, cities)) for scene in scenes.values()]


LIDAR = {"lidar": "lidar", "gcps": "gcps/all.csv"}


def test_all_pairs_are_listed_best_first_whatever_the_order_of_the_sheet(rows):
    settings, _ = configured()
    rated = rated_pairs("Stack", settings)
    assert len(rated) == 6
    assert [r.quality.bits for r in rated] == sorted((r.quality.bits for r in rated), reverse=True)
    write_images(rows[::-1])
    assert rated_pairs("Stack", settings) == rated
    assert Path("s.tsv").read_text() == HEADER


def test_chosen_pairs_become_rows_that_the_sheet_is_read_with(rows):
    listing = list_pairs("Stack", Choice(most=2), LIDAR)
    assert len(written()) == 2 and "2 of 6 pairs written" in listing.lines[1]
    assert listing.chosen == written() and "* 2 of them are scenes" in listing.lines[2]
    assert sum(line[0] == "*" for line in table(listing.rated, listing.chosen)) == 2
    row = Path("s.tsv").read_text().splitlines()[1].split("\t")
    assert row[4:] == ["lidar", "", "", "gcps/all.csv"]
    assert all("-" in name and "_" not in name for name in (row[0],))
    list_pairs("Stack", Choice(convergence=None), {})  # LiDAR of the rows before
    assert sorted(map(sorted, written())) == sorted(sorted(r.names) for r in listing.rated)


def test_points_that_scenes_have_ingested_enter_the_prediction(rows):
    before = list_pairs("Stack", Choice(most=2), LIDAR)
    assert "no LiDAR of Stack has been ingested" in before.lines[0]
    scene = Path("s.tsv").read_text().splitlines()[1].split("\t")[0]
    rng = np.random.default_rng(1)
    xyz = np.array([500_040.0, 3_390_070.0, 0.0]) + rng.uniform(0, (90, 90, 30), (30_000, 3))
    write_las(Path("tall.las"), xyz=xyz)
    ingest(Path("tall.las"), Path(f"results/ingest/Stack/{scene}/tall.points"))
    after = list_pairs("Stack", None, {})
    assert "steps of" in after.lines[0] and not any("written" in line for line in after.lines)
    matched = [{r.names: r.quality.matched for r in listed.rated} for listed in (before, after)]
    assert all(matched[1][names] < matched[0][names] for names in matched[0])


PAIR = SitePair(
    "A", "B", 1.0, 0.9, convergence=20.0, bisector=80.0, asymmetry=3.0, off_nadir=12.0,
    pixel_ratio=1.0, pixel_m=0.5, sun=0.1, shadow=0.1, days=3.0,
)  # fmt: skip


def test_limits():
    for choice, change, taken in (
        (Choice(), {}, True),
        (Choice(), {"convergence": 4.0}, False),
        (Choice(convergence=None), {"convergence": 50.0}, True),
        (Choice(), {"shared": 0.01}, False),
        (Choice(days=(0, 2)), {}, False),
        (Choice(days=(0, 30)), {"days": None}, False),
        (Choice(), {"days": None}, True),
        (Choice(diachronic=True), {}, True),  # shadows of buildings move by 2 px
        (Choice(diachronic=True), {"shadow": 0.02}, False),
        (Choice(diachronic=True), {"shadow": None}, False),
        (Choice(diachronic=True), {"shadow": 0.02, "days": 31.0}, True),
    ):
        assert choice.allows(replace(PAIR, **change)) is taken


def rate_all(pairs: list[SitePair]) -> list[RatedPair]:
    return [RatedPair(pair, quality_of(pair)) for pair in pairs]


def rated(*names: str) -> list[RatedPair]:
    return rate_all([replace(PAIR, left=name[0], right=name[1]) for name in names])


@pytest.mark.parametrize(
    ("listed", "choice", "taken"),
    [
        ("AB AC AD BD CD", Choice(each=1), "AB CD"),
        ("AB AC AD BD CD", Choice(each=2, most=3), "AB AC BD"),
        ("AB AC BC CD", Choice(most=2), "AB AC"),
        ("AB AC BC CD", Choice(most=3), "AB AC CD"),
        # too few for all six: as many as they can link, and no islands
        ("AB CD EF BC DE AC", Choice(most=3), "AB CD BC"),
        ("AB CD EF BC DE AC", Choice(most=5), "AB CD EF BC DE"),
        ("AB CD", Choice(most=2), "AB CD"),  # no pair links them
    ],
)
def test_chosen_pairs_link_as_many_images_as_they_can(listed, choice, taken):
    chosen = choice.of(rated(*listed.split()))
    assert [one.pair.left + one.pair.right for one in chosen] == taken.split()


def test_the_choice_spreads_over_convergences():
    pairs = [
        replace(PAIR, left=left, right=right, convergence=convergence)
        for left, right, convergence in (("A", "B", 18.0), ("B", "C", 17.0), ("A", "C", 35.0))
    ]
    listed = rate_all(pairs)
    assert listed[0].names == ("A", "B") and listed[1].names == ("B", "C")
    assert [one.names for one in Choice(most=2).of(listed)] == [("A", "B"), ("A", "C")]


def test_images_without_a_link_are_named_with_the_pairs_that_would_link_them(rows):
    best = rated_pairs("Stack", configured()[0])[0].pair
    lines = list_pairs("Stack", Choice(most=1), LIDAR).lines
    assert lines[-2].startswith("2 images in no pair: ")
    assert not any(f" {name}" in lines[-2] for name in (best.left, best.right))
    assert (
        lines[-1].startswith("best pairs that would link them: ")
        and lines[-1].count("bits/px") == 2
    )
    (links,) = [findings for findings in check_project() if findings.scene == "images"]
    assert [f.text for f in links if f.about == "pairs"] == [f"Stack: {lines[-2]}"]
    lines = list_pairs("Stack", Choice(most=3), {}).lines
    assert "Next: stereotruth check" in lines[-2]


def test_the_command_lists_and_writes(rows):
    run = CliRunner().invoke(app, ["pairs", "Stack"])
    assert run.exit_code == 0 and "6 pairs" in run.output and "°" in run.output
    with pytest.raises(InputError, match="--lidar"):
        list_pairs("Stack", Choice(most=1), {})
    assert written() == []
    run = CliRunner().invoke(app, ["pairs", "Stack", "--all", "--most", "3", "--lidar", "l"])
    assert run.exit_code == 0 and len(written()) == 3
