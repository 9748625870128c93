"""Six synthetic cities with exact truth: images of a rigorous camera, LiDAR, control points.

In: seeds. Out: images, LiDAR, control points, truth. Shares no projection code with the pipeline.
"""
