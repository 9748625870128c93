"""Stereo methods on labelled pairs: methods, networks, scores; and audits of stereo datasets."""
