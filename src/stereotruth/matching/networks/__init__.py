"""StereoNet, PSM-Net and HMSM-Net: structure, weights, training, inference (PyTorch)."""
