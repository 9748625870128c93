"""Stereo methods over whole scenes, in blended blocks, and their surface models."""
