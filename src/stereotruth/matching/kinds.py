"""The kinds of stereo methods as plain values, so that a workflow can plan with them."""

NETWORKS = ("stereonet", "psmnet", "hmsmnet")
FOLDER = "folder"
KINDS = ("sgm", *NETWORKS, "function", FOLDER)
MODULES = {"sgm": "matching.sgm", **dict.fromkeys(NETWORKS, "matching.networks")}
LABELS = {"sgm": "SGM", "stereonet": "StereoNet", "psmnet": "PSM-Net", "hmsmnet": "HMSM-Net"}
