"""Stages export, dataset, verify; reading of any stereo dataset.

In: epipolar grids. Out: tiles, manifest, splits, the published layout; the pairs of any dataset.
"""
