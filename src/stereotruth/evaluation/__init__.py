"""How good products are: against exact truth, at check points, and by warping images."""
