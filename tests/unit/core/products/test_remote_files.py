"""Files that lie elsewhere: their names, what servers may do, and copies of what has come."""

from __future__ import annotations

import io
import time
from pathlib import Path

import pytest

from stereotruth.core.errors import InputError
from stereotruth.core.products import file_parts, remote_files, web_files
from stereotruth.core.products.file_parts import FOLDER, open_parts, open_stream, prune
from stereotruth.core.products.remote_files import (
    fetch,
    gdal_name,
    place_of,
    read_bytes,
    refuse_changed,
    size_of,
    stand_in,
    url_of,
)
from stereotruth.core.products.web_files import refuse_redirect

from ....synthetic.copc_server import SERVER_FAULTS, serving

CONTENT = bytes(range(256)) * 1000
PATIENCE_S = 1.5


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(remote_files, "WAIT_S", 0.05)
    monkeypatch.setattr(remote_files, "PATIENCE_S", PATIENCE_S)
    monkeypatch.setattr(web_files, "REQUEST_S", PATIENCE_S)
    monkeypatch.setattr(web_files, "STALL_S", 0.5)


def test_a_place_stands_for_its_url():
    for url in ("s3://bucket/a/left.tif", "https://host:8443/a%20b/left.tif", "http://[::1]:9/x"):
        assert url_of(place_of(url)) == url == url_of(place_of(url).absolute())


OTHER_URLS = (
    "ftp://host/left.tif",
    "file:///etc/passwd",
    "s3://bucket",
    "https://host/left.tif?signature=1",
    "https://name:word@host/left.tif",
    "https://name:wo/rd@host/left.tif",
    "https://host/../../left.tif",
    "s3://../left.tif",
    "https://host//left.tif",
    "https://host/./left.tif",
    "https://host/a\nb/left.tif",
    "https://[host/left.tif",
    f"s3://bucket/{'x' * 201}.tif",
)


def test_other_urls_are_refused():
    for url in OTHER_URLS:
        with pytest.raises(InputError) as refused:
            place_of(url)
        assert "signature" not in str(refused.value) and "word@" not in str(refused.value)


@pytest.mark.parametrize(
    ("url", "location", "allowed"),
    [
        ("http://host/a", "/b", True),
        ("http://host:8080/a", "https://host/b", True),
        ("http://host/a", "http://host:22/b", False),
        ("https://host/a", "https://host:8443/b", False),
        ("https://host/a", "http://host/b", False),
        ("https://host/a", "https://other:8443/b", True),  # which is allowed
        ("https://host/a", "http://other/b", False),
        ("https://host/a", "//third/b", False),
        ("https://host/a", "https://host@third/b", False),
        ("https://host/a", "file:///etc/passwd", False),
        ("https://host/a", "https://ho\x1b[31mst/b", False),
        ("https://host/a", "", False),
    ],
)
def test_where_a_redirect_may_lead(url, location, allowed):
    hosts = frozenset({"other"})
    if allowed:
        return refuse_redirect(url, location, url, hosts)
    with pytest.raises(InputError) as refused:
        refuse_redirect(url, location and location + "?token=verysecret", url, hosts)
    assert "verysecret" not in str(refused.value) and "\x1b" not in str(refused.value)


def held_of(server, hosts=()) -> bytes:
    """Two parts of what the server has, the second one by a stream."""
    place = server.stand_in(hosts=hosts)
    (first,) = open_parts(place).get([(0, 5000)])
    with open_stream(place, 1 << 14) as stream:
        stream.seek(100_000)
        return first + stream.read(50_000)


@pytest.mark.parametrize("fault", SERVER_FAULTS)
def test_a_server_that_fails_is_overcome_or_named(fault):
    start = time.monotonic()
    with serving(CONTENT, fault, when=1) as server:
        try:
            assert held_of(server) == CONTENT[:5000] + CONTENT[100_000:150_000]
            assert SERVER_FAULTS[fault][0]
        except InputError as error:
            assert not SERVER_FAULTS[fault][0], error
            assert server.url in str(error) and "Remedy: " in str(error)
            assert "secret" not in f"{error} {error.__cause__}"
    assert time.monotonic() - start < 2 * PATIENCE_S + 1
    assert len(server.requests) > 1  # the fault was met


def test_a_redirect_is_followed_to_hosts_that_are_allowed():
    with serving(CONTENT) as other, serving(CONTENT, "redirect to another host") as first:
        first.target = other.url.replace("127.0.0.1", "localhost") + "?sig=secret"
        with pytest.raises(InputError, match="--allow-host localhost") as refused:
            held_of(first)
        assert "sig" not in str(refused.value) and not other.requests
        assert held_of(first, ["localhost"])[:5000] == CONTENT[:5000]
    assert not any(b"secret" in file.read_bytes() for file in Path().rglob("*") if file.is_file())


def test_small_files_are_fetched_and_missing_ones_are_absent():
    with serving(Path()) as server:
        url = f"{server.url}left_RPC.TXT"
        Path("left_RPC.TXT").write_text("text")
        assert fetch(url).read_bytes() == b"text"
        assert read_bytes(url, 4) == b"text"
        with pytest.raises(InputError, match="larger than"):
            read_bytes(url, 3)
        Path("left_RPC.TXT").unlink()
        assert fetch(url) is None and not place_of(url).exists()
        for ask in (lambda: read_bytes(url, 4), lambda: stand_in(url)):
            with pytest.raises(InputError, match="no such file there"):
                ask()


