"""Input that lies elsewhere: files of object storage (``s3://``) and of web servers, read by parts.

A file that a scene's row names by its URL is never fetched as a whole. A stand-in takes its place
in the working directory, ``results/remote/<scheme>/<host or bucket>/<path>``: its size and what the
server calls its content (ETag; where there is none, the time of its last change). The stages get
the stand-in's path, so that digests, records and reruns follow from what stands in it, and open
what it stands for: images through GDAL's ``/vsis3`` and ``/vsicurl``, LiDAR through fsspec, with
the rules of :mod:`.web_files` for web servers. Small files (RPCs, control points) are fetched.

Nothing but what stands in that folder is read from a network, whatever a file contains; the hosts
that a web server may redirect to beside its own stand there, too.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import urlsplit

from ..errors import InputError, install_extra
from .web_files import (
    AGAIN,
    MOST_REDIRECTS,
    WEB,
    Absent,
    Again,
    changed,
    read_whole,
    refusal,
    too_large,
    web_files,
)

Answer = TypeVar("Answer")
Ranges = Sequence[tuple[int, int]]  # first byte, and the one behind the last

FOLDER = Path("results", "remote")
SCHEMES = ("s3", *WEB)
MAX_COPY_BYTES = 10_000_000  # of a file that is fetched; RPCs and control points have some kB
LONGEST_PART = 200  # bytes between slashes, of which stand-ins have their names
PATIENCE_S = 300.0  # with one question, or a batch of parts, all tries together
TRIES, WAIT_S = 6, 0.5  # of a question, and before the second of them; doubled for each other
AT_ONCE = 4  # requests
_WAYS = "s3://bucket/path and https://host/path can be read"

_COPIED = {".rpb", ".txt", ".csv"}  # files that are fetched
RPC_ENDINGS = (".RPB", ".rpb", "_RPC.TXT", "_rpc.txt", "_RPC.txt")

# What clients fail with, by the names of their exceptions: the problem, and the remedy. Web servers
# are asked again where nobody answers; clients of buckets do so themselves.
NOBODY = "nobody answers there, or not to the end"
ENVIRONMENT = "AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
FAILURES = {
    ("NoCredentialsError", "PartialCredentialsError", "ProfileNotFound"): (
        "no credentials for it",
        f"export {ENVIRONMENT}, or name a profile by AWS_PROFILE",
    ),
    ("gaierror", "ClientConnectorDNSError"): (
        "its host is unknown",
        "correct the URL or AWS_ENDPOINT_URL, and check the network",
    ),
    ("TooManyRedirects",): (
        f"its server redirects more than {MOST_REDIRECTS} times",
        "check the URL",
    ),
    (
        *("EndpointConnectionError", "ConnectTimeoutError", "TimeoutError"),
        *("ClientConnectionError", "ClientPayloadError", "ClientResponseError"),
    ): (NOBODY, "check the URL (or AWS_ENDPOINT_URL) and the network, or try again later"),
    ("PermissionError",): (
        "the server refuses access",
        f"check {ENVIRONMENT}, which need the right to read and list",
    ),
}


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


def bucket(url: str) -> tuple[Any, str]:
    """The file system (fsspec) that holds an object of a bucket, and its name there."""
    import fsspec

    scheme, _, name = url.partition("://")
    try:  # listings are asked for each time: files come and go
        storage = fsspec.filesystem(scheme, use_listings_cache=False)
    except ImportError as error:
        raise InputError(
            f"{scheme}:// cannot be read here ({error})",
            remedy=install_extra("storage"),
        ) from error
    return storage, name.rstrip("/")


class State(NamedTuple):
    """What a stand-in holds: bytes of its file, what the server calls its content (ETag, or else a
    time), and the hosts beside its own that it may redirect to."""

    size: int
    content: str
    hosts: frozenset[str] = frozenset()

    @classmethod
    def of(cls, info: dict[str, Any], url: str, hosts: frozenset[str] = frozenset()) -> State:
        """By what fsspec tells. Raises InputError where a server gives no parts of files."""
        if info.get("size") is None or info.get("partial") is False:
            raise InputError(
                "its server tells no size, or gives files as a whole only",
                file=url,
                remedy="download it, and name the local file",
            )
        known = info.get("ETag") or info.get("Last-Modified") or info.get("LastModified") or ""
        return cls(int(info["size"]), str(known), hosts)

    @classmethod
    def held(cls, path: str | Path) -> State:
        """What a stand-in holds."""
        held = json.loads(Path(path).read_text())
        return cls(int(held["size"]), str(held["content"]), frozenset(held.get("hosts", ())))

    def put(self, place: Path) -> Path:
        """Write a stand-in; returns its path."""
        state = {"size": self.size, "content": self.content}
        state |= {"hosts": sorted(self.hosts)} if self.hosts else {}
        _put(place, (json.dumps(state) + "\n").encode())
        return place


def _look(url: str, hosts: frozenset[str] = frozenset()) -> State | None:
    """The state of a file; None if there is none. Raises InputError if nobody answers."""
    storage, name = (web_files(url, hosts), url) if _is_web(url) else bucket(url)
    try:
        info = ask_patiently(url, lambda: storage.info(name))
    except FileNotFoundError:
        return None
    return None if info.get("type") == "directory" else State.of(info, url, hosts)


def _is_web(url: str) -> bool:
    return urlsplit(url).scheme in WEB


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it follows from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _failure(error: Exception, url: str) -> tuple[Exception, bool, float | None]:
    """What to raise for what a server or its client fails with, whether asking again may help, and
    what pause the server asks for. FileNotFoundError if there is no such file."""
    chain = list(_chain(error))
    for link in chain:
        if isinstance(link, InputError):
            return link, False, None
        if isinstance(link, Again):
            return refusal(url, str(link), AGAIN), True, link.wait_s
        if isinstance(link, Absent):
            return FileNotFoundError(url), False, None
    names = {kind.__name__ for link in chain for kind in type(link).__mro__}
    for kinds, (problem, remedy) in FAILURES.items():
        if names & set(kinds):
            return InputError(problem, file=url, remedy=remedy), problem == NOBODY, None
    if isinstance(error, FileNotFoundError):
        return error, False, None
    said = "" if _is_web(url) else f": {error}"  # which may hold what a server redirects to
    problem = f"its server does not answer as it should ({type(error).__name__}{said})"
    remedy = f"try again later; check the URL, {ENVIRONMENT}, and AWS_ENDPOINT_URL"
    return InputError(problem, file=url, remedy=remedy), False, None


def ask_patiently(url: str, ask: Callable[[], Answer]) -> Answer:
    """What ``ask()`` returns, which is called again where that may help, in the server's pace.

    Raises FileNotFoundError if there is no such file; InputError for all else, and no later than
    one request after :data:`PATIENCE_S`.
    """
    until = time.monotonic() + PATIENCE_S
    for number in range(TRIES):
        try:
            return ask()
        except Exception as error:  # clients raise what they like
            failure, again, asked_s = _failure(error, url)
        pause_s = WAIT_S * 2**number if asked_s is None else asked_s
        if not (again and _is_web(url)) or time.monotonic() + pause_s > until:
            break
        time.sleep(pause_s)
    raise failure


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
    return state.put(place)


def state_of(url: str, hosts: frozenset[str] = frozenset()) -> State | None:
    """What a file is now; None if there is none.

    ``hosts`` that may be redirected to. Raises InputError for a URL that no stand-in can have, and
    if nobody answers.
    """
    place_of(url)
    return _look(url, hosts)


def stand_in_of(url: str, size: int, content: str, hosts: frozenset[str]) -> Path:
    """The stand-in of a file that is known already, as by a list of tiles; nobody is asked."""
    return State(size, content, hosts).put(place_of(url))


def fetch(url: str) -> Path | None:
    """Fetch a small file; None if there is none, and none is left here either.

    Raises InputError if it is larger than :data:`MAX_COPY_BYTES`.
    """
    place = place_of(url)
    try:
        _put(place, _read(url, MAX_COPY_BYTES, frozenset()))
    except FileNotFoundError:
        place.unlink(missing_ok=True)
        return None
    return place


def read_bytes(url: str, most_bytes: int, *, hosts: frozenset[str] = frozenset()) -> bytes:
    """A file as a whole. Raises InputError if there is none, or one of more than so many bytes.

    ``hosts`` that may be redirected to.
    """
    try:
        return _read(url, most_bytes, hosts)
    except FileNotFoundError:
        raise _missing(url) from None


def _read(url: str, most_bytes: int, hosts: frozenset[str]) -> bytes:
    """The same; raises FileNotFoundError if there is none."""
    if _is_web(url):
        return ask_patiently(url, lambda: read_whole(url, most_bytes, hosts))
    storage, name = bucket(url)
    if ask_patiently(url, lambda: storage.size(name)) > most_bytes:
        raise too_large(url, most_bytes)
    return ask_patiently(url, lambda: storage.cat_file(name))


def ranges_reader(path: str | Path) -> Callable[[Ranges], list[bytes]]:
    """What reads ranges of bytes of what a path stands for, :data:`AT_ONCE` requests at a time.

    It raises InputError if the file is another one by now than the stand-in says.
    """
    url = url_of(path) or ""
    size, content, hosts = State.held(path)
    storage, name = (web_files(url, hosts, size, content), url) if _is_web(url) else bucket(url)

    def ask(ranges: Ranges, held: dict[tuple[int, int], bytes]) -> None:
        """Add to ``held`` the ranges that it lacks. Raises the failure of one of them."""
        wanted = [part for part in ranges if part not in held]
        names, starts, ends = [name] * len(wanted), *map(list, zip(*wanted))
        failure = None
        answers = storage.cat_ranges(names, starts, ends, batch_size=AT_ONCE)
        for part, content in zip(wanted, answers):
            if isinstance(content, BaseException):
                failure = content
            elif len(content) != part[1] - part[0]:
                failure = Again(f"{len(content)} bytes came of {part[1] - part[0]}")
            else:
                held[part] = content
        if failure is not None:
            raise failure

    def read(ranges: Ranges) -> list[bytes]:
        if not _is_web(url):  # where each answer is compared
            refuse_changed(path)
        held: dict[tuple[int, int], bytes] = {}
        try:
            ask_patiently(url, lambda: ask(ranges, held))
        except FileNotFoundError:
            raise _missing(url) from None
        return [held[part] for part in ranges]

    return read


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
    if _is_web(url):
        raise InputError(
            "web servers list no folders", file=url, remedy="name one file, or use object storage"
        )
    found = _listed(url)
    wanted = {
        place_of(f"s3://{path}"): State.of(info, f"s3://{path}")
        for path, info in found.items()
        if path.lower().endswith(suffixes) and info.get("type") != "directory"
    }
    here = FOLDER.glob(str(place.relative_to(FOLDER))) if "*" in url else place.glob("*")
    for file in set(here) - set(wanted):
        if file.is_file():
            file.unlink()
    for file, state in wanted.items():
        state.put(file)
    return place


def _listed(url: str) -> dict[str, dict[str, Any]]:
    """What object storage has in a folder, or by a glob, by name; nothing if there is no such."""
    storage, name = bucket(url)
    try:
        if "*" in name:
            return ask_patiently(url, lambda: storage.glob(name, detail=True))
        listed = ask_patiently(url, lambda: storage.ls(name.rstrip("/"), detail=True))
    except FileNotFoundError:
        return {}
    return {info["name"]: info for info in listed}


def hosts_of(path: str | Path) -> frozenset[str]:
    """The hosts, beside its own, that the server of what a path stands for may redirect to."""
    return State.held(path).hosts if url_of(path) else frozenset()


def size_of(path: str | Path) -> int:
    """Bytes of a file, or of what it stands for."""
    return State.held(path).size if url_of(path) else Path(path).stat().st_size


def refuse_changed(path: str | Path) -> None:
    """Raise InputError if the file that a path stands for is another one by now."""
    url = url_of(path)
    if url is not None:
        held = State.held(path)
        if _look(url, held.hosts) != held:
            raise changed(url)


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
