"""Sheets that users write: what is read, and what is refused by sheet, row and remedy."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stereotruth.core import sheets
from stereotruth.core.errors import InputError
from stereotruth.core.tables import SheetError

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
        (scenes_text(with_cell("city", "Quichun")), "did you mean 'Qichun'"),
        (scenes_text(with_cell("scene", "Qichun_1")), "line 2"),
        (scenes_text(ROW, ROW), "'Qichun-1'"),
        (scenes_text(with_cell("lidar", "")), "line 2"),
        (scenes_text(with_cell("scene", "x" * 200)), "line 2"),
        (scenes_text(with_cell("scene", "ab" * 25)), "line 2"),
        (scenes_text(with_cell("left_image", "in/{city}.tif")), "line 2"),
        (scenes_text(with_cell("right_image", "l.tif")), "one image twice"),
        (scenes_text(ROW, columns=(*COLUMNS[:-1], "gcp")), "'gcps' is missing"),
        (scenes_text(ROW).replace("\t", ","), "tabs"),
        (scenes_text(ROW)[:-10], "line 2"),
        (scenes_text(*(with_cell("scene", f"Q-{k}") for k in range(3000))), "3000 scenes"),
        ("", "empty"),
    ],
)
def test_a_wrong_scenes_sheet_is_refused_by_name(tmp_path, cities, text, words):
    file = write(tmp_path / "scenes.tsv", text)
    with pytest.raises(InputError) as refusal:
        sheets.read_scenes(file, cities)
    for word in ("scenes.tsv", "Remedy", words):
        assert word in str(refusal.value)


def test_all_mistakes_of_a_sheet_are_told_at_once_up_to_a_hundred(tmp_path, cities):
    rows = (with_cell("city", "Quichun"), ROW, with_cell("right_image", "l.tif"))
    file = write(tmp_path / "scenes.tsv", scenes_text(*rows))
    with pytest.raises(SheetError) as refusal:
        sheets.read_scenes(file, cities)
    words = ("'Quichun'", "names one image twice", "stands in more than one row")
    for word, each in zip(words, refusal.value.each, strict=True):
        assert word in str(each) and "scenes.tsv" in str(each)
    write(file, scenes_text(*(with_cell("city", f"Quichun{k}") for k in range(1000))))
    with pytest.raises(SheetError) as refusal:
        sheets.read_scenes(file, cities)
    assert len(refusal.value.each) == 100
    write(file, CITIES.replace("600", "many"))
    with pytest.raises(InputError, match="training: 'many'"):
        sheets.read_cities(file)


def test_cells_that_are_no_epoch_are_refused(tmp_path):
    columns = (*COLUMNS, "lidar_epoch")
    towns = CITIES.replace("testing", "testing\tepoch").replace("200\n", "200\t{}\n")
    for lidar, city in (("May 2016", ""), ("16.4", ""), ("", "2016-13-01")):
        cities = write(tmp_path / "cities.tsv", towns.format(city))
        scenes = write(tmp_path / "s.tsv", scenes_text((*ROW, lidar), columns=columns))
        with pytest.raises(InputError, match=f"line 2.*'{lidar or city}'"):
            sheets.read_scenes(scenes, sheets.read_cities(cities))


def scene_with_lidar(lidar: Path | str) -> sheets.Scene:
    return sheets.Scene(*with_cell("lidar", str(lidar)))


def names(lidar: Path | str) -> list[str]:
    return [file.name for file in sheets.find_lidar(scene_with_lidar(lidar), "s.tsv")]


def test_lidar_is_found_by_folder_glob_file_and_list(tmp_path):
    for name in ("b.laz", "a.LAS", "c.copc.laz", "notes.txt", "o.tif", "dsm/d.tif", "dsm/D.TIFF"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert names(tmp_path) == ["a.LAS", "b.laz", "c.copc.laz"]  # not the surface model
    assert names(tmp_path / "*.laz") == ["b.laz", "c.copc.laz"]
    assert names(tmp_path / "dsm") == ["D.TIFF", "d.tif"]
    cell = f"{tmp_path / 'o.tif'}; {tmp_path / '[ab].*'};{tmp_path / 'b.laz'};"
    assert names(cell) == ["a.LAS", "b.laz", "o.tif"]


def test_lidar_that_is_none_is_refused_by_name(tmp_path):
    (tmp_path / "a.laz").touch()
    (tmp_path / "b.laz").symlink_to("nowhere")
    (tmp_path / "braces").mkdir()
    (tmp_path / "braces/a{city}.laz").touch()
    wrong = (tmp_path / "none" / "*.laz", " ; ", tmp_path, tmp_path / "braces", "é" * 200)
    for lidar in (*wrong, f"{tmp_path / 'a.laz'};none", "a/" * 2500):
        with pytest.raises(InputError, match=r"s\.tsv: scene 'Qichun-1'"):
            names(lidar)
    with pytest.raises(InputError, match=r"s\.tsv: .* does not exist"):
        sheets.require_files(scene_with_lidar("é" * 200), "s.tsv", ["lidar"])


def test_lidar_files_get_names_of_their_own():
    """Names of 255 bytes leave no room for what is added, and Snakemake takes repeats for loops."""
    long = [
        Path("a", "x1" * 120 + ".laz"),
        Path("b", "x1" * 120 + "3.laz"),
        Path("y" * 30 + ".las"),
    ]
    files = [Path("east/1.laz"), Path("west/1.laz"), Path("2.las"), Path("c.copc.laz"), *long]
    names = sheets.store_names(files)
    assert sorted(names.values()) == sorted(files) and {"2", "c"} < set(names)
    assert all(len(name) <= 100 and not re.search(r"(.+)\1{18}$", name) for name in names)
    assert names == sheets.store_names(reversed(files))


# ------------------------------------------------------------------------------------- images

IMAGES = ("image", "city", "file", "acquired", "sun_azimuth", "sun_elevation", "mask")
TWO_CITIES = CITIES + "Wuhan\tWH\t1\t1\t1\n"


def images_of(folder: Path, *rows: str, columns: tuple[str, ...] = IMAGES):
    cities = sheets.read_cities(write(folder / "c.tsv", TWO_CITIES))
    text = "\n".join(["\t".join(columns), *rows]) + "\n"
    return sheets.read_images(write(folder / "i.tsv", text), cities), cities


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (["A\tQuichun\ta.tif"], "did you mean 'Qichun'"),
        (["A\tQichun\ta.tif", "A\tQichun\tb.tif"], "image 'A'"),
        (["A\tQichun\ta.tif", "B\tQichun\t./a.tif"], "line 3: image 'B'"),
        (["A\tQichun\ta.tif\t25.10.2020"], "25.10.2020"),
        (["A\tQichun\ta.tif\t\t150\t"], "line 2"),
        (["A\tQichun\ta.tif\t\t150\t-5"], "line 2"),
        (["A b\tQichun\ta.tif"], "line 2"),
    ],
)
def test_faults_of_images_name_the_row_and_the_remedy(tmp_path, rows, words):
    with pytest.raises(InputError) as caught:
        images_of(tmp_path, *rows)
    assert all(word in str(caught.value) for word in (words, "i.tsv", "Remedy"))


STACK = ("A\tQichun\ta.tif\t\t\t\tclouds.tif", "B\tQichun\tb.tif", "C\tWuhan\tc.tif")


def scene_of(folder: Path, *cells: str) -> sheets.Scene:
    """The scene of two images and a left mask, whose cells are given."""
    images, cities = images_of(folder, *STACK)
    row = ("Qichun-1", "Qichun", *cells[:2], "lidar", "", "", "g.csv", *cells[2:])
    text = scenes_text(row, columns=(*COLUMNS, "left_mask"))
    return sheets.read_scenes(write(folder / "s.tsv", text), cities, images)["Qichun-1"]


@pytest.mark.parametrize(
    ("cells", "files", "masks"),
    [
        (("B", "A"), ("b.tif", "a.tif"), ("", "clouds.tif")),
        (("./a.tif", "x.tif"), ("a.tif", "x.tif"), ("clouds.tif", "")),
        (("x.tif", "y.tif"), ("x.tif", "y.tif"), ("", "")),
        (("A", "B", "mine.tif"), ("a.tif", "b.tif"), ("mine.tif", "")),
    ],
)
def test_scenes_name_images_or_their_files(tmp_path, cells, files, masks):
    scene = scene_of(tmp_path, *cells)
    assert (scene.left_image, scene.right_image) == files
    assert (scene.left_mask, scene.right_mask) == masks


@pytest.mark.parametrize("cells", [("A", "a.tif"), ("A", "C"), ("A", "D")])
def test_scenes_of_images_that_are_no_pair_are_refused(tmp_path, cells):
    with pytest.raises(InputError, match="line 2: scene 'Qichun-1'"):
        scene_of(tmp_path, *cells)
