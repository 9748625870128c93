"""Lists of tiles: by the ground of scenes, from servers that are not to be trusted."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import laspy
import numpy as np
import pyproj
import pytest
from typer.testing import CliRunner

from stereotruth.core.errors import InputError
from stereotruth.lidar.catalogue_list import read_list
from stereotruth.lidar.ingest import ingest
from stereotruth.project.add_scene import add_scene
from stereotruth.project.check import check_project
from stereotruth.project.list_tiles import list_of_scenes
from stereotruth.project.main import app
from stereotruth.project.new_project import begin
from stereotruth.project.project import configured, lidar_of, read_rows, read_scenes

from ...synthetic.broken_scenes import write_sheet

SYSTEM = "EPSG:32650"
SIDE = 3000.0


def tiles_of(folder: Path, side: float = SIDE) -> dict[str, laspy.LasData]:
    """The good scene's points in square tiles, LAZ in the folder ``tiles``; by name."""
    (file,) = (folder / "lidar").glob("*.la[sz]")
    whole = laspy.read(file)
    cell = np.floor(np.stack([whole.x, whole.y]) / side).astype(int)
    (folder / "tiles").mkdir(exist_ok=True)
    made = {}
    for k, key in enumerate(np.unique(cell, axis=1).T.tolist()):
        part = laspy.LasData(whole.header)
        part.points = whole.points[(key == cell.T).all(axis=1)]
        made[f"t{k}.laz"] = part
        part.write(folder / "tiles" / f"t{k}.laz")
    return made


def item(name: str, part: laspy.LasData, side: float = SIDE, **properties) -> dict:
    """A STAC item of a tile of the grid."""
    west, south = (np.floor(float(axis[0]) / side) * side for axis in (part.x, part.y))
    change = pyproj.Transformer.from_crs(SYSTEM, 4326, always_xy=True)
    corners = [(0, 0), (side, 0), (side, side), (0, side), (0, 0)]
    ring = [list(change.transform(west + x, south + y)) for x, y in corners]
    return {
        "type": "Feature",
        "geometry": {"type": "Polygon", "coordinates": [ring]},
        "properties": {
            "proj:code": SYSTEM,
            "proj:bbox": [west, south, west + side, south + side],
            "pc:count": len(part.points),
            "start_datetime": "2020-03-01T10:00:00Z",
            "end_datetime": "2020-03-04T10:00:00Z",
        }
        | properties,
        "assets": {"data": {"href": name, "roles": ["data"]}},
    }


def catalogue(folder: Path, items: list[dict], name: str = "tiles/tiles.vpc") -> str:
    (folder / name).write_text(json.dumps({"type": "FeatureCollection", "features": items}))
    return name


def items_of(folder: Path, side: float = SIDE) -> list[dict]:
    return [item(name, part, side) for name, part in tiles_of(folder, side).items()]


def test_the_tiles_of_a_scene_are_listed_and_read(folder):
    items = items_of(folder)
    lines = list_of_scenes(catalogue(folder, items), "lidar/good.tsv", ["Good-1"])
    listed = read_list("lidar/good.tsv")
    assert sorted(tile.file for tile in listed.tiles) == sorted(
        f"tiles/{one['assets']['data']['href']}" for one in items
    )
    assert {(tile.start, tile.end) for tile in listed.tiles} == {("2020-03-01", "2020-03-04")}
    assert listed.crs == SYSTEM
    assert any("name it in the column lidar" in line for line in lines)
    write_sheet(folder, lidar="lidar/good.tsv")
    settings = configured()[0]
    _, scenes = read_scenes(settings)
    files = lidar_of(scenes["Good-1"], settings)
    assert sorted(map(str, files.values())) == sorted(tile.file for tile in listed.tiles)
    found = check_project(names=["Good-1"])
    assert not any(findings.failed for findings in found)
    assert any("no tile of" in f.text for f in found[0]) == bool(listed.hole_m2)


