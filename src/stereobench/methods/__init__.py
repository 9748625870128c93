"""Stereo methods. In: epipolar pairs. Out: disparities, scores, surface models."""
