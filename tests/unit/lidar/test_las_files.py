"""LAS files that are cut short, damaged or say too much."""

from __future__ import annotations

import struct

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.lidar.ingest import ingest

from ...synthetic.las import refused, write_las


@pytest.mark.parametrize("version", ["1.2", "1.4"])
def test_truncated_las_names_both_counts(tmp_path, version) -> None:
    file = tmp_path / "a.las"
    write_las(file, 1000, pdrf=1 if version == "1.2" else 6, version=version)
    with laspy.open(file) as reader:
        size = reader.header.point_format.size
    data = file.read_bytes()
    file.write_bytes(data[: len(data) - 10 * size - 3])
    refused(file, "announces 1000 points, the file holds 989")


@pytest.mark.parametrize("share", [0.2, 0.7, 0.999])
def test_truncated_laz_names_both_counts(tmp_path, share) -> None:
    file = tmp_path / "a.laz"
    write_las(file, 60_000)
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    refused(file, "announces 60000 points, 0 can be read")


@pytest.mark.parametrize("count", [70_000, 150_000])
def test_laz_whose_header_and_chunk_table_disagree(tmp_path, count) -> None:
    file = tmp_path / "a.laz"
    write_las(file, 120_000, pdrf=1, version="1.2")  # chunks of 50 000
    data = bytearray(file.read_bytes())
    struct.pack_into("<I", data, 107, count)
    file.write_bytes(data)
    if count == 150_000:  # within the last chunk, as far as the table goes: decoding finds out
        refused(file, f"announces {count} points")
    else:
        refused(file, f"announces {count} points, its chunks hold 150000")


def test_damaged_laz(tmp_path) -> None:
    file = tmp_path / "a.laz"
    write_las(file, 100_000)
    data = bytearray(file.read_bytes())
    middle = len(data) // 4
    data[middle : middle + 4000] = np.random.default_rng(0).bytes(4000)
    file.write_bytes(data)
    refused(file, "damaged|no place on Earth")


@pytest.mark.parametrize("content", [b"", b"LASF", b"not a LAS file" * 100])
def test_no_las_file(tmp_path, content) -> None:
    (tmp_path / "a.las").write_bytes(content)
    refused(tmp_path / "a.las", "no readable LAS")


def test_missing_and_empty_files(tmp_path) -> None:
    refused(tmp_path / "none.laz", "no such LiDAR file")
    write_las(tmp_path / "empty.laz", 0)
    refused(tmp_path / "empty.laz", "announces 0 points")
    write_las(tmp_path / "unfinished.las", 50, pdrf=1, version="1.2")
    data = bytearray((tmp_path / "unfinished.las").read_bytes())
    struct.pack_into("<I", data, 107, 0)
    (tmp_path / "unfinished.las").write_bytes(data)
    refused(tmp_path / "unfinished.las", "never completed")


def test_stale_header_is_remarked(tmp_path) -> None:
    """Where no counts by return contradict it."""
    file = tmp_path / "a.las"
    write_las(file, 100, pdrf=1, version="1.2")
    assert not ingest(file, tmp_path / "a.points")["notes"]
    data = bytearray(file.read_bytes())
    struct.pack_into("<I", data, 107, 80)
    file.write_bytes(data)
    refused(file, "announces 80 points, its counts by return add up to 100")
    struct.pack_into("<5I", data, 111, 0, 0, 0, 0, 0)
    file.write_bytes(data)
    result = ingest(file, tmp_path / "a.points")
    assert result["points"]["kept"] == 80
    assert "announces 80 points, which are read; 100 would fit" in result["notes"][0]


def test_counts_by_return_are_held_against_the_points(tmp_path) -> None:
    file = tmp_path / "a.las"
    write_las(file, 100, pdrf=1, version="1.2", return_number=np.repeat([1, 2], 50))
    data = bytearray(file.read_bytes())
    struct.pack_into("<2I", data, 111, 49, 51)
    file.write_bytes(data)
    refused(file, "counts 49, 51 points by return, 50, 50 were read")
    struct.pack_into("<2I", data, 111, 100, 0)  # software that knows no returns
    file.write_bytes(data)
    assert "counts 100 points by return" in ingest(file, tmp_path / "a.points")["notes"][0]


@pytest.mark.parametrize(
    ("system", "scale", "unit"),
    [(pyproj.CRS("EPSG:4979"), 1e-7, 1 / 111_320), (pyproj.CRS("EPSG:32650"), 0.001, 1.0)],
)
def test_points_outside_of_the_stated_bounds(tmp_path, system, scale, unit) -> None:
    """A remark for a little, a refusal for more than a tenth of the side; in metres, or degrees."""
    file = tmp_path / "a.las"
    base = np.array([114.3, 30.6, 50]) if system.is_geographic else np.array([5e5, 33e5, 50])
    xyz = base + np.random.default_rng(0).uniform(0, 1, (500, 3)) * [700 * unit, 700 * unit, 9]
    write_las(file, xyz=xyz, system=system, scale=scale)
    data = bytearray(file.read_bytes())
    east = struct.unpack_from("<d", data, 179)[0]
    struct.pack_into("<d", data, 179, east - 20 * unit)
    file.write_bytes(data)
    assert "points reach from" in ingest(file, tmp_path / "a.points")["notes"][-1]
    struct.pack_into("<d", data, 179, east - 200 * unit)
    file.write_bytes(data)
    refused(file, "damaged: points reach from")


def test_a_panic_of_the_decoder_is_a_refusal(tmp_path, monkeypatch) -> None:
    """What lazrs raises then is no Exception."""
    panic = type("PanicException", (BaseException,), {})

    def read_points(self, n):
        raise panic("index out of bounds")

    write_las(tmp_path / "a.laz", 300)
    monkeypatch.setattr(laspy.LasReader, "read_points", read_points)
    refused(tmp_path / "a.laz", "decoding failed after 0 .index out of bounds")
