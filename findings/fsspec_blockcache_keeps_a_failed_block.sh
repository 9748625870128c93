#!/usr/bin/env bash
# A failed request leaves a block of zeros in fsspec's cache, for all later reads and processes.
#
# Guess: when a server answers one request with an error (503), the read fails, and who tries again
#   gets the bytes, as it is without "blockcache".
# What happens: the block counts as held before it is fetched. The read fails, as "a bytes-like
#   object is required" rather than as an error of HTTP. From then on the block reads as zeros: when
#   the read is tried again, and in other processes, since the list of blocks is kept on disk.
# Source: fsspec 2026.9.0, caching.py: MMapCache._fetch updates self.blocks before it calls the
#   fetcher; implementations/cached.py, close_and_update, stores that set.
# Why it matters: LiDAR and images are read from public buckets, which refuse a request now and then,
#   so that readers try again. Zeros are valid pixels of a TIFF without compression and valid points
#   of a LAS file: the truth of a scene gets heights and grey values 0, until the cache is removed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check \
    "fsspec[http]==2026.9.0" aiohttp==3.14.5 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import http.server
import re
import subprocess
import sys
import threading

import fsspec
import numpy as np

disparity = np.full(100_000, 37.25, "<f4")
data, block_bytes = disparity.tobytes(), 65_536
failed = []


class Server(http.server.BaseHTTPRequestHandler):
    """Serves ranges of the file; refuses the first request that covers byte 200,000."""

    protocol_version = "HTTP/1.1"

    def do_HEAD(self):
        self.answer(200, data)

    def do_GET(self):
        asked = re.match(r"bytes=(\d+)-(\d+)", self.headers.get("Range") or "")
        first, last = (int(asked[1]), int(asked[2])) if asked else (0, len(data) - 1)
        if first <= 200_000 <= last and not failed:
            failed.append(first)
            self.answer(503, b"")
        else:
            self.answer(206 if asked else 200, data[first : last + 1], first)

    def answer(self, status, body, first=0):
        self.send_response(status)
        self.send_header("Accept-Ranges", "bytes")
        self.send_header("Content-Length", str(len(body)))
        if status == 206:
            self.send_header("Content-Range", f"bytes {first}-{first + len(body) - 1}/{len(data)}")
        self.end_headers()
        if self.command == "GET":
            self.wfile.write(body)

    def log_message(self, *_):
        pass


server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Server)
threading.Thread(target=server.serve_forever, daemon=True).start()
url = f"http://127.0.0.1:{server.server_port}/disparity.bin"


def read(files):
    """Values of the file, read in parts; a part that fails is tried again, once."""
    found = []
    with files.open(url, block_size=block_bytes) as file:
        for start in range(0, len(data), 50_000):
            for _ in range(2):
                try:
                    file.seek(start)
                    found.append(file.read(50_000))
                    break
                except Exception as error:
                    print("  refused:", f"{type(error).__name__}: {error}".split(", url")[0])
    return np.frombuffer(b"".join(found), "<f4")


print("fsspec", fsspec.__version__)
print("http")
plain = read(fsspec.filesystem("http"))
failed.clear()
print("blockcache over http")
cached = read(fsspec.filesystem("blockcache", target_protocol="http", cache_storage="cache"))
later = f"""
import fsspec
files = fsspec.filesystem("blockcache", target_protocol="http", cache_storage="cache")
with files.open({url!r}, block_size={block_bytes}) as file:
    print(file.read().hex())
"""
done = subprocess.run([sys.executable, "-c", later], check=True, capture_output=True, text=True)
again = np.frombuffer(bytes.fromhex(done.stdout), "<f4")
for name, values in (("http", plain), ("blockcache", cached), ("another process", again)):
    print(f"{name}: {np.sum(values == 37.25)} values of 37.25, {np.sum(values == 0)} zeros")
assert np.array_equal(plain, disparity)
for values in (cached, again):
    assert values.size == disparity.size and np.sum(values == 0) == block_bytes // 4
PYTHON
