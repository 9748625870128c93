"""Input that lies elsewhere: files of object storage (``s3://``) and of web servers, read by parts.

A file that a scene's row names by its URL is never fetched as a whole. A stand-in takes its place
in the working directory, ``results/remote/<scheme>/<host or bucket>/<path>``: its size and what the
server calls its content (ETag; where there is none, the time of its last change). The stages get
the stand-in's path, so that digests, records and reruns follow from what stands in it, and open
what it stands for: images through GDAL's ``/vsis3`` and ``/vsicurl``, LiDAR of buckets through
fsspec, of web servers by :mod:`.web_requests`. Small files (RPCs, control points) are fetched.

Nothing but what stands in that folder is read from a network, whatever a file contains; the hosts
that a web server may redirect to beside its own stand there, too.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import urlsplit

from ..errors import InputError, install_extra
from .ranges import Ranges, RangeStream, WebRanges, changed
from .web_requests import WEB, info_of, read_whole, too_large

FOLDER = Path("results", "remote")
SCHEMES = ("s3", *WEB)
MAX_COPY_BYTES = 10_000_000  # of a file that is fetched; RPCs and control points have some kB
LONGEST_PART = 200  # bytes between slashes, of which stand-ins have their names
CLIENTS = ("aiobotocore", "botocore", "fsspec", "s3fs")  # whose errors are a server's
READ_BYTES = 4 << 20  # of a LiDAR file at once
_WAYS = "s3://bucket/path and https://host/path can be read"


def is_remote(text: str) -> bool:
    """Whether a cell of the sheet is a URL."""
    return "://" in text


def place_of(url: str) -> Path:
    """Where the stand-in of a URL lies. Raises InputError for one that cannot be read."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:  # a port that is no number, brackets that do not close
        parts, host, port = urlsplit(""), "", None
    path = parts.path.strip("/")
    if parts.scheme not in SCHEMES or not host or not path:
        raise InputError("no such kind of URL", file=url, remedy=_WAYS)
    names = path.split("/")
    if parts.query or parts.fragment or "@" in parts.netloc or ".." in (host, *names):
        raise InputError(
            "a URL with a query, a password or '..'",
            file=url,
            remedy="name the file alone; credentials come from the environment (see "
            "docs/how-to/object_storage.md)",
        )
    netloc = parts.netloc if port is None else f"{parts.netloc.rpartition(':')[0]}:{port}"
    place = FOLDER / parts.scheme / netloc / path
    if f"{parts.scheme}://{netloc}/{path}" != url.rstrip("/") or place.parts[4:] != tuple(names):
        raise InputError(
            "a URL that no file can stand for (//, /./, or characters that no URL has)",
            file=url,
            remedy=_WAYS,
        )
    if max(len(os.fsencode(name)) for name in names) > LONGEST_PART or not url.isprintable():
        raise InputError(
            f"a URL with a part of more than {LONGEST_PART} bytes, or that cannot be printed",
            file=url,
            remedy="give the file a shorter name",
        )
    return place


def url_of(path: str | Path) -> str | None:
    """What a path stands for; None if it is a file itself."""
    try:
        inside = Path(path).absolute().relative_to(Path.cwd() / FOLDER)
    except ValueError:
        return None
    scheme, *rest = inside.parts
    return f"{scheme}://{'/'.join(rest)}" if Path(path).suffix.lower() not in _COPIED else None


_COPIED = {".rpb", ".txt", ".csv"}  # files that are fetched
RPC_ENDINGS = (".RPB", ".rpb", "_RPC.TXT", "_rpc.txt", "_RPC.txt")


@cache
def _file_system(scheme: str) -> Any:
    try:
        import fsspec

        # listings are asked for each time: files come and go
        how = {"use_listings_cache": False} if scheme == "s3" else {}
        return fsspec.filesystem(scheme, **how)
    except ImportError as error:
        raise InputError(
            f"{scheme}:// cannot be read here ({error})",
            remedy=install_extra("storage"),
        ) from error


def bucket(url: str) -> tuple[Any, str]:
    """The file system (fsspec) that holds a URL, and its name there."""
    scheme = urlsplit(url).scheme
    storage = _file_system(scheme)
    return storage, storage._strip_protocol(url)


def _state(info: dict[str, Any], url: str, hosts: frozenset[str] = frozenset()) -> str:
    """What a stand-in holds. Raises InputError where a server gives no parts of files."""
    if info.get("size") is None or info.get("partial") is False:
        raise InputError(
            "its server tells no size, or gives files as a whole only",
            file=url,
            remedy="download it, and name the local file",
        )
    known = info.get("ETag") or info.get("Last-Modified") or info.get("LastModified") or ""
    state = {"size": int(info["size"]), "content": str(known)}
    return json.dumps(state | ({"hosts": sorted(hosts)} if hosts else {})) + "\n"


