"""Ground-truth disparity for satellite stereo pairs from LiDAR, RPCs and ground control points."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

__version__ = "0.1.0"


def _compiled_code_folder() -> str:
    """Where numba keeps what it compiles: a folder per state of this package's source.

    Numba looks at the file of a function only, and would go on using the old code of a function
    whose callee in another file has changed.
    """
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        digest.update(file.read_bytes())
    writable = os.access(package, os.W_OK)
    cache = package / "__pycache__" if writable else Path.home() / ".cache" / "stereotruth"
    return str(cache / f"numba-{digest.hexdigest()[:16]}")


os.environ.setdefault("NUMBA_CACHE_DIR", _compiled_code_folder())
