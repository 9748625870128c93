"""Tiles against their checksums."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.tiles.layouts import assemble_dataset
from stereotruth.tiles.manifest import FOOTPRINTS, STYLE
from stereotruth.tiles.scene_stores import SceneFiles
from stereotruth.tiles.verify import defects, verify

from ...synthetic.tiled_scene import run

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_checksums_find_an_edited_file(scene: SceneFiles, tmp_path: Path) -> None:
    folder = tmp_path / "Town"
    run([scene], folder)
    assert defects(folder) == []
    assert verify([folder])[str(folder)] > 60
    victim = folder / "disp" / "TN_disparity_3.tiff"
    data = bytearray(victim.read_bytes())
    data[-1] ^= 1
    victim.write_bytes(data)
    (folder / "left" / "TN_left_0.tiff").unlink()
    (folder / "left" / "stray.txt").write_text("x")
    assert sorted(defects(folder)) == [
        "disp/TN_disparity_3.tiff: changed",
        "left/TN_left_0.tiff: missing",
        "left/stray.txt: not in the manifest",
    ]
    with pytest.raises(InputError, match="TN_disparity_3"):
        verify([folder])
    with pytest.raises(InputError):
        assemble_dataset([folder], tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_files_of_other_programs_are_left_alone(
    exported: tuple[Path, dict], tmp_path: Path
) -> None:
    folder = tmp_path / "Town"
    shutil.copytree(exported[0], folder)
    foreign = [
        "disp/TN_disparity_0.tiff.aux.xml",
        "disp/TN_disparity_0.tiff.ovr",
        "left/.DS_Store",
        "left/Thumbs.db",
        "map.qgz",
    ]
    for name in (*foreign, "right/.hidden"):
        (folder / name).write_text("x")
    assert verify([folder])[str(folder)] > 60
    assert all((folder / name).is_file() for name in foreign)
    (folder / "left/TN_left_0.tiff").unlink()
    (folder / "left/TN_left_0.tiff.aux.xml").write_text("x")  # is no excuse for a missing tile
    assert defects(folder) == ["left/TN_left_0.tiff: missing"]


@pytest.mark.parametrize("change", [b"", b"[3]", b"\xff{", None])
def test_export_json_keeps_its_own_digest(
    exported: tuple[Path, dict], tmp_path: Path, change: bytes | None
) -> None:
    folder = tmp_path / "Town"
    shutil.copytree(exported[0], folder)
    assert defects(folder) == []
    file = folder / "export.json"
    file.write_bytes(
        file.read_bytes().replace(b'"size_px": ', b'"size_px": 1') if change is None else change
    )
    assert defects(folder)[0] == "export.json: changed"


def test_footprints_keep_their_digest_and_their_style_is_the_users(exported, tmp_path) -> None:
    folder = tmp_path / "Town"
    shutil.copytree(exported[0], folder)
    (folder / STYLE).write_text("<qgis/>")  # whoever likes other colours
    assert defects(folder) == []
    (folder / FOOTPRINTS).write_text("{}")
    assert defects(folder) == [f"{FOOTPRINTS}: changed"]
    (folder / FOOTPRINTS).unlink()
    assert defects(folder) == [f"{FOOTPRINTS}: missing"]
