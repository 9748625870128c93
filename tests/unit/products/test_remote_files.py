"""Names of files that lie elsewhere; reading them: tests/workflow/test_object_storage.py."""

from __future__ import annotations

import json

import pytest

from stereotruth.errors import InputError
from stereotruth.products import remote_files
from stereotruth.products.remote_files import (
    FOLDER,
    gdal_name,
    open_file,
    place_of,
    size_of,
    url_of,
)


@pytest.mark.parametrize(
    "url",
    ["s3://bucket/a/left.tif", "https://host:8443/a%20b/left.tif", "http://127.0.0.1:90/x.laz"],
)
def test_a_place_stands_for_its_url(url, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert place_of(url).parts[:2] == FOLDER.parts
    assert url_of(place_of(url)) == url
    assert url_of(place_of(url).absolute()) == url


@pytest.mark.parametrize(
    "url",
    [
        "ftp://host/left.tif",
        "file:///etc/passwd",
        "s3://bucket",
        "https://host/left.tif?signature=1",
        "https://name:word@host/left.tif",
        "https://host/../../left.tif",
    ],
)
def test_other_urls_are_refused(url):
    with pytest.raises(InputError, match="URL"):
        place_of(url)


def test_what_lies_elsewhere_in_the_working_directory_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "left.tif").write_text('{"size": 7, "content": "x"}\n')
    assert url_of("left.tif") is None
    assert gdal_name("left.tif") == ("left.tif", {})
    assert size_of("left.tif") == 28
    with open_file("left.tif") as stream:
        assert stream.read(7) == b'{"size"'
    copied = place_of("s3://bucket/left_RPC.TXT")  # small files are fetched
    assert url_of(copied) is None


def test_gdal_may_read_the_one_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9000")
    name, options = gdal_name(place_of("s3://bucket/a/left.tif"))
    assert name == "/vsis3/bucket/a/left.tif"
    assert options["CPL_VSIL_CURL_ALLOWED_FILENAME"] == name
    assert (options["AWS_S3_ENDPOINT"], options["AWS_HTTPS"]) == ("127.0.0.1:9000", "NO")
    name, options = gdal_name(place_of("https://host/left.tif"))
    assert name == "/vsicurl/https://host/left.tif"
    assert not [option for option in options if option.startswith("AWS")]


def test_a_server_that_gives_no_parts_is_refused(monkeypatch):
    class Server:
        def __init__(self, **info):
            self.given = info

        def _strip_protocol(self, url):
            return url

        def info(self, name):
            return self.given

    url = "https://host/left.tif"
    for info in ({"size": None}, {"size": 5, "partial": False}):
        monkeypatch.setattr(remote_files, "_file_system", lambda scheme, i=info: Server(**i))
        with pytest.raises(InputError, match="as a whole only"):
            remote_files.stand_in(url)


def test_a_stand_in_keeps_its_time_while_the_file_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    state = json.dumps({"size": 5, "content": "tag"}) + "\n"
    monkeypatch.setattr(remote_files, "_look", lambda url: state)
    place = remote_files.stand_in("https://host/left.tif")
    before = place.stat().st_mtime_ns
    assert remote_files.stand_in("https://host/left.tif").stat().st_mtime_ns == before
    assert size_of(place) == 5
    remote_files.refuse_changed(place)
    monkeypatch.setattr(remote_files, "_look", lambda url: None)
    with pytest.raises(InputError, match="changed on its server"):
        remote_files.refuse_changed(place)
