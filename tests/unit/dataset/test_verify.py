"""Tiles against their checksums."""

from __future__ import annotations

from pathlib import Path

import pytest

from stereotruth.dataset.published_layout import assemble_dataset
from stereotruth.dataset.scene_stores import SceneFiles
from stereotruth.dataset.verify import defects, verify
from stereotruth.errors import InputError

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
    with pytest.raises(InputError, match=r"TN_disparity_3|TN_left_0"):
        assemble_dataset([folder], tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()
