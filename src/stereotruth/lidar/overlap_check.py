"""Refusal of LiDAR that does not lie where the images look."""

from __future__ import annotations

from pathlib import Path

from ..core.errors import InputError

Box = tuple[float, float, float, float]


def apart(a: Box, b: Box) -> bool:
    """Whether two boxes (west, south, east, north) share nothing."""
    return a[0] > b[2] or b[0] > a[2] or a[1] > b[3] or b[1] > a[3]


def _in_words(box: Box) -> str:
    return f"longitude {box[0]:.5f} to {box[2]:.5f}, latitude {box[1]:.5f} to {box[3]:.5f}"


FAR = 0.5  # degrees; no survey lies that far from the images that it was ordered for


def refuse_apart(lidar: Box, images: Box, heights: tuple[float, float], file: Path) -> None:
    """InputError: points lie elsewhere, or are in a wrong coordinate system."""
    facts = (
        f"the LiDAR covers {_in_words(lidar)} (heights {heights[0]:.1f} to {heights[1]:.1f} m), "
        f"the images {_in_words(images)}"
    )
    gaps = [max(lidar[k] - images[k + 2], images[k] - lidar[k + 2]) for k in (0, 1)]
    if not apart((lidar[1], lidar[0], lidar[3], lidar[2]), images):
        raise InputError(
            f"wrong coordinate system: longitude and latitude are swapped; {facts}",
            file=file,
            remedy="set lidar_crs in scenes.tsv to the system that the files are in",
        )
    if max(gaps) > FAR:
        raise InputError(
            f"wrong coordinate system: the points lie {max(gaps):.1f} degrees away from the "
            f"images; {facts}",
            file=file,
            remedy="check lidar_crs (zone, hemisphere) in scenes.tsv and the files' own CRS, "
            "and that the scene's row names the right LiDAR",
        )
    raise InputError(
        f"no overlap between LiDAR and images; {facts}",
        file=file,
        remedy="give the LiDAR files of this scene (column lidar of scenes.tsv); if they are, "
        "check lidar_crs and the RPCs",
    )
