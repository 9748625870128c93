"""Counts and places of LAS and LAZ headers against the file, before anything is decoded."""

from __future__ import annotations

import resource
import struct
from pathlib import Path

import laspy
import pytest

from stereotruth.core.errors import InputError
from stereotruth.lidar.las_files import check_layout

from ...synthetic.las import refused, write_las

POINTS, TABLE = 96, 0  # of the header: first point; of the points: place of the chunk table


def changed(file: Path, *places: tuple[str, int, float]) -> Path:
    """Fields (struct format, byte, value) of a file set anew."""
    data = bytearray(file.read_bytes())
    for kind, at, value in places:
        struct.pack_into("<" + kind, data, at, value)
    file.write_bytes(data)
    return file


def first_point(file: Path) -> int:
    return struct.unpack_from("<I", file.read_bytes(), POINTS)[0]


def chunk_table(file: Path) -> int:
    return struct.unpack_from("<q", file.read_bytes(), first_point(file))[0]


@pytest.mark.parametrize(("pdrf", "version"), [(1, "1.2"), (3, "1.2"), (6, "1.4"), (8, "1.4")])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_good_files_pass(tmp_path, pdrf, version, suffix) -> None:
    file = tmp_path / f"a.{suffix}"
    write_las(file, 1200, pdrf=pdrf, version=version)
    layout = check_layout(file)
    assert (layout.points, layout.format) == (1200, pdrf)
    assert layout.compressed == (suffix == "laz")


@pytest.mark.parametrize("count", [1199, 1201, 900])
@pytest.mark.parametrize(("pdrf", "version"), [(1, "1.2"), (6, "1.4")])
def test_laz_with_a_wrong_count_of_points(tmp_path, pdrf, version, count) -> None:
    """Too low loses points, too high invents them; layers and counts by return tell."""
    file = tmp_path / "a.laz"
    write_las(file, 1200, pdrf=pdrf, version=version)
    changed(file, ("I", 107, count) if version == "1.2" else ("Q", 247, count))
    refused(file, f"announces {count} points|were read|damaged: points reach")


@pytest.mark.parametrize("number", [1, 0xFFFF, 0xFFFFFFFF])
def test_a_chunk_table_takes_no_memory_by_what_it_says(tmp_path, number) -> None:
    """4 bytes of it made lazrs take 68 GB and end the process."""
    file = tmp_path / "a.laz"
    write_las(file, 120_000, pdrf=1, version="1.2")
    changed(file, ("I", chunk_table(file) + 4, number))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(file, "chunk table|its chunks hold")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # KiB


@pytest.mark.parametrize("place", [0, -2, 1 << 40, 400])
def test_a_chunk_table_elsewhere(tmp_path, place) -> None:
    file = tmp_path / "a.laz"
    write_las(file, 1200)
    changed(file, ("q", first_point(file), place))
    refused(file, "chunk table")


def test_bytes_put_into_or_taken_from_the_points(tmp_path) -> None:
    file = tmp_path / "a.laz"
    write_las(file, 120_000)
    data, at = file.read_bytes(), first_point(file) + 5000
    for damaged in (data[:at] + b"xyz" + data[at:], data[:at] + data[at + 3 :]):
        file.write_bytes(damaged)
        refused(file, "truncated or damaged")


def test_layers_that_do_not_fill_their_chunk(tmp_path) -> None:
    """Each announces its size, which lazrs takes in memory."""
    file = tmp_path / "a.laz"
    write_las(file, 1200)
    with laspy.open(file) as reader:
        size = reader.header.point_format.size
    changed(file, ("I", first_point(file) + 8 + size + 8, 0xFFFFFFF0))
    refused(file, "layers of chunk 1 of 1 do not fill it")


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("number", [3, 1000, 0xFFFFFFFF])
def test_more_records_than_fit(tmp_path, suffix, number) -> None:
    """A garbage number of them made laspy read for hours."""
    file = tmp_path / f"a.{suffix}"
    write_las(file, 300)
    refused(changed(file, ("I", 100, number)), "variable length records")


@pytest.mark.parametrize(
    "field", [("I", 243, 0xFFFFFFFF), ("Q", 235, 1 << 62), ("Q", 235, 0), ("I", 243, 2)]
)
def test_extended_records_that_do_not_fit(tmp_path, field) -> None:
    file = tmp_path / "a.las"
    write_las(file, 300)
    las = laspy.read(file)
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("user", 7, "", b"x" * 100)])
    las.write(file)
    check_layout(file)
    refused(changed(file, field), "extended variable length records")
    las.write(file)
    start = struct.unpack_from("<Q", file.read_bytes(), 235)[0]
    refused(changed(file, ("Q", start + 20, 1 << 40)), "extended variable length records")


@pytest.mark.parametrize(
    ("field", "match"),
    [
        (("B", 25, 9), "LAS 1.9 is not known"),
        (("H", 94, 0xFFFF), "a header of 65535 bytes"),
        (("I", POINTS, 0xFFFFFFFF), "points from byte 4294967295"),
        (("B", 104, 40), "points of format 40"),
        (("H", 105, 3), "do not go into 3 bytes"),
        (("d", 131, 0.0), "scales and offsets"),
        (("d", 155, float("nan")), "scales and offsets"),
        (("I", 107, 77), "two counts of points are 77 and 300"),
    ],
)
def test_fields_that_cannot_be(tmp_path, field, match) -> None:
    file = tmp_path / "a.las"
    write_las(file, 300, pdrf=1, version="1.4")
    refused(changed(file, field), match)


def test_a_compressed_file_without_its_record(tmp_path) -> None:
    file = tmp_path / "a.laz"
    write_las(file, 300)
    file.write_bytes(file.read_bytes().replace(b"laszip encoded", b"laszip unknown"))
    with pytest.raises(InputError, match="0 LASzip records"):
        check_layout(file)
