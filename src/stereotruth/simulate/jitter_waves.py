"""Waves of an attitude that jitters, in the array of a camera: fields and their sums."""

from __future__ import annotations

import math

from ..kernels import inlined

WAVES, WAVE = 37, 38  # number of the waves of jitter, and the first one's fields
ROLL_WAVE, PITCH_WAVE, PER_ROW, PHASE = 0, 1, 2, 3  # amplitudes and frequency in rad, phase
MOST_WAVES = 8
END = WAVE + 4 * MOST_WAVES


@inlined
def swings(cam, row):
    """What all waves together add to roll and pitch at a line."""
    roll = pitch = 0.0
    for k in range(int(cam[WAVES])):
        at = WAVE + 4 * k
        swing = math.sin(cam[at + PHASE] + cam[at + PER_ROW] * row)
        roll += cam[at + ROLL_WAVE] * swing
        pitch += cam[at + PITCH_WAVE] * swing
    return roll, pitch
