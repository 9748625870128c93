"""LAS and LAZ files that are cut short, damaged or say too much: refused by name, or remarked."""

from __future__ import annotations

import resource
import struct
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from stereotruth.lidar.ingest import ingest
from stereotruth.lidar.las_files import check_layout

from ...synthetic.las import refused, write_las

Damage = Callable[[bytearray], bytes]


def at(kind: str, place: int, value: float) -> Damage:
    """Set a field (struct format) of the header anew."""

    def damage(data: bytearray) -> bytes:
        struct.pack_into("<" + kind, data, place, value)
        return data

    return damage


def in_points(kind: str, place: int, value: float) -> Damage:
    """Set a field behind the first point's place, or of the chunk table (below 0) anew."""

    def damage(data: bytearray) -> bytes:
        (first,) = struct.unpack_from("<I", data, 96)
        (table,) = struct.unpack_from("<q", data, first)
        struct.pack_into("<" + kind, data, first + place if place >= 0 else table - place, value)
        return data

    return damage


def noise(data: bytearray) -> bytes:
    middle = len(data) // 4
    data[middle : middle + 4000] = np.random.default_rng(0).bytes(4000)
    return data


def three_more(data: bytearray) -> bytes:
    (first,) = struct.unpack_from("<I", data, 96)
    return data[: first + 5000] + b"xyz" + data[first + 5000 :]


