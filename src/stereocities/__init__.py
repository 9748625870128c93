"""Synthetic cities with exact truth: images of a rigorous camera, LiDAR, control points.

In: seeds, or the points of a real place. Out: images, LiDAR, control points, truth. Shares no
projection code with the pipeline.
"""
