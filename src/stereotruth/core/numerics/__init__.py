"""Interpolation, robust least squares, error sums, summed areas: each once, of arrays alone."""
