"""What all rooms stand on: errors, configuration, sheets, files, grids, arrays, kernels."""