def _look(url: str, hosts: frozenset[str] = frozenset()) -> str | None:
    """The state of a file; None if there is none. Raises InputError if nobody answers."""
    if urlsplit(url).scheme in WEB:
        info = info_of(url, hosts)
        return None if info is None else _state(info, url, hosts)
    storage, name = bucket(url)
    with answering(url):
        try:
            info = storage.info(name)
        except FileNotFoundError:
            return None
        return None if info.get("type") == "directory" else _state(info, url)


# What clients fail with, by the names of their exceptions: the problem, and the remedy.
FAILURES = (
    (
        ("NoCredentialsError", "PartialCredentialsError", "ProfileNotFound"),
        "no credentials for it",
        "export AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or name a profile by AWS_PROFILE",
    ),
    (
        ("gaierror", "ClientConnectorDNSError"),
        "its host is unknown",
        "correct the URL or AWS_ENDPOINT_URL, and check the network",
    ),
    (
        ("EndpointConnectionError", "ClientConnectorError", "ConnectTimeoutError", "TimeoutError"),
        "nobody answers there",
        "check AWS_ENDPOINT_URL and the network, or try again later",
    ),
    (
        ("PermissionError",),
        "the server refuses access",
        "check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, which need the right to read and list",
    ),
)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it follows from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


@contextmanager
def answering(url: str) -> Iterator[None]:
    """In the block, what a server or its client fails with is an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # clients raise what they like
        names = {kind.__name__ for link in _chain(error) for kind in type(link).__mro__}
        for kinds, problem, remedy in FAILURES:
            if names & set(kinds):
                raise InputError(problem, file=url, remedy=remedy) from None
        raise InputError(
            f"its server does not answer as it should ({type(error).__name__}: {error})",
            file=url,
            remedy="try again later; check the URL, the credentials (AWS_ACCESS_KEY_ID …, with "
            "the right to list) and AWS_ENDPOINT_URL",
        ) from None


def _put(place: Path, content: bytes) -> None:
    """Write a file if it holds something else: its time stays where nothing has changed."""
    if place.is_file() and place.read_bytes() == content:
        return
    place.parent.mkdir(parents=True, exist_ok=True)
    scratch = place.with_name(f".{place.name}.{os.getpid()}")
    scratch.write_bytes(content)
    scratch.replace(place)


def _missing(url: str) -> InputError:
    return InputError("no such file there", file=url, remedy="correct it in scenes.tsv")


def stand_in(url: str) -> Path:
    """Ask for a file's state and write its stand-in. Raises InputError if it is missing."""
    place = place_of(url)
    if (state := _look(url)) is None:
        raise _missing(url)
    _put(place, state.encode())
    return place


def state_of(url: str, hosts: frozenset[str] = frozenset()) -> tuple[int, str] | None:
    """Bytes of a file now, and what its server calls its content; None if there is none.

    ``hosts`` that may be redirected to. Raises InputError for a URL that no stand-in can have, and
    if nobody answers.
    """
    place_of(url)
    if (state := _look(url, hosts)) is None:
        return None
    held = json.loads(state)
    return held["size"], held["content"]


def stand_in_of(url: str, size: int, content: str, hosts: frozenset[str]) -> Path:
    """The stand-in of a file that is known already, as by a list of tiles; nobody is asked."""
    place = place_of(url)
    info = {"size": size, "ETag": content}
    _put(place, _state(info, url, hosts).encode())
    return place


def fetch(url: str) -> Path | None:
    """Fetch a small file; None if there is none, and none is left here either.

    Raises InputError if it is larger than :data:`MAX_COPY_BYTES`.
    """
    place = place_of(url)
    if (state := _look(url)) is None:
        place.unlink(missing_ok=True)
        return None
    content = read_bytes(url, MAX_COPY_BYTES, size=json.loads(state)["size"])
    if len(content) != json.loads(state)["size"]:
        raise InputError(
            f"{len(content)} bytes came of {json.loads(state)['size']}",
            file=url,
            remedy="run again, and leave it alone until the run has ended",
        )
    _put(place, content)
    return place


def read_bytes(
    url: str, most_bytes: int, *, size: int | None = None, hosts: frozenset[str] = frozenset()
) -> bytes:
    """A file as a whole. Raises InputError if it has more than so many bytes, which are not read.

    ``size``: what is known of it already. ``hosts``: see :mod:`.web_requests`.
    """
    if size is not None and size > most_bytes:
        raise too_large(url, most_bytes)
    if urlsplit(url).scheme in WEB:
        return read_whole(url, most_bytes, hosts)
    if size is None:
        if (state := _look(url)) is None:
            raise _missing(url)
        return read_bytes(url, most_bytes, size=json.loads(state)["size"])
    storage, name = bucket(url)
    with answering(url):
        return storage.cat_file(name)


