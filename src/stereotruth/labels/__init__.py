"""Stage project. In: an epipolar pair, point stores. Out: disparity and status of every pixel."""
