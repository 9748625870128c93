"""Six synthetic cities with exact truth: images of a rigorous camera, LiDAR, control points.

Shares no projection code with the pipeline. ``cities`` holds the specs and plans files without
side effects; ``render``, ``lidar``, ``truth`` and ``points`` have one entry point per job.
"""

from .cities import CITIES, Character, CitySpec, SceneSpec, lidar_files

__all__ = ["CITIES", "Character", "CitySpec", "SceneSpec", "lidar_files"]
