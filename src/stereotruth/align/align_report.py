"""The record of an alignment: JSON and a table of the residuals."""

from __future__ import annotations

import csv
from pathlib import Path

from ..core.products.files import as_text, atomic_file
from .aligned_pair import Alignment


def write_alignment(alignment: Alignment, json_file: str | Path, csv_file: str | Path) -> None:
    """Write the alignment (JSON) and the residuals of every GCP (CSV, px)."""
    with atomic_file(csv_file) as scratch:
        _write_table(alignment, scratch)
    alignment.save(json_file)


def _write_table(alignment: Alignment, path: Path) -> None:
    pairs = ("measured", "predicted", "before", "after", "leave_one_out")
    header = ["view", "id", "used", "lon_deg", "lat_deg", "height_m"]
    header += [f"{name}_{axis}_px" for name in pairs for axis in ("col", "row")] + ["reason"]
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(header)
        for fit in alignment.fits:
            for g in fit.gcps:
                numbers = [f"{v:.4f}" for name in pairs for v in getattr(g, name)]
                ground = [f"{g.lon:.10f}", f"{g.lat:.10f}", f"{g.height:.4f}"]
                writer.writerow(
                    [
                        fit.view,
                        as_text(g.id),
                        "yes" if g.used else "no",
                        *(*ground, *numbers),
                        as_text(g.reason),
                    ]
                )