OLD = {"pdrf": 1, "version": "1.2"}
# What: the file's name, how it is written, the damage, words of the refusal.
DAMAGED: dict[str, tuple[str, dict, Damage, str]] = {
    "empty": ("a.las", {}, lambda _: b"", "no readable LAS"),
    "no LAS": ("a.las", {}, lambda _: b"not a LAS file" * 100, "no readable LAS"),
    "LAS cut": ("a.las", OLD, lambda d: d[: len(d) - 283], "announces 1200 points, the file holds"),
    "LAZ cut": ("a.laz", {}, lambda d: d[: len(d) * 7 // 10], "1200 points, 0 can be read"),
    "never completed": ("a.las", OLD, at("I", 107, 0), "never completed"),
    "noise in LAZ": ("a.laz", {"n": 100_000}, noise, "damaged|no place on Earth"),
    "bytes put in": ("a.laz", {"n": 120_000}, three_more, "truncated or damaged"),
    "fewer in LAZ 1.2": ("a.laz", OLD, at("I", 107, 900), "announces 900 points|points reach"),
    "fewer in LAZ 1.4": ("a.laz", {}, at("Q", 247, 1199), "announces 1199 points|were read"),
    "more in LAZ": ("a.laz", {}, at("Q", 247, 1201), "announces 1201 points|were read"),
    "other chunks": ("a.laz", OLD | {"n": 120_000}, at("I", 107, 70_000), "chunks hold 150000"),
    "more in the last chunk": ("a.laz", OLD | {"n": 120_000}, at("I", 107, 150_000), "150000 poi"),
    "chunk table elsewhere": ("a.laz", {}, in_points("q", 0, 400), "chunk table"),
    "layer of 4 GB": ("a.laz", {}, in_points("I", 46, 0xFFFFFFF0), "layers of chunk 1 of 1"),
    "3 records": ("a.las", {}, at("I", 100, 3), "variable length records"),
    "records for hours": ("a.laz", {}, at("I", 100, 0xFFFFFFFF), "variable length records"),
    "extended records": ("a.las", {}, at("I", 243, 2), "extended variable length records"),
    "LAS 1.9": ("a.las", {}, at("B", 25, 9), "LAS 1.9 is not known"),
    "long header": ("a.las", {}, at("H", 94, 0xFFFF), "a header of 65535 bytes"),
    "format 40": ("a.las", {}, at("B", 104, 40), "points of format 40"),
    "short records": ("a.las", {}, at("H", 105, 3), "do not go into 3 bytes"),
    "no scale": ("a.las", {}, at("d", 131, 0.0), "scales and offsets"),
    "no offset": ("a.las", {}, at("d", 155, float("nan")), "scales and offsets"),
    "two counts": ("a.las", {"pdrf": 1}, at("I", 107, 77), "two counts of points"),
    "no LASzip record": (
        "a.laz", {}, lambda d: d.replace(b"laszip encoded", b"laszip unknown"), "0 LASzip records",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", DAMAGED)
def test_a_damaged_file_is_refused(tmp_path, fault) -> None:
    name, how, damage, words = DAMAGED[fault]
    file = tmp_path / name
    write_las(file, **{"n": 1200} | how)
    file.write_bytes(damage(bytearray(file.read_bytes())))
    refused(file, words)


def test_missing_and_empty_files(tmp_path) -> None:
    refused(tmp_path / "none.laz", "no such LiDAR file")
    write_las(tmp_path / "empty.laz", 0)
    refused(tmp_path / "empty.laz", "announces 0 points")


@pytest.mark.parametrize(
    ("pdrf", "version"), [(1, "1.2"), (4, "1.3"), (8, "1.4"), (9, "1.4"), (6, "1.5")]
)
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_good_files_pass(tmp_path, pdrf, version, suffix) -> None:
    file = tmp_path / f"a.{suffix}"
    write_las(file, 1200, pdrf=pdrf, version=version)
    layout = check_layout(file)
    assert (layout.points, layout.format) == (1200, pdrf)
    assert layout.compressed == (suffix == "laz")


def test_a_chunk_table_takes_no_memory_by_what_it_says(tmp_path) -> None:
    """4 bytes of it made lazrs take 68 GB and end the process."""
    file = tmp_path / "a.laz"
    write_las(file, 120_000, **OLD)
    file.write_bytes(in_points("I", -4, 0xFFFFFFFF)(bytearray(file.read_bytes())))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(file, "chunk table")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # KiB


def test_stale_counts_are_refused_by_the_returns_or_remarked(tmp_path) -> None:
    file = tmp_path / "a.las"
    write_las(file, 100, return_number=np.repeat([1, 2], 50), **OLD)
    good = bytearray(file.read_bytes())
    struct.pack_into("<I", good, 107, 80)
    file.write_bytes(good)
    refused(file, "announces 80 points, its counts by return add up to 100")
    struct.pack_into("<5I", good, 111, 0, 0, 0, 0, 0)
    file.write_bytes(good)
    result = ingest(file, tmp_path / "a.points")
    assert result["points"]["kept"] == 80 and "100 would fit" in result["notes"][0]
    struct.pack_into("<3I", good, 107, 100, 49, 51)
    file.write_bytes(good)
    refused(file, "counts 49, 51 points by return, 50, 50 were read")
    struct.pack_into("<2I", good, 111, 100, 0)  # software that knows no returns
    file.write_bytes(good)
    assert "100 points by return" in ingest(file, tmp_path / "a.points")["notes"][0]


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
    file.write_bytes(at("d", 179, east - 20 * unit)(data))
    assert "points reach from" in ingest(file, tmp_path / "a.points")["notes"][-1]
    file.write_bytes(at("d", 179, east - 200 * unit)(data))
    refused(file, "damaged: points reach from")


def test_a_panic_of_the_decoder_is_a_refusal(tmp_path, monkeypatch) -> None:
    """What lazrs raises then is no Exception."""
    panic = type("PanicException", (BaseException,), {})

    def read_points(self, n):
        raise panic("index out of bounds")

    write_las(tmp_path / "a.laz", 300)
    monkeypatch.setattr(laspy.LasReader, "read_points", read_points)
    refused(tmp_path / "a.laz", "decoding failed after 0 .index out of bounds")


def test_extended_records_are_read_if_they_fit(tmp_path) -> None:
    file: Path = tmp_path / "a.las"
    write_las(file, 300)
    las = laspy.read(file)
    las.evlrs = laspy.vlrs.vlrlist.VLRList([laspy.VLR("user", 7, "", b"x" * 100)])
    las.write(file)
    check_layout(file)
    data = bytearray(file.read_bytes())
    (start,) = struct.unpack_from("<Q", data, 235)
    file.write_bytes(at("Q", start + 20, 1 << 40)(data))
    refused(file, "extended variable length records")
