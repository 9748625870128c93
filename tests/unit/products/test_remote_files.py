"""Names of files that lie elsewhere; reading them: tests/workflow/test_object_storage.py."""

from __future__ import annotations

import json
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import pytest

from stereotruth.errors import InputError
from stereotruth.products import remote_files, web_requests
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
        "s3://../left.tif",
        "https://name:wo/rd@host/left.tif",
        "https://host//left.tif",
        "https://host/./left.tif",
        "https://host/a\nb/left.tif",
        "https://[host/left.tif",
        f"s3://bucket/{'x' * 201}.tif",
    ],
)
def test_other_urls_are_refused(url):
    with pytest.raises(InputError, match="URL") as refused:
        place_of(url)
    assert "signature" not in str(refused.value) and "word@" not in str(refused.value)


@contextmanager
def answering(status, content=b""):
    """A web server that answers so whatever it is asked for; its URL."""

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(status)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(content)

        do_HEAD = do_GET

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@pytest.mark.parametrize("status", [404, 410])
def test_what_is_not_there_is_absent(tmp_path, monkeypatch, status):
    monkeypatch.chdir(tmp_path)
    with answering(status) as url:
        old = place_of(f"{url}/left_RPC.TXT")
        old.parent.mkdir(parents=True)
        old.write_text("of a run before")
        assert remote_files.fetch(f"{url}/left_RPC.TXT") is None
        assert not old.exists()
        with pytest.raises(InputError, match="no such file there"):
            remote_files.stand_in(f"{url}/left.tif")


@pytest.mark.parametrize("status", [400, 401, 403, 429, 500, 502, 503])
def test_a_server_that_fails_is_not_taken_for_a_missing_file(tmp_path, monkeypatch, status):
    """As it was with RPC files beside an image: the image's own tag was used then."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(web_requests, "WAIT_S", 0.01)
    with answering(status) as url:
        for bring in (remote_files.bring_image, remote_files.fetch, remote_files.stand_in):
            with pytest.raises(InputError, match=rf"does not answer as it should: .*{status}"):
                bring(f"{url}/left.tif")


def test_a_server_that_is_gone_is_not_taken_for_a_missing_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(web_requests, "WAIT_S", 0.01)
    with answering(200) as url:
        pass
    with pytest.raises(InputError, match="nobody answers there"):
        remote_files.fetch(f"{url}/left_RPC.TXT")


def test_a_small_file_is_fetched(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with answering(200, b"text") as url:
        assert remote_files.fetch(f"{url}/left_RPC.TXT").read_bytes() == b"text"


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
    for info in ({"size": None}, {"size": 5, "partial": False}):
        monkeypatch.setattr(remote_files, "info_of", lambda url, hosts, i=info: i)
        with pytest.raises(InputError, match="as a whole only"):
            remote_files.stand_in("https://host/left.tif")


def test_a_stand_in_keeps_its_time_while_the_file_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    state = json.dumps({"size": 5, "content": "tag"}) + "\n"
    monkeypatch.setattr(remote_files, "_look", lambda url, hosts=None: state)
    place = remote_files.stand_in("https://host/left.tif")
    before = place.stat().st_mtime_ns
    assert remote_files.stand_in("https://host/left.tif").stat().st_mtime_ns == before
    assert size_of(place) == 5
    remote_files.refuse_changed(place)
    monkeypatch.setattr(remote_files, "_look", lambda url, hosts=None: None)
    with pytest.raises(InputError, match="changed on its server"):
        remote_files.refuse_changed(place)
