"""Audit of a stereo dataset: what its images and labels say of each other, from the files alone."""
