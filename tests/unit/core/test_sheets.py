from __future__ import annotations

import re
from datetime import UTC, date, datetime
from pathlib import Path

import pytest

from stereotruth.core import sheets
from stereotruth.core.errors import InputError
from stereotruth.core.tables import SheetError, acquisition_time

ROOT = Path(__file__).parents[3]
CITIES = "city\tprefix\ttraining\tvalidation\ttesting\nQichun\tQC\t600\t80\t200\n"
COLUMNS = ("scene", "city", "left_image", "right_image", "lidar", "lidar_crs", "geoid", "gcps")
ROW = ("Qichun-1", "Qichun", "l.tif", "r.tif", "lidar", "", "", "g.csv")


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def scenes_text(*rows: tuple[str, ...], columns: tuple[str, ...] = COLUMNS) -> str:
    return "\n".join("\t".join(row) for row in (columns, *rows)) + "\n"


def with_cell(column: str, value: str) -> tuple[str, ...]:
    return tuple(value if name == column else cell for name, cell in zip(COLUMNS, ROW))


@pytest.fixture
def cities(tmp_path):
    return sheets.read_cities(write(tmp_path / "cities.tsv", CITIES))


def test_the_sheets_of_the_project_are_valid():
    cities = sheets.read_cities(ROOT / "config" / "cities.tsv")
    scenes = sheets.read_scenes(ROOT / "config" / "scenes.tsv", cities)
    assert {scene.city for scene in scenes.values()} == set(cities)
    # table 3 of the paper
    assert sum(c.training + c.validation + c.testing for c in cities.values()) == 1757


def test_a_sheet_is_read_with_crlf_bom_comments_and_short_rows(tmp_path, cities):
    text = "\ufeff" + scenes_text(ROW) + "# a remark\n\n"
    file = write(tmp_path / "s.tsv", text.replace("\n", "\r\n"))
    scene = sheets.read_scenes(file, cities)["Qichun-1"]
    assert (scene.left_image, scene.lidar_crs, scene.gcps) == ("l.tif", "", "g.csv")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (scenes_text(with_cell("city", "Quichun")), ["'Quichun'", "did you mean 'Qichun'"]),
        (scenes_text(with_cell("scene", "Qichun_1")), ["line 2", "Qichun_1", "unique id"]),
        (scenes_text(ROW, ROW), ["'Qichun-1'", "more than one row"]),
        (scenes_text(with_cell("lidar", "")), ["line 2", "lidar"]),
        (scenes_text(with_cell("scene", "x" * 200)), ["line 2", "at most 100 characters"]),
        (scenes_text(with_cell("scene", "ab" * 25)), ["line 2", "again and again"]),
        (scenes_text(with_cell("left_image", "in/{city}.tif")), ["line 2", "name in { }"]),
        (scenes_text(with_cell("gcps", "{scene}.csv")), ["line 2", "name in { }"]),
        (scenes_text(with_cell("right_image", "l.tif")), ["one image twice"]),
        (scenes_text(ROW, columns=(*COLUMNS[:-1], "gcp")), ["'gcps' is missing", "'gcp' is unkn"]),
        (scenes_text(ROW).replace("\t", ","), ["separated by tabs"]),
        ("", ["it is empty"]),
    ],
)
def test_a_wrong_scenes_sheet_is_refused_by_name(tmp_path, cities, text, words):
    file = write(tmp_path / "scenes.tsv", text)
    with pytest.raises(InputError) as refusal:
        sheets.read_scenes(file, cities)
    for word in ["scenes.tsv", "Remedy", *words]:
        assert word in str(refusal.value)


def test_all_mistakes_of_a_sheet_are_told_at_once(tmp_path, cities):
    rows = (with_cell("city", "Quichun"), ROW, with_cell("right_image", "l.tif"))
    file = write(tmp_path / "scenes.tsv", scenes_text(*rows))
    with pytest.raises(SheetError, match=r"line 2.*\(and 2 more mistakes: ") as refusal:
        sheets.read_scenes(file, cities)
    words = ("'Quichun'", "names one image twice", "stands in more than one row")
    assert len(refusal.value.each) == len(words)
    for word, each in zip(words, refusal.value.each):
        assert word in str(each) and "scenes.tsv" in str(each)


def test_mistakes_are_told_up_to_a_hundred(tmp_path, cities):
    rows = [with_cell("city", f"Quichun{k}") for k in range(1000)]
    file = write(tmp_path / "scenes.tsv", scenes_text(*rows))
    with pytest.raises(SheetError, match="and 99 more mistakes") as refusal:
        sheets.read_scenes(file, cities)
    assert len(refusal.value.each) == 100


def test_a_count_that_is_no_number_is_refused(tmp_path):
    file = write(tmp_path / "cities.tsv", CITIES.replace("600", "many"))
    with pytest.raises(InputError, match="training is 'many'"):
        sheets.read_cities(file)


def scene_with_lidar(lidar: Path | str) -> sheets.Scene:
    return sheets.Scene(*with_cell("lidar", str(lidar)))


