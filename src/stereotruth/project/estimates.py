"""What runs take and how many pixels get a label, as benchmarks have measured it."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

TABLE = Path(__file__).with_name("estimates.json")


@cache
def estimates() -> dict[str, Any]:
    """The table of ``estimates.json``.

    ``seconds`` of one core for each point, pixel, scene and job; ``bytes`` on the disk for each
    point and pixel; ``labelled``: shares of the visible pixels with a label by recipe, and the
    points a pixel (``points_per_px``) that they go with.
    """
    return json.loads(TABLE.read_text(encoding="utf-8"))
