"""Refusals and warnings of the stages as findings."""

from __future__ import annotations

import logging

from stereotruth.command.findings import Findings, Level
from stereotruth.errors import InputError


def test_refusals_and_warnings_are_findings():
    found = Findings("A-1")
    with found.of("images"):
        logging.getLogger("stereotruth").warning("warning: %d bands", 3)
        raise InputError("too dark", file="a.tif", remedy="switch on the light")
    assert [(f.level, f.text, f.remedy) for f in found] == [
        (Level.ERROR, "a.tif: too dark", "switch on the light"),
        (Level.DOUBT, "3 bands", ""),
    ]
    assert found.failed
    found.error("images", InputError("too dark", file="a.tif", remedy="switch on the light"))
    assert len(found) == 2  # said once


def test_outside_of_a_block_nothing_is_heard():
    found = Findings()
    with found.of("images"):
        pass
    logging.getLogger("stereotruth").warning("unheard")
    assert found == [] and not found.failed
