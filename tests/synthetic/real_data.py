"""Real files that lie beside the project, and are not part of it: tests without them skip."""

from __future__ import annotations

from pathlib import Path

SHARED = Path(__file__).parents[3] / "shared"
MARSEILLE = SHARED / "real" / "marseille"
PUBLISHED = SHARED / "published"
