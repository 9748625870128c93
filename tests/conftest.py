"""Settings of all tests."""

import os
from pathlib import PurePosixPath

import pytest

pytest.register_assert_rewrite("tests.synthetic")

# One thread for linear algebra: two test processes would fight for two cores (measured: 84 s
# against 32 s for the same tests).
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Test files of the workflow whose fixtures build on one city, made once for all of them.
OF_ONE_CITY = {"audit", "benchmark", "disturbed", "end_to_end", "predict", "report", "restart"}


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each file's tests by one process, and those of OF_ONE_CITY too: fixtures are made once.

    The marks of pytest-xdist 3.8 (``--dist loadgroup``) do nothing with pytest 9: both processes
    made every fixture.
    """
    from xdist.scheduler import LoadScopeScheduling

    class ByFixtures(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = PurePosixPath(nodeid.partition("::")[0])
            name = file.stem.removeprefix("test_")
            shared = file.parent.name == "workflow" and name in OF_ONE_CITY
            return "one city" if shared else str(file)

    return ByFixtures(config, log)
