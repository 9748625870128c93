"""Refusals and warnings of the stages as findings."""

from __future__ import annotations

import logging

from stereotruth.core.errors import InputError
from stereotruth.project.findings import Findings, Level, said_once


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


def test_what_is_found_of_several_scenes_stands_once():
    every = [Findings(name) for name in ("project", "A-1", "A-2", "A-3", "run")]
    for findings in every[1:4]:
        findings.say("GCPs", Level.DOUBT, "none")
        findings.say("images", Level.FACT, f"size of {findings.scene}")
    for findings in every[1:3]:
        findings.say("images", Level.DOUBT, "dark", "light")
        findings.say("labels", Level.FACT, "alike by chance")
    said = said_once(every)
    assert [heading for heading, _ in said] == [
        "project", "all 3 scenes", "2 scenes", "A-1", "A-2", "A-3", "run",
    ]  # fmt: skip
    parts = dict(said)
    assert [(f.text, f.scene) for f in parts["all 3 scenes"]] == [("none", "")]
    assert [(f.text, f.scene, f.remedy) for f in parts["2 scenes"]] == [
        ("dark", "A-1, A-2", "light")
    ]
    assert [f.text for f in parts["A-2"]] == ["size of A-2", "alike by chance"]
