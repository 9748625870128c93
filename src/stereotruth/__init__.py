"""Ground-truth disparity for satellite stereo pairs from LiDAR, RPCs and ground control points."""

__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    """``label_pair``, imported when it is asked for: what stands here counts for all digests."""
    if name != "label_pair":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return import_module("stereotruth.project.label_pair").label_pair