def test_lidar_is_found_by_folder_glob_and_file(tmp_path):
    for name in ("b.laz", "a.LAS", "c.copc.laz", "notes.txt"):
        (tmp_path / name).touch()
    found = sheets.find_lidar(scene_with_lidar(tmp_path), "s.tsv")
    assert [f.name for f in found] == ["a.LAS", "b.laz", "c.copc.laz"]
    assert len(sheets.find_lidar(scene_with_lidar(tmp_path / "*.laz"), "s.tsv")) == 2
    assert len(sheets.find_lidar(scene_with_lidar(tmp_path / "b.laz"), "s.tsv")) == 1
    assert sheets.store_names(found).keys() == {"a", "b", "c"}


def test_surface_models_are_found_where_there_are_no_points(tmp_path):
    for name in ("a/b.tif", "a/B.TIFF", "a/notes.txt", "c/d.las", "c/orthophoto.tif"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = sheets.lidar_files(str(tmp_path / "a"))
    assert [f.name for f in found] == ["B.TIFF", "b.tif"]
    assert sheets.store_names([*found, tmp_path / "c.tif"]).keys() == {"B", "b", "c"}
    assert [f.name for f in sheets.lidar_files(str(tmp_path / "c"))] == ["d.las"]


def test_lidar_may_be_a_list(tmp_path):
    for name in ("a.las", "b.laz", "c.tif"):
        (tmp_path / name).touch()
    cell = f"{tmp_path / 'c.tif'}; {tmp_path / '*.la?'};{tmp_path / 'a.las'};"
    assert [f.name for f in sheets.lidar_files(cell)] == ["a.las", "b.laz", "c.tif"]
    with pytest.raises(InputError, match="no LiDAR file at 'none'"):
        sheets.lidar_files(f"{tmp_path / 'a.las'};none")
    with pytest.raises(InputError, match="no LiDAR file is named"):
        sheets.lidar_files(" ; ")


def test_no_lidar_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"Qichun-1.*no LiDAR file"):
        sheets.find_lidar(scene_with_lidar(tmp_path / "none" / "*.laz"), "s.tsv")


def test_lidar_files_of_one_stem_get_names_of_their_own():
    files = [Path("east/1.laz"), Path("west/1.laz"), Path("2.las")]
    names = sheets.store_names(files)
    assert sorted(names.values()) == sorted(files)
    assert "2" in names and "1" not in names
    assert names == sheets.store_names(reversed(files))


def test_lidar_files_with_endless_names_get_short_ones():
    """Names of 255 bytes leave no room for what is added, and Snakemake takes repeats for loops."""
    files = [
        Path("a", "x1" * 120 + ".laz"),
        Path("b", "x1" * 120 + "3.laz"),
        Path("y" * 30 + ".las"),
    ]
    names = sheets.store_names(files)
    assert sorted(names.values()) == sorted(files) and len(names) == 3
    assert all(len(name) <= 100 and not re.search(r"(.+)\1{18}$", name) for name in names)


def test_lidar_files_that_snakemake_takes_for_patterns_are_refused(tmp_path):
    (tmp_path / "a{city}.laz").touch()
    with pytest.raises(InputError, match=r"name in \{ \}"):
        sheets.lidar_files(str(tmp_path))


def test_a_lidar_file_that_is_none_is_refused_with_its_name(tmp_path):
    (tmp_path / "a.laz").touch()
    (tmp_path / "b.laz").symlink_to("nowhere")
    for lidar in (tmp_path, tmp_path / "*.laz"):
        with pytest.raises(InputError, match=r"b\.laz: is a folder, or a link"):
            sheets.find_lidar(scene_with_lidar(lidar), "scenes.tsv")


def test_names_longer_than_file_systems_have_are_refused():
    for name in ("é" * 200, "a/" * 2500):
        with pytest.raises(InputError, match="no LiDAR file"):
            sheets.lidar_files(name)
        with pytest.raises(InputError, match=r"scenes\.tsv: .* does not exist"):
            sheets.require_files(scene_with_lidar(name), "scenes.tsv", ["lidar"])


def test_a_sheet_that_is_cut_short_is_refused(tmp_path, cities):
    text = scenes_text(ROW)
    for end in (-2, -10):  # in the last cell, which nothing tells, and before it
        file = write(tmp_path / "scenes.tsv", text[:end])
        if end == -2:
            assert len(sheets.read_scenes(file, cities)) == 1
        else:
            with pytest.raises(
                InputError,
                match=r"scenes\.tsv: line 2 has 5 cells .*ends",
            ):
                sheets.read_scenes(file, cities)


def test_more_scenes_than_are_planned_are_refused_by_number(tmp_path, cities):
    rows = [with_cell("scene", f"Q-{k}") for k in range(20_000)]
    file = write(tmp_path / "s.tsv", scenes_text(*rows))
    with pytest.raises(InputError, match="20000 scenes; a project has at most 2000"):
        sheets.read_scenes(file, cities)


# ------------------------------------------------------------------------------------- images

IMAGES = ("image", "city", "file", "acquired", "sun_azimuth", "sun_elevation", "mask")
TWO_CITIES = CITIES + "Wuhan\tWH\t1\t1\t1\n"


