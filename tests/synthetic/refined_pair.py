"""A pair's refinement with the surface of its points, made beside them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stereotruth.align import refine as stage
from stereotruth.align.adjustment import Observations
from stereotruth.align.alignment import Alignment
from stereotruth.lidar.point_store import open_stores
from stereotruth.sensor.shown_ground import GroundOfImages
from stereotruth.surface.make_surface import make_surface
from stereotruth.surface.scale import ground_cell


def refine(
    alignment: Alignment, left: Path, right: Path, stores: Sequence[Path], **options
) -> tuple[Alignment, Observations | None]:
    """The stage; ``options`` are its own."""
    surface = stores[0].with_suffix(".surface")
    if not surface.is_dir():
        sizes = [fit.size for fit in alignment.fits]
        ground = GroundOfImages([alignment.left, alignment.right], sizes)
        cell = ground_cell(ground.pixel_deg)
        make_surface(open_stores(sorted(stores)), surface, cell=cell, ground=ground)
    return stage.refine(alignment, left, right, stores, surface, **options)
