"""Stages align and refine: where the images look, by control points and by the LiDAR.

In: RPCs, ground control points, point stores. Out: alignment.json (corrected RPCs, residuals,
covariance), and what it means for labels.
"""