def bring_image(url: str) -> Path:
    """Stand-in of an image, and copies of the RPC files beside it."""
    stem = url.removesuffix(Path(url).suffix)
    with ThreadPoolExecutor(len(RPC_ENDINGS)) as pool:
        list(pool.map(fetch, (stem + ending for ending in RPC_ENDINGS)))
    return stand_in(url)


def bring_table(url: str) -> Path:
    """Copy of a table of control points. Raises InputError if it is missing or no CSV."""
    if not url.lower().endswith(".csv"):
        raise InputError("its name does not end in .csv", file=url, remedy="name it so")
    if (found := fetch(url)) is None:
        raise _missing(url)
    return found


def bring_files(url: str, suffixes: tuple[str, ...]) -> Path:
    """Stand-ins of the files that a URL, a folder or a glob (S3) of them names; the same here.

    Stand-ins of files that are gone go. Raises InputError if a web server is asked for a folder.
    """
    place = place_of(url)
    if url.lower().endswith(suffixes) and "*" not in url:
        return stand_in(url)
    if urlsplit(url).scheme in WEB:
        raise InputError(
            "web servers list no folders", file=url, remedy="name one file, or use object storage"
        )
    found = _listed(url)
    wanted = {
        place_of(f"s3://{path}"): _state(info, f"s3://{path}")
        for path, info in found.items()
        if path.lower().endswith(suffixes) and info.get("type") != "directory"
    }
    here = FOLDER.glob(str(place.relative_to(FOLDER))) if "*" in url else place.glob("*")
    for file in set(here) - set(wanted):
        if file.is_file():
            file.unlink()
    for file, state in wanted.items():
        _put(file, state.encode())
    return place


def _listed(url: str) -> dict[str, dict[str, Any]]:
    """What object storage has in a folder, or by a glob, by name; nothing if there is no such."""
    storage, name = bucket(url)
    with answering(url):
        if "*" in name:
            return storage.glob(name, detail=True)
        try:
            listed = storage.ls(name.rstrip("/"), detail=True)
        except FileNotFoundError:
            return {}
        return {info["name"]: info for info in listed}


def _held(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def hosts_of(path: str | Path) -> frozenset[str]:
    """The hosts, beside its own, that the server of what a path stands for may redirect to."""
    return frozenset(_held(Path(path)).get("hosts", ())) if url_of(path) else frozenset()


def size_of(path: str | Path) -> int:
    """Bytes of a file, or of what it stands for."""
    path = Path(path)
    return _held(path)["size"] if url_of(path) else path.stat().st_size


@contextmanager
def open_file(path: str | Path) -> Iterator[BinaryIO]:
    """A file to read from, or what it stands for, of which the parts asked for are fetched.

    Raises InputError if that is no longer what the stand-in says.
    """
    path = Path(path)
    if (url := url_of(path)) is None:
        with path.open("rb") as stream:
            yield stream
        return
    refuse_changed(path)
    held = _held(path)
    size = held["size"]
    if urlsplit(url).scheme in WEB:
        ranges = WebRanges(url, allow_hosts=hosts_of(path))
        same_as_stand_in(ranges, size, held["content"])
        with io.BufferedReader(RangeStream(ranges, READ_BYTES)) as file:
            yield file
        return
    storage, name = bucket(url)
    how = {"block_size": READ_BYTES, "cache_type": "readahead", "size": size}
    try:
        with storage.open(name, "rb", **how) as file:
            yield file
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in CLIENTS:
            raise
        with answering(url):
            raise


def refuse_changed(path: str | Path) -> None:
    """Raise InputError if the file that a path stands for is another one by now."""
    url = url_of(path)
    if url is not None and _look(url, hosts_of(path)) != Path(path).read_text():
        raise changed(url)


def same_as_stand_in(ranges: Ranges, size: int, content: str) -> Ranges:
    """What a server gives, if that is what a stand-in says. Raises InputError if it is not.

    Some servers name no content, or not with every answer.
    """
    other = ranges.content and content and ranges.content != content
    if ranges.size != size or other:
        raise changed(ranges.name)
    return ranges


def gdal_name(path: str | Path) -> tuple[str, dict[str, str]]:
    """How GDAL calls a file or what it stands for, and the options that let it read just that."""
    if (url := url_of(path)) is None:
        return os.fspath(path), {}
    parts = urlsplit(url)
    name = f"/vsis3/{parts.netloc}{parts.path}" if parts.scheme == "s3" else f"/vsicurl/{url}"
    options = {
        "CPL_VSIL_CURL_ALLOWED_FILENAME": name,
        "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
    }
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    if parts.scheme == "s3" and endpoint:
        where = urlsplit(endpoint)
        options |= {
            "AWS_S3_ENDPOINT": where.netloc,
            "AWS_HTTPS": "YES" if where.scheme == "https" else "NO",
            "AWS_VIRTUAL_HOSTING": "FALSE",
        }
    return name, options