@pytest.mark.parametrize("fault", ["503 for ever", "forbidden", "redirect to another port"])
def test_a_server_that_fails_is_not_taken_for_a_missing_file(fault):
    """As it was with RPC files beside an image: the image's own tag was used then."""
    with serving(b"text", fault) as server:
        for bring in (fetch, remote_files.bring_image, stand_in):
            with pytest.raises(InputError, match="does not answer as it should"):
                bring(server.url)
    with pytest.raises(InputError, match="nobody answers"):
        fetch(server.url)


def test_a_stand_in_keeps_its_time_while_the_file_stays():
    with serving(CONTENT) as server:
        place = stand_in(server.url)
        before = place.stat().st_mtime_ns
        assert stand_in(server.url).stat().st_mtime_ns == before
        assert size_of(place) == len(CONTENT)
        refuse_changed(place)
        server.content = CONTENT + b"more"
        with pytest.raises(InputError, match="changed on its server"):
            refuse_changed(place)


def test_a_second_reading_asks_for_nothing_and_a_killed_one_for_the_rest():
    with serving(CONTENT) as server:
        place = server.stand_in()
        with open_stream(place, 1 << 15) as stream:
            assert stream.read(100_000) == CONTENT[:100_000]  # and no more came
        server.requests.clear()
        for _ in range(2):
            with open_stream(place, 1 << 15) as stream:
                assert stream.read() == CONTENT
                stream.seek(-100, io.SEEK_END)
                assert stream.read(40) == CONTENT[-100:-60]
        assert len(server.requests) == -(-len(CONTENT) // (1 << 15)) - 4


@pytest.mark.parametrize("state", [(b"x" * len(CONTENT), '"two"'), (CONTENT + b"x", '"one"')])
def test_a_file_that_has_changed_is_refused_and_never_mixed(state):
    content, tag = state
    with serving(CONTENT) as server:
        place = server.stand_in()
        assert open_parts(place).get([(5, 90)]) == [CONTENT[5:90]]
        server.content = content
        server.stand_in(content=tag)
        if tag == '"two"':  # which the server does not say of its file
            with pytest.raises(InputError, match="changed on its server"):
                open_parts(place).get([(5, 90)])
        else:
            assert open_parts(place).get([(5, 90)]) == [content[5:90]]
            assert len(list(FOLDER.glob("*"))) == 2


def test_a_damaged_copy_is_fetched_again():
    with serving(CONTENT) as server:
        place = server.stand_in()
        open_parts(place).get([(100, 900)])
        (copy,) = FOLDER.glob("*/*")
        held = bytearray(copy.read_bytes())
        held[7] ^= 4
        for damaged in (held[:-9], held, b""):
            copy.write_bytes(damaged)
            assert open_parts(place).get([(100, 900)]) == [CONTENT[100:900]]


def test_the_folder_keeps_its_limit():
    with serving(CONTENT) as server:
        parts = open_parts(server.stand_in())
        for k in (*range(10), 0):  # the first is used again: it stays
            parts.get([(1000 * k, 1000 * (k + 1))])
        prune(3 * (1000 + file_parts.CHECK_BYTES))
        assert len(list(FOLDER.glob("*/*"))) == 3 and list(FOLDER.glob("*/0-1000"))
        prune(0)
        assert not list(FOLDER.glob("*"))


def test_what_lies_elsewhere_in_the_working_directory_is_a_file():
    Path("left.tif").write_text('{"size": 7, "content": "x"}\n')
    assert url_of("left.tif") is None and size_of("left.tif") == 28
    assert gdal_name("left.tif") == ("left.tif", {})
    assert url_of(place_of("s3://bucket/left_RPC.TXT")) is None  # small files are fetched


def test_gdal_may_read_the_one_file(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9000")
    name, options = gdal_name(place_of("s3://bucket/a/left.tif"))
    assert name == "/vsis3/bucket/a/left.tif" == options["CPL_VSIL_CURL_ALLOWED_FILENAME"]
    assert (options["AWS_S3_ENDPOINT"], options["AWS_HTTPS"]) == ("127.0.0.1:9000", "NO")
    name, options = gdal_name(place_of("https://host/left.tif"))
    assert name == "/vsicurl/https://host/left.tif"
    assert not [option for option in options if option.startswith("AWS")]


KEYS = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b"}


@pytest.mark.parametrize(
    ("environment", "words"),
    [({}, "no credentials"), (KEYS | {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, "nobody answers")],
)
def test_a_bucket_that_cannot_be_read_is_named_with_the_remedy(monkeypatch, environment, words):
    s3fs = pytest.importorskip("s3fs")
    for name in (*KEYS, "AWS_PROFILE", "AWS_ENDPOINT_URL"):
        monkeypatch.delenv(name, raising=False)
    quick = {"AWS_EC2_METADATA_DISABLED": "true", "AWS_MAX_ATTEMPTS": "1"}
    nowhere = {"AWS_CONFIG_FILE": "/none", "AWS_SHARED_CREDENTIALS_FILE": "/none"}
    for name, value in {**quick, **nowhere, **environment}.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    with pytest.raises(InputError, match=f"s3://bucket/x.tif: {words}"):
        stand_in("s3://bucket/x.tif")
