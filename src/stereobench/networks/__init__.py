"""StereoNet, PSM-Net, HMSM-Net, DenseMapNet: structure, weights, training, inference (PyTorch)."""
