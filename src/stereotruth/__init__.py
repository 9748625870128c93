"""Ground-truth disparity for satellite stereo pairs from LiDAR, RPCs and ground control points."""

__version__ = "0.1.0"
