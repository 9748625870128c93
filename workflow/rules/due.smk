"""What is due: by the records of the jobs (products.records), and not by times of files.

Snakemake asks its own records whether settings, inputs or times have changed since a product was
made. Of the rules of this workflow it asks ours here, in one question; it still sees by itself
which products are absent, and that a job follows from another that runs. Its functions that are
replaced are private: tests/workflow/test_due.py fails where a new version has others.
"""

from contextlib import suppress

from snakemake.dag import DAG
from snakemake.exceptions import InputFunctionException
from snakemake.io import _IOFile
from snakemake.jobs import Job
from snakemake.logging import logger
from snakemake.persistence import PersistenceBase, ParamsChange

from stereotruth.products.records import mark_begun, why_due


def is_recorded(rule):
    """Whether records are kept of what it makes, as of all that has a digest of its code."""
    return rule is not None and "code" in dict(rule.params.items())


class Due(ParamsChange):
    """Why a job is to run; false if there is no reason."""

    def __init__(self, why, files=()):
        super().__init__({why} if why else set(), set(), set(files))

    def __str__(self):
        return "; ".join(self.only_old)


def instead(of, name, answer):
    """Answer for jobs or files of recorded rules, and have all others answered as before."""
    before = getattr(of, name)

    def either(self, *arguments, **named):
        asked = self if isinstance(self, (_IOFile, Job)) else arguments[0]
        ours = is_recorded(asked.rule)
        return (answer if ours else before)(self, *arguments, **named)

    setattr(of, name, either)


def due(persistence, job, file=None):
    try:
        with in_words():
            why = why_due(job.output, job.input, job.params)
    except InputError as error:
        raise Refused(str(error))
    if why:
        logger.info(f"{job.output[0]}: {why}")
    return Due(why, job.output)


async def never(*_):
    return False


async def none(*_):
    return []


async def none_in_turn(*_):
    for output in ():
        yield output


def started(persistence, job, *more, before=PersistenceBase.started, **named):
    if is_recorded(job.rule):
        mark_begun(job.output[0])  # its record takes the mark away, and nothing else does
    return before(persistence, job, *more, **named)


async def cleaned(job, *more, before=Job.cleanup, **named):
    if is_recorded(job.rule):
        mark_begun(job.output[0])  # a job that failed after its record was written, too
    return await before(job, *more, **named)


def if_possible(persistence, before=PersistenceBase.save_iocache):
    with suppress(OSError):  # a plan in a folder that is read-only
        before(persistence)


class RefusedInput(InputFunctionException):
    """A refusal of an input function, which Snakemake would wrap into ten lines."""


RefusedInput.__name__ = Refused.__name__  # what Snakemake prints above the message


def wrapped(error, message, *more, before=InputFunctionException.__init__, **named):
    if isinstance(message, Refused):
        error.__class__ = RefusedInput
        WorkflowError.__init__(error, str(message))
    else:
        before(error, message, *more, **named)


InputFunctionException.__init__ = wrapped
instead(PersistenceBase, "params_changed", due)
instead(PersistenceBase, "has_metadata", lambda *_: True)
instead(PersistenceBase, "has_outdated_metadata", lambda *_: False)
instead(PersistenceBase, "incomplete", none)  # our marks tell
instead(PersistenceBase, "input_changed", lambda *_, **__: [])
instead(PersistenceBase, "code_changed", lambda *_, **__: [])
instead(Job, "outputs_older_than_script_or_notebook", none_in_turn)  # without profiles/default
instead(_IOFile, "is_newer", never)
instead(DAG, "check_output_mtime", never)
PersistenceBase.started = started
Job.cleanup = cleaned
PersistenceBase.save_iocache = if_possible