def test_a_tile_far_from_the_images_is_not_listed(folder):
    items = items_of(folder)
    far = json.loads(json.dumps(items[0]))
    far["assets"]["data"]["href"] = "far.laz"  # is not there, and nobody asks
    far["properties"]["proj:bbox"] = [300_000, 3_300_000, 301_000, 3_301_000]
    list_of_scenes(catalogue(folder, [far, *items]), "good.tsv", [])
    assert len(read_list("good.tsv").tiles) == len(items)
    with pytest.raises(InputError, match="none of its 1 tile lies on the ground of the images"):
        list_of_scenes(catalogue(folder, [far]), "far.tsv", [])
    assert not Path("far.tsv").exists()


def test_a_hole_of_the_catalogue_is_named_and_told_by_check(folder):
    items = items_of(folder, 500.0)
    whole = list_of_scenes(catalogue(folder, items), "whole.tsv", [])
    before = read_list("whole.tsv").hole_m2
    middle = items[len(items) // 2]
    rest = [one for one in items if one is not middle]
    lines = list_of_scenes(catalogue(folder, rest), "rest.tsv", [])
    assert abs(read_list("rest.tsv").hole_m2 - before - 500.0**2) < 0.05 * 500**2
    assert any("most of it about" in line for line in lines) and whole
    write_sheet(folder, lidar="rest.tsv")
    doubts = [f.text for f in check_project(names=["Good-1"])[0]]
    assert any("km² that the images see" in text for text in doubts)


def test_missing_and_doubled_tiles_are_named(folder):
    items = items_of(folder)
    twice = json.loads(json.dumps(items[0]))
    lines = list_of_scenes(catalogue(folder, [*items, twice]), "a.tsv", [])
    assert any(line == f"listed twice: tiles/{twice['assets']['data']['href']}" for line in lines)
    assert len(read_list("a.tsv").tiles) == len(items)
    twice["assets"]["data"]["href"] = "copy.laz"
    Path("tiles/copy.laz").write_bytes(Path("tiles/t0.laz").read_bytes())
    lines = list_of_scenes(catalogue(folder, [*items, twice]), "b.tsv", [])
    assert "two tiles cover the same ground: tiles/t0.laz, tiles/copy.laz" in lines
    Path("tiles/t0.laz").unlink()
    with pytest.raises(InputError, match=r"1 of .* is not there: tiles/t0\.laz"):
        list_of_scenes(catalogue(folder, items), "c.tsv", [])
    assert not Path("c.tsv").exists()


@pytest.mark.parametrize(
    "other",
    [
        {"proj:code": "EPSG:32650+5773"},
        {"proj:code": "EPSG:32650+6360"},  # feet
        {"proj:code": None, "proj:projjson": pyproj.CRS(SYSTEM).to_3d().to_json_dict()},
    ],
)
def test_tiles_of_other_heights_are_not_mixed(folder, other):
    items = items_of(folder, 500.0)
    items[1]["properties"] |= other
    with pytest.raises(InputError, match="different surfaces"):
        list_of_scenes(catalogue(folder, items), "a.tsv", [])


def test_what_a_catalogue_says_of_heights_holds_for_rows_that_name_its_list(folder):
    """Files that declare a system without heights, orthometric by the catalogue: no guess."""
    items = items_of(folder)
    for one in items:
        file = Path("tiles", one["assets"]["data"]["href"])
        las = laspy.read(file)
        las.vlrs = [vlr for vlr in las.vlrs if vlr.record_id not in (2112, 34735)]
        las.header.add_crs(pyproj.CRS(SYSTEM))
        las.write(file)
        one["properties"]["proj:code"] = "EPSG:32650+5773"
    lines = list_of_scenes(catalogue(folder, items), "a.tsv", [])
    assert any(line.endswith("say none: EPSG:32650+5773") for line in lines)
    write_sheet(folder, lidar="a.tsv")
    texts = [f.text for found in check_project(names=["Good-1"]) for f in found]
    assert any("heights are orthometric ('EGM96 height')" in text for text in texts)
    settings = configured()[0]
    _, scenes = read_scenes(settings)
    assert scenes["Good-1"].lidar_crs == "EPSG:32650+5773"
    name, file = next(iter(lidar_of(scenes["Good-1"], settings).items()))
    with pytest.raises(InputError, match="heights are orthometric"):
        ingest(file, f"{name}.points", lidar_crs=scenes["Good-1"].lidar_crs)
    write_sheet(folder, lidar="a.tsv", lidar_crs=SYSTEM)  # the row's own word comes first
    assert read_scenes(settings)[1]["Good-1"].lidar_crs == SYSTEM


def test_lists_of_different_systems_are_not_mixed(folder):
    items = items_of(folder)
    list_of_scenes(catalogue(folder, items), "a.tsv", [])
    for one in items:
        one["properties"]["proj:code"] = "EPSG:32650+5773"
    list_of_scenes(catalogue(folder, items), "b.tsv", [])
    write_sheet(folder, lidar="a.tsv;b.tsv")
    with pytest.raises(InputError, match=r"different systems .*EPSG:32650, EPSG:32650\+5773"):
        read_scenes(configured()[0])
    write_sheet(folder, lidar="tiles/tiles.vpc")  # a run looks into no catalogue
    with pytest.raises(InputError, match="stereotruth lidar"):
        read_scenes(configured()[0])


def add_with(folder: Path, catalogue: str, **options: str) -> list[str]:
    """Add the good scene once more, as Good-2."""
    (folder / "named").mkdir(exist_ok=True)
    for view in ("left", "right"):
        (folder / "named" / f"{view}.tif").write_bytes((folder / f"{view}.tif").read_bytes())
    return add_scene([folder / "named"], lidar=catalogue, gcps="gcps.csv", city="Good", **options)


def test_a_scene_is_added_with_a_catalogue(folder):
    name = catalogue(folder, items_of(folder))
    lines = add_with(folder, name)
    _, scenes = read_scenes(configured()[0])
    assert read_list("lidar/Good-2.tsv").catalogue == name
    assert scenes["Good-2"].lidar.count(";") + 1 == len(read_list("lidar/Good-2.tsv").tiles)
    assert any("lie on the" in line for line in lines)


def test_a_column_of_an_index_may_be_named_for_a_scene(folder):
    index = [
        {"type": "Feature", "geometry": one["geometry"],
         "properties": {"name": one["assets"]["data"]["href"],
                        "url": f"tiles/{one['assets']['data']['href']}"}}
        for one in items_of(folder)
    ]  # fmt: skip
    name = catalogue(folder, index, "index.geojson")
    with pytest.raises(InputError):
        add_with(folder, name)
    add_with(folder, name, column="url", lidar_crs=SYSTEM)
    assert all(tile.file.startswith("tiles/") for tile in read_list("lidar/Good-2.tsv").tiles)


def test_a_site_is_added_with_a_catalogue(folder, monkeypatch):
    """By the two commands that are said last: the rows of the pairs, then the tiles of these."""
    (folder / "named").mkdir()
    for name, view in (("a", "left"), ("b", "right"), ("c", "left")):
        (folder / f"named/{name}.tif").write_bytes((folder / f"{view}.tif").read_bytes())
    begin(folder / "site")
    monkeypatch.chdir(folder / "site")
    name = f"../{catalogue(folder, items_of(folder))}"
    lines = add_scene([Path("../named")], lidar=name, city="Site")
    for command in lines[-1].partition("Next: ")[2].split(" && "):
        assert CliRunner().invoke(app, shlex.split(command)[1:]).exit_code == 0
    ((_, row),) = read_rows(configured()[0])[1].items()
    assert row.lidar == "lidar/Site.tsv" and len(read_list(row.lidar).tiles)


class Site:
    """What a server answers: by path, bytes, or (status, headers, bytes)."""

    def __init__(self) -> None:
        self.answers: dict[str, object] = {}
        self.asked: list[str] = []
        self.url = ""


@contextmanager
def serving(name: str = "127.0.0.1") -> Iterator[Site]:
    site = Site()

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self):
            site.asked.append(f"{self.command} {self.path}")
            answer = site.answers.get(self.path, (404, {}, b""))
            status, headers, body = answer if isinstance(answer, tuple) else (200, {}, answer)
            span = self.headers.get("Range")
            tag = f'"{hashlib.sha256(body).hexdigest()[:8]}"'
            if span and status == 200:
                first, last = map(int, span.removeprefix("bytes=").split("-"))
                last = min(last, len(body) - 1)
                headers = {"Content-Range": f"bytes {first}-{last}/{len(body)}"} | headers
                status, body = 206, body[first : last + 1]
            self.send_response(status)
            for key, value in ({"Content-Length": str(len(body)), "ETag": tag} | headers).items():
                self.send_header(key, value)
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(body)

        do_HEAD = do_GET

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
    site.url = f"http://{name}:{server.server_port}"
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()


