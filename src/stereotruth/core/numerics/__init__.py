"""Interpolation, robust fits, error sums, windows, geometry: each once, of arrays alone."""
