"""Ground-truth disparity for satellite stereo pairs from LiDAR, RPCs and ground control points."""

from __future__ import annotations

import hashlib
import os
import tempfile
from contextlib import suppress
from pathlib import Path

__version__ = "0.1.0"


def _writable(folder: Path, private: bool) -> bool:
    """Whether a folder can be made and written to; ``private``: by this user alone."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        facts = folder.stat()
    except OSError:
        return False
    safe = facts.st_uid == os.getuid() and not facts.st_mode & 0o022
    return os.access(folder, os.W_OK) and (safe or not private)


def _compiled_code_folder() -> str:
    """Where numba keeps what it compiles: a folder per state of this package's source.

    Numba looks at the file of a function only, and would go on using the old code of a function
    whose callee in another file has changed. The folder is that of the package, of the user, or,
    where neither can be written to, a temporary one.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.read_bytes())
    name = f"numba-{digest.hexdigest()[:16]}"
    if os.access(package, os.W_OK):
        return str(package / "__pycache__" / name)
    with suppress(RuntimeError):  # no HOME, and no such user
        if _writable(cache := Path.home() / ".cache" / "stereotruth", private=False):
            return str(cache / name)
    shared = Path(tempfile.gettempdir()) / f"stereotruth-{os.getuid()}"
    if not _writable(shared, private=True):  # others' code must not run here
        shared = Path(tempfile.mkdtemp(prefix="stereotruth-"))
    return str(shared / name)


os.environ.setdefault("NUMBA_CACHE_DIR", _compiled_code_folder())