def with_catalogue(site: Site, folder: Path, change=lambda item: None) -> str:
    """Put a catalogue and its tiles on a server; its URL."""
    items = items_of(folder)
    for one in items:
        name = one["assets"]["data"]["href"]
        site.answers[f"/lidar/{name}"] = (folder / "tiles" / name).read_bytes()
        change(one)
    content = {"type": "FeatureCollection", "features": items}
    site.answers["/lidar/tiles.json"] = json.dumps(content).encode()
    return f"{site.url}/lidar/tiles.json"


def listed(url, hosts=()):
    return list_of_scenes(url, "a.tsv", [], hosts=hosts)


def test_a_catalogue_of_a_server_names_no_other_host(folder):
    with serving() as site, serving("localhost") as other:
        with_catalogue(other, folder)

        def elsewhere(one):
            data = one["assets"]["data"]
            data["href"] = f"{other.url}/lidar/{data['href']}"

        url = with_catalogue(site, folder, elsewhere)
        with pytest.raises(InputError, match="another host than its own, localhost"):
            listed(url)
        assert other.asked == [] and not Path("a.tsv").exists()
        listed(url, ["localhost"])
        assert all(tile.file.startswith(other.url) for tile in read_list("a.tsv").tiles)


def test_no_file_and_no_line_has_a_signature(folder, caplog, capsys):
    """Of a catalogue's URL, or of what servers redirect to: lists, stand-ins, stores, messages."""
    caplog.set_level("DEBUG")
    with serving() as site, serving("localhost") as other:
        url = with_catalogue(site, folder)
        signed = f"{url}?X-Amz-Signature=verysecret"
        site.answers["/lidar/tiles.json?X-Amz-Signature=verysecret"] = site.answers.pop(
            "/lidar/tiles.json"
        )
        for path in [path for path in site.answers if path.endswith(".laz")]:
            to = {"Location": f"{other.url}{path}?signature=verysecret"}
            other.answers[f"{path}?signature=verysecret"] = site.answers[path]
            site.answers[path] = (307, to, b"")
        lines = list_of_scenes(signed, "a.tsv", [], hosts=["localhost"])
        write_sheet(folder, lidar="a.tsv")
        found = check_project(names=["Good-1"])
        settings = configured()[0]
        _, scenes = read_scenes(settings)
        for name, file in lidar_of(scenes["Good-1"], settings).items():
            ingest(file, Path("results", f"{name}.points"), provenance={"lidar": str(file)})
        for path in other.answers:
            other.answers[path] = (403, {}, b"")
        for copy in Path("results/copies").glob("*/*"):
            copy.unlink()
        with pytest.raises(InputError, match="no permission") as refused:
            ingest(file, Path("results", "refused.points"))
    assert any("verysecret" in asked for asked in other.asked + site.asked)
    texts = [*lines, *(f.text + f.remedy for one in found for f in one), str(refused.value)]
    texts += [caplog.text, *capsys.readouterr()]
    written = [file for file in folder.rglob("*") if file.is_file()]
    assert any(file.name == "store.json" for file in written)
    assert not any("verysecret" in text for text in texts)
    assert not any(b"verysecret" in file.read_bytes() for file in written)
