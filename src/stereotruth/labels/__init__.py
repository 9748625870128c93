"""Stages project and image_heights: what each pixel shows, by the LiDAR.

In: an epipolar pair or one image, point stores, the surface. Out: disparity, uncertainty and status
of every pixel; heights.
"""
