from __future__ import annotations

import pytest

from stereotruth.sensor.image_files import files_beside


@pytest.mark.parametrize(
    "name",
    [
        *("Left.TIF.msk", "left.tif.MSK", "left.tif.aux.xml", "LEFT.AUX.XML", "left.tif.ovr"),
        *("left_Rpc.Txt", "left_RPC.TXT", "left.RPB", "left.rpb", "left.IMD", "left.Imd"),
        *("left.tfw", "LEFT.TIFW", "left.wld", "RPC_PHR1A_P_001.XML", "rpc_spot.xml"),
    ],
)
def test_files_that_readers_take_into_account_are_found_in_any_case(tmp_path, name):
    (tmp_path / "Left.tif").touch()
    (tmp_path / name).touch()
    for other in ("right.tif", "right_RPC.TXT", "left.txt", "left2.rpb", "left.tif.bak", "a.xml"):
        (tmp_path / other).touch()
    assert files_beside(tmp_path / "Left.tif") == [tmp_path / name]


def test_an_image_in_a_folder_that_is_not_there_has_none(tmp_path):
    assert files_beside(tmp_path / "nowhere/left.tif") == []