def images_of(folder: Path, *rows: str, columns: tuple[str, ...] = IMAGES):
    cities = sheets.read_cities(write(folder / "c.tsv", TWO_CITIES))
    text = "\n".join(["\t".join(columns), *rows]) + "\n"
    return sheets.read_images(write(folder / "i.tsv", text), cities), cities


def test_columns_of_an_image_that_is_not_known_may_be_left_out(tmp_path):
    images, _ = images_of(tmp_path, "A_1\tQichun\ta.tif", columns=IMAGES[:3])
    assert images["A_1"] == sheets.Image("A_1", "Qichun", "a.tif")


@pytest.mark.parametrize(
    ("text", "time"),
    [
        ("2020-10-25", date(2020, 10, 25)),
        ("2020-10-25T03:12:45Z", datetime(2020, 10, 25, 3, 12, 45, tzinfo=UTC)),
        ("2020-10-25T11:12:45+08:00", datetime(2020, 10, 25, 3, 12, 45, tzinfo=UTC)),
        ("2020-10-25 03:12Z", datetime(2020, 10, 25, 3, 12, tzinfo=UTC)),
    ],
)
def test_times_of_images(text, time):
    assert acquisition_time(text) == time


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["A\tQuichun\ta.tif"], ["line 2: image 'A'", "did you mean 'Qichun'"]),
        (["A\tQichun\ta.tif", "A\tQichun\tb.tif"], ["image 'A'", "more than one row"]),
        (["A\tQichun\ta.tif", "B\tQichun\t./a.tif"], ["line 3: image 'B'", "image 'A' in line 2"]),
        (["A\tQichun\ta.tif\t25.10.2020"], ["line 2: image 'A'", "25.10.2020", "2020-10-25T"]),
        (["A\tQichun\ta.tif\t2020-10-25T03:12:45"], ["image 'A'", "no time zone"]),
        (["A\tQichun\ta.tif\t2020-13-25"], ["image 'A'", "2020-13-25"]),
        (["A\tQichun\ta.tif\t2020-10-25T03:12 CST"], ["image 'A'", "is not of the form"]),
        (["A\tQichun\ta.tif\t\t150\t"], ["image 'A'", "are not two numbers"]),
        (["A\tQichun\ta.tif\t\t150\t-5"], ["image 'A'", "is not in the sky"]),
        (["A b\tQichun\ta.tif"], ["line 2", "A b"]),
    ],
)
def test_faults_of_images_name_the_row_and_the_remedy(tmp_path, rows, words):
    with pytest.raises(InputError) as caught:
        images_of(tmp_path, *rows)
    assert all(word in str(caught.value) for word in (*words, "i.tsv", "Remedy"))


STACK = ("A\tQichun\ta.tif\t\t\t\tclouds.tif", "B\tQichun\tb.tif", "C\tWuhan\tc.tif")


@pytest.mark.parametrize(
    ("cells", "files", "masks"),
    [
        (("B", "A"), ("b.tif", "a.tif"), ("", "clouds.tif")),
        (("a.tif", "B"), ("a.tif", "b.tif"), ("clouds.tif", "")),
        (("./a.tif", "x.tif"), ("a.tif", "x.tif"), ("clouds.tif", "")),
        (("x.tif", "y.tif"), ("x.tif", "y.tif"), ("", "")),
    ],
)
def test_scenes_name_images_or_their_files(tmp_path, cells, files, masks):
    images, cities = images_of(tmp_path, *STACK)
    row = ("Qichun-1", "Qichun", *cells, "lidar", "", "", "g.csv")
    scene = sheets.read_scenes(write(tmp_path / "s.tsv", scenes_text(row)), cities, images)[
        "Qichun-1"
    ]
    assert (scene.left_image, scene.right_image) == files
    assert (scene.left_mask, scene.right_mask) == masks


def test_a_scene_s_own_mask_goes_before_the_image_s(tmp_path):
    images, cities = images_of(tmp_path, *STACK)
    text = scenes_text((*ROW[:2], "A", "B", *ROW[4:], "mine.tif"), columns=(*COLUMNS, "left_mask"))
    scene = sheets.read_scenes(write(tmp_path / "s.tsv", text), cities, images)["Qichun-1"]
    assert scene.left_mask == "mine.tif"


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        (("A", "A"), ["names one image twice"]),
        (("A", "a.tif"), ["names one image twice"]),
        (("A", "C"), ["right_image 'C' is an image of Wuhan", "scene is of Qichun"]),
        (("A", "D"), ["'D' is no image of the images sheet, and no file"]),
    ],
)
def test_scenes_of_images_that_are_no_pair_are_refused(tmp_path, cells, words):
    images, cities = images_of(tmp_path, *STACK)
    row = ("Qichun-1", "Qichun", *cells, "lidar", "", "", "g.csv")
    with pytest.raises(InputError) as caught:
        sheets.read_scenes(write(tmp_path / "s.tsv", scenes_text(row)), cities, images)
    assert all(w in str(caught.value) for w in (*words, "line 2: scene 'Qichun-1'", "s.tsv"))
