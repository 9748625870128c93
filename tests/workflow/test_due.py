"""The private parts of Snakemake that due.smk replaces are as it takes them to be."""

from __future__ import annotations

import inspect
import re

import pytest
import snakemake.cli  # noqa: F401  first: the others import in a circle
from snakemake.dag import DAG
from snakemake.exceptions import InputFunctionException
from snakemake.io import _IOFile
from snakemake.jobs import Job
from snakemake.persistence import PersistenceBase

REMEDY = "this Snakemake has others: see workflow/rules/due.smk, or bound the version"


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        (PersistenceBase.params_changed, ["self", "job", "file"]),
        (PersistenceBase.has_metadata, ["self", "job"]),
        (PersistenceBase.incomplete, ["self", "job"]),
        (PersistenceBase.has_outdated_metadata, ["self", "job"]),
        (PersistenceBase.input_changed, ["self", "job", "file"]),
        (PersistenceBase.code_changed, ["self", "job", "file"]),
        (Job.outputs_older_than_script_or_notebook, ["self"]),
        (Job.cleanup, ["self", "skip_outputs"]),
        (_IOFile.is_newer, ["self", "time"]),
        (DAG.check_output_mtime, ["self", "job", "expanded_output"]),
        (PersistenceBase.started, ["self", "job", "external_jobid"]),
        (PersistenceBase.save_iocache, ["self"]),
        (
            InputFunctionException.__init__,
            ["self", "msg", "wildcards", "lineno", "snakefile", "rule"],
        ),
    ],
)
def test_a_function_that_is_replaced_is_there(function, arguments):
    assert list(inspect.signature(function).parameters) == arguments, REMEDY


def test_a_plan_asks_these_questions_and_no_others():
    """What makes a job due in a plan of this Snakemake; each is answered from our records."""
    source = inspect.getsource(DAG.update_needrun)
    asked = set(re.findall(r"workflow\.persistence\.(\w+)", source))
    assert asked == {
        "input_checksums",  # only of files that are newer
        "has_metadata",
        "has_outdated_metadata",
        "params_changed",
        "input_changed",
        "code_changed",
        "software_stack_changed",  # of conda and containers: Snakemake's own
    }, REMEDY
    assert "f.is_newer" in source, REMEDY
