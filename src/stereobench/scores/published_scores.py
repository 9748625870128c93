"""The paper's results (section V), to stand beside ours: on the real WHU-Stereo, trained on it.

Keys are kinds of methods. EPE in px, D1 (3 px) in percent, milliseconds per pair of 1024 × 1024 px.
"""

from __future__ import annotations

TABLE5 = {
    "sgm": (4.889, 50.79, 506),
    "stereonet": (2.453, 25.12, 238),
    "psmnet": (2.481, 24.81, 614),
    "hmsmnet": (1.672, 12.94, 511),
}
TABLE6 = {
    "Shaoguan": {
        "sgm": (7.862, 63.19),
        "stereonet": (2.660, 24.58),
        "psmnet": (2.514, 21.45),
        "hmsmnet": (2.091, 16.94),
    },
    "Kunming": {
        "sgm": (3.065, 37.50),
        "stereonet": (1.225, 6.09),
        "psmnet": (1.181, 5.77),
        "hmsmnet": (1.017, 4.44),
    },
    "Yingde": {
        "sgm": (5.497, 47.22),
        "stereonet": (1.821, 14.69),
        "psmnet": (1.993, 15.09),
        "hmsmnet": (1.436, 9.86),
    },
    "Qichun": {
        "sgm": (4.484, 54.19),
        "stereonet": (2.801, 34.63),
        "psmnet": (2.953, 37.04),
        "hmsmnet": (1.596, 13.65),
    },
    "Wuhan": {
        "sgm": (6.790, 58.65),
        "stereonet": (4.836, 47.83),
        "psmnet": (4.105, 36.49),
        "hmsmnet": (3.905, 35.66),
    },
    "Hengyang": {
        "sgm": (9.081, 61.82),
        "stereonet": (4.375, 43.50),
        "psmnet": (3.761, 31.23),
        "hmsmnet": (2.914, 23.43),
    },
}
TABLE7 = {
    "Shaoguan": {"stereonet": (2.467, 23.26), "psmnet": (2.366, 20.61), "hmsmnet": (1.928, 15.67)},
    "Kunming": {"stereonet": (1.245, 6.19), "psmnet": (1.091, 4.86), "hmsmnet": (0.996, 5.05)},
    "Yingde": {"stereonet": (1.758, 13.52), "psmnet": (1.481, 9.96), "hmsmnet": (1.351, 8.72)},
    "Qichun": {"stereonet": (2.760, 34.07), "psmnet": (2.817, 35.05), "hmsmnet": (1.483, 12.09)},
    "Wuhan": {"stereonet": (4.346, 42.88), "psmnet": (4.025, 34.92), "hmsmnet": (3.718, 34.51)},
    "Hengyang": {"stereonet": (3.885, 39.18), "psmnet": (3.553, 34.85), "hmsmnet": (2.539, 19.62)},
}
