"""Stage rectify. In: two images with (corrected) RPCs. Out: an epipolar model, two images.

Also the geometry between image, grid and ground that later stages ask for.
"""
