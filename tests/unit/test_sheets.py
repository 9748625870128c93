from __future__ import annotations

from pathlib import Path

import pytest

from stereotruth import sheets
from stereotruth.errors import InputError

ROOT = Path(__file__).parents[2]
SCHEMAS = ROOT / "workflow" / "schemas"
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
    return sheets.read_cities(write(tmp_path / "cities.tsv", CITIES), SCHEMAS)


def test_the_sheets_of_the_project_are_valid():
    cities = sheets.read_cities(ROOT / "config" / "cities.tsv", SCHEMAS)
    scenes = sheets.read_scenes(ROOT / "config" / "scenes.tsv", cities, SCHEMAS)
    assert {scene.city for scene in scenes.values()} == set(cities)
    # table 3 of the paper
    assert sum(c.training + c.validation + c.testing for c in cities.values()) == 1757


def test_a_sheet_is_read_with_crlf_bom_comments_and_short_rows(tmp_path, cities):
    text = "\ufeff" + scenes_text(ROW) + "# a remark\n\n"
    file = write(tmp_path / "s.tsv", text.replace("\n", "\r\n"))
    scene = sheets.read_scenes(file, cities, SCHEMAS)["Qichun-1"]
    assert (scene.left_image, scene.lidar_crs, scene.gcps) == ("l.tif", "", "g.csv")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (scenes_text(with_cell("city", "Quichun")), ["'Quichun'", "did you mean 'Qichun'"]),
        (scenes_text(with_cell("scene", "Qichun_1")), ["line 2", "Qichun_1", "unique id"]),
        (scenes_text(ROW, ROW), ["'Qichun-1'", "more than one row"]),
        (scenes_text(with_cell("lidar", "")), ["line 2", "lidar"]),
        (scenes_text(with_cell("right_image", "l.tif")), ["one image twice"]),
        (scenes_text(ROW, columns=(*COLUMNS[:-1], "gcp")), ["'gcps' is missing", "'gcp' is unkn"]),
        (scenes_text(ROW).replace("\t", ","), ["separated by tabs"]),
        ("", ["empty sheet"]),
    ],
)
def test_a_wrong_scenes_sheet_is_refused_by_name(tmp_path, cities, text, words):
    file = write(tmp_path / "scenes.tsv", text)
    with pytest.raises(InputError) as refusal:
        sheets.read_scenes(file, cities, SCHEMAS)
    for word in ["scenes.tsv", "Remedy", *words]:
        assert word in str(refusal.value)


def test_a_count_that_is_no_number_is_refused(tmp_path):
    file = write(tmp_path / "cities.tsv", CITIES.replace("600", "many"))
    with pytest.raises(InputError, match="training is 'many'"):
        sheets.read_cities(file, SCHEMAS)


def test_an_unknown_key_is_refused_with_a_guess():
    config = {"tiles": {"sise": 512}}
    with pytest.raises(InputError) as refusal:
        sheets.check({**default_config(), **config}, "config", SCHEMAS, "config")
    assert "unknown key 'sise' under 'tiles'" in str(refusal.value)
    assert "did you mean 'size'?" in str(refusal.value)


def test_a_value_out_of_range_is_refused_with_its_meaning():
    config = default_config()
    config["occlusion"]["window"] = 8
    with pytest.raises(InputError, match=r"occlusion.window.*odd"):
        sheets.check(config, "config", SCHEMAS, "config")


def default_config() -> dict:
    import yaml

    return yaml.safe_load((ROOT / "config" / "config.yaml").read_text())


def test_the_default_configuration_is_valid_and_documented():
    config = default_config()
    sheets.check(config, "config", SCHEMAS, "config")
    guide = (ROOT / "config" / "README.md").read_text()
    for key, value in config.items():
        for name in [f"{key}.{sub}" for sub in value] if isinstance(value, dict) else [key]:
            assert f"`{name}`" in guide, name


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


def test_no_lidar_is_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"Qichun-1.*no LiDAR file"):
        sheets.find_lidar(scene_with_lidar(tmp_path / "none" / "*.laz"), "s.tsv")


def test_lidar_files_of_one_stem_get_names_of_their_own():
    files = [Path("east/1.laz"), Path("west/1.laz"), Path("2.las")]
    names = sheets.store_names(files)
    assert sorted(names.values()) == sorted(files)
    assert "2" in names and "1" not in names
    assert names == sheets.store_names(reversed(files))
