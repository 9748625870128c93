"""Verdicts on measured figures."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.audit.estimates import Estimate
from stereobench.audit.verdicts import FAULT, GOOD, judge
from stereotruth.core.config.methods import AuditLimits


def figures(bias, error, freedom=40):
    plain = [0.0, 0.01, freedom]
    return {
        "same_shape": True,
        "identical_images": False,
        "images": {},
        "dtype": ["uint16"],
        "matches": 500,
        "rows": {"parallax": plain, "tilt_x": plain, "tilt_y": plain},
        "labels": {"labelled": 0.8, "strays": [], "outside": 0.0, "spikes": [], "step": None},
        "convention": {"taken": "as stated"},
        "bias": {"matches": 500, "bias": [bias, error, freedom], "tilt_x": plain, "tilt_y": plain},
        "contradicted": {"share": [0.001, 0.001, freedom], "labels": 5000},
        "hidden": {"share": 0.0},
        "registration": {"move": [1, 0], "gain": [-0.1, 0.01, freedom]},
    }


@pytest.mark.slow
def test_verdicts_have_the_error_rate_that_is_stated():
    """Biases at the very edge of what is tolerated, many datasets of 20 pairs."""
    rng = np.random.default_rng(62)
    limits = AuditLimits(contradicted_share=0.05, false_alarms=0.2)
    alarms = 0
    for _ in range(120):
        seen = 0.3 + 0.05 * rng.standard_normal(20)
        spread = 0.05 * np.sqrt(rng.chisquare(40, 20) / 40)
        alarms += any(judge(figures(b, e), limits, 20).word == FAULT for b, e in zip(seen, spread))
    assert alarms / 120 <= 0.2
    assert judge(figures(2.0, 0.05), limits, 20).word == FAULT
    assert judge(figures(0.0, 0.02), limits, 20).word == GOOD
    assert judge(figures(0.3, 0.05), limits, 20).word == "undecided"
    assert Estimate(0.3, 0.05, 40).beyond(0.3, 0.2) is None
